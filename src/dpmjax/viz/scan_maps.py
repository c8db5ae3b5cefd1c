"""Pictures of a registration: the same scans under several sets of poses, the map of M-Net, depth images from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike, NDArray

from dpmjax.geometry import se2
from dpmjax.geometry.alignment import best_motion
from dpmjax.types import ScanSet
from dpmjax.viz import figures
from dpmjax.viz.figures import MUTED, PATH, Bar, Limits, Panel, Points, Track, figure

UNEXPLORED_GREY = 0.74
# Points with a smaller y than this, in the frame of the first camera, are the ceiling.
CEILING_M = -0.9


def registered_scans_figure(
    scans: ScanSet, poses: Mapping[str, NDArray[np.floating]], unit: str, *, anchor: str | None = None
) -> Figure:
    """Draws scans under several sets of poses, side by side in one frame with one scale.

    One colour a scan, running with time; points in random order by a fixed seed, so that late scans do not hide early
    ones.

    Args:
        scans: points (n, b, 2) in the sensor frames, and mask (n, b), True where there is a point.
        poses: (n, 3) x, y, heading (radians) of the sensor, by the title of the panel; at least one.
        unit: unit of lengths, "px" or "m".
        anchor: title of the panel that all others are aligned with, and whose panel is the last; None: the last one.

    Returns:
        The figure; its first axes have the limits of all panels.

    Raises:
        ValueError: no poses, or poses of another number of scans.
    """
    points, mask = np.asarray(scans.points, np.float64), np.asarray(scans.mask, bool)
    for title, each in poses.items():
        if np.shape(each) != (len(points), 3):
            raise ValueError(f"{title}: expected poses ({len(points)}, 3), got {np.shape(each)}")
    if anchor is not None:
        poses = {title: poses[title] for title in (*(title for title in poses if title != anchor), anchor)}
    panels: list[Panel] = []
    for each in map(np.asarray, poses.values()):
        target = np.asarray(list(poses.values())[-1], np.float64)
        is_used = np.isfinite(each).all(axis=1) & np.isfinite(target).all(axis=1)
        T_anchor_panel = best_motion(each[:, :2], target[:, :2], is_used.astype(np.float64))
        aligned = np.asarray(se2.compose(se2.from_matrix(T_anchor_panel), each.astype(np.float64)))
        world = np.asarray(se2.transform_points(aligned, points))
        shown = np.random.default_rng(0).permutation(np.argwhere(mask & np.isfinite(world).all(axis=-1)))
        cloud = Points(world[tuple(shown.T)], _time_colors(len(points))[shown[:, 0]])
        panels.append(Panel(list(poses)[len(panels)], [cloud, Track(aligned[:, :2], PATH, "path of the sensor")]))
    return figure(panels, unit=unit, is_shared=True, bar=_time_bar("scan", len(points)))


def occupancy_figure(
    picture: tuple[ArrayLike, ArrayLike, tuple[float, float, float, float]],
    trajectory_world: NDArray[np.floating],
    unit: str,
    *,
    T_view_world: NDArray[np.floating],
    limits: Limits,
) -> Figure:
    """Draws an occupancy map in the manner of DeepMapping, Figure 5.

    Args:
        picture: (h, w) probability that a cell is occupied, row 0 at the smallest y; (h, w) True where a beam passed or
            ended; and x_min, x_max, y_min, y_max of the grid's outer edges in the world, in `unit`.
        trajectory_world: (n, 2) sensor positions.
        unit: unit of lengths, "px" or "m".
        T_view_world: (3, 3) rigid motion into the frame of the picture.
        limits: shown part of that frame.

    Returns:
        The figure.

    Raises:
        ValueError: where the shapes do not fit.
    """
    probability, explored = np.asarray(picture[0], np.float64), np.asarray(picture[1], bool)
    if probability.ndim != 2 or explored.shape != probability.shape:
        raise ValueError(f"expected two arrays (h, w); got probability {probability.shape}, explored {explored.shape}")
    path = trajectory_world @ T_view_world[:2, :2].T + T_view_world[:2, 2]
    drawn = figure([Panel("", [Track(path)], limits=limits)], unit=unit)
    axes = drawn.axes[0]
    axes.set_facecolor(str(UNEXPLORED_GREY))
    brightness = np.where(explored, 1.0 - np.clip(probability, 0.0, 1.0), UNEXPLORED_GREY)
    image = figures.show_raster(axes, brightness, Limits(*picture[2]), cmap="gray", vmin=0.0, vmax=1.0)
    image.set_transform(Affine2D(T_view_world) + axes.transData)
    axes.set(xlim=limits[:2], ylim=limits[2:])
    greys = {"occupied": "0.0", "free": "1.0", "not seen": str(UNEXPLORED_GREY)}
    entries: dict[str, Any] = {name: Patch(fc=grey, ec=MUTED, lw=0.5) for name, grey in greys.items()}
    figures.add_legend(drawn, entries | {"path of the sensor": Line2D([], [], color=PATH, marker="o")}, 4)
    return drawn


def from_above_figure(panels: Sequence[tuple[str, NDArray[np.float64]]], points: ArrayLike, mask: ArrayLike) -> Figure:
    """Draws depth images from above, without the ceiling, one colour for each image, for several sets of poses.

    Args:
        panels: title and (n, 4, 4) T_world_camera in metres; each is drawn in the frame of its first camera.
        points: (n, h, w, 3) in the camera frames (y down).
        mask: (n, h, w).

    Returns:
        The figure.
    """
    cloud, valid, drawn = np.asarray(points, np.float64), np.asarray(mask, bool), []
    for title, T_world_camera in panels:
        # The axis down is that of the first camera; a world may have another one.
        T = np.linalg.inv(T_world_camera[0]) @ T_world_camera
        world = np.einsum("nij,nhwj->nhwi", T[:, :3, :3], cloud) + T[:, None, None, :3, 3]
        shown = np.argwhere(valid & (world[..., 1] > CEILING_M))
        seen = Points(world[tuple(shown.T)][:, [0, 2]], _time_colors(len(cloud))[shown[:, 0]])
        drawn.append(Panel(title, [seen, Track(T[:, [0, 2], 3], PATH, "path of the camera")]))
    return figure(drawn, is_shared=True, bar=_time_bar("image", len(cloud)))


def _time_bar(noun: str, num: int) -> Bar:
    return Bar(noun, _time_colormap(), 1, max(num, 2))


def _time_colors(num: int) -> UInt8[np.ndarray, "num 3"]:
    return np.asarray(_time_colormap()(np.linspace(0.0, 1.0, num), bytes=True))[:, :3]


def _time_colormap() -> Colormap:
    """Returns violet over red to amber: even in lightness, and nowhere too pale for a white ground."""
    colors: Any = matplotlib.colormaps["plasma"](np.linspace(0.0, 0.86, 256))
    return LinearSegmentedColormap.from_list("dpmjax_time", colors)
