"""Pictures from above: the map of M-Net, errors of re-localisation, clouds of depth images, scans found in a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.viz import figures
from dpmjax.viz.figures import ACCENT, INK, MUTED, Limits
from dpmjax.viz.registered_scans import time_colormap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNEXPLORED_GREY = 0.74
LONGER_SIDE_IN = 6.4
GAP_IN = 0.12
OBSTACLE = "#e4e6e9"
TRAJECTORY = "#16c7d9"
RIGHT = "#2a9d5c"
HEAD_SHARE = 0.02
# Points with a smaller y than this, in the frame of the first camera, are the ceiling.
CEILING_M = -0.9


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
        ValueError: where the shapes do not fit, or the extent is empty.
    """
    from matplotlib.transforms import Affine2D

    probability, explored = np.asarray(picture[0], np.float64), np.asarray(picture[1], bool)
    if probability.ndim != 2 or explored.shape != probability.shape:
        raise ValueError(f"expected two arrays (h, w); got probability {probability.shape}, explored {explored.shape}")
    extent = Limits(*(float(edge) for edge in picture[2]))
    if not (extent.width > 0.0 and extent.height > 0.0):
        raise ValueError(f"expected an extent (x_min, x_max, y_min, y_max) with min < max; got {tuple(extent)}")
    scale_in = LONGER_SIDE_IN / max(limits.width, limits.height)
    width_in, height_in = limits.width * scale_in, limits.height * scale_in
    figure = figures.new_figure(width_in + 2.0 * GAP_IN, height_in + 2.0 * GAP_IN)
    axes = figures.add_axes(figure, (GAP_IN, GAP_IN, width_in, height_in))
    brightness = np.where(explored, 1.0 - np.clip(probability, 0.0, 1.0), UNEXPLORED_GREY)
    axes.set_facecolor(str(UNEXPLORED_GREY))
    image = figures.show_raster(axes, brightness, extent, cmap="gray", vmin=0.0, vmax=1.0)
    image.set_transform(Affine2D(T_view_world) + axes.transData)
    figures.draw_trajectory(axes, trajectory_world @ T_view_world[:2, :2].T + T_view_world[:2, 2], ACCENT)
    figures.frame_map(axes, limits, unit)
    return figure


class ErrorMap(NamedTuple):
    """One panel.

    Attributes:
        title: title of the network.
        subtitle: numbers of the network.
        error: (h, w) distance to the truth; NaN where no scan was taken. Row 0 has the smallest y.
    """

    title: str
    subtitle: str
    error: NDArray[np.floating]


def error_maps_figure(
    maps: Sequence[ErrorMap],
    extent: tuple[float, float, float, float],
    trajectory_world: NDArray[np.floating],
    unit: str,
    *,
    worst: float,
) -> Figure:
    """Draws errors of re-localisation in the manner of DeepMapping figure 7; black is an error of zero.

    Args:
        maps: maps, at least one, all of one shape.
        extent: x_min, x_max, y_min, y_max of the grids' outer edges, in `unit`.
        trajectory_world: (n, 2) where the scans of the fit were taken.
        unit: unit of lengths.
        worst: least error of the last colour.

    Returns:
        The figure; the trajectory of the fit is cyan.

    Raises:
        ValueError: no panel, panels of different shapes, or `worst` is not positive.
    """
    if not maps or len({panel.error.shape for panel in maps}) != 1 or not worst > 0.0:
        raise ValueError(f"expected panels of one shape and worst > 0; got {len(maps)} panels, worst {worst}")
    import matplotlib

    limits = Limits(*map(float, extent))
    colormap = matplotlib.colormaps["inferno"].with_extremes(bad=OBSTACLE)
    figure = figures.new_figure(4.6 * len(maps) + 0.9, 5.0)
    axes_row = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, panel in zip(axes_row, maps, strict=True):
        image = figures.show_raster(axes, panel.error, limits, cmap=colormap, vmin=0.0, vmax=worst)
        axes.plot(*np.asarray(trajectory_world).T, ".", color=TRAJECTORY, ms=1.8)
        figures.set_title(axes, f"{panel.title}\n", 11, loc="left", fontweight="bold")
        figures.annotate_corner(axes, panel.subtitle, (0, 6))
        figures.frame_map(axes, limits, unit if panel is maps[0] else None)
    # The bar and its label need about 0.9 inches at the right, whatever the number of maps.
    right = 1.0 - 0.9 / figure.get_figwidth()
    figure.tight_layout(rect=(0.0, 0.0, right, 1.0))
    bar = figure.add_axes((right + 0.005, 0.1, 0.15 / figure.get_figwidth(), 0.75))
    figure.colorbar(image, cax=bar, label=f"error, {unit}", extend="max")
    return figure


def from_above_figure(panels: Sequence[tuple[str, NDArray[np.float64]]], points: ArrayLike, mask: ArrayLike) -> Figure:
    """Draws depth images from above, without the ceiling, one colour for each image, for several sets of poses.

    Args:
        panels: title and (n, 4, 4) T_world_camera in metres; all are aligned with the last.
        points: (n, h, w, 3) in the camera frames (y down).
        mask: (n, h, w).

    Returns:
        The figure.

    Raises:
        ValueError: no panel.
    """
    if not panels:
        raise ValueError("panels: expected at least one")
    cloud, valid = np.asarray(points, np.float64), np.asarray(mask, bool)
    poses = [T for _, T in panels]
    # The first camera is level in every panel, so the panels are aligned by the first poses.
    aligned = [poses[-1][0] @ np.linalg.inv(T[0]) @ T for T in poses]
    clouds = [np.einsum("nij,nhwj->nhwi", T[:, :3, :3], cloud) + T[:, None, None, :3, 3] for T in aligned]
    sensors = [T[:, :3, 3] for T in aligned]
    low, high = np.quantile(clouds[-1][valid][:, [0, 2]], [0.002, 0.998], axis=0)
    limits = figures.plane_limits(np.vstack([sensors[-1][:, [0, 2]], [low, high]]), 0.12)
    figure = figures.new_figure(4.4 * len(panels), 4.4 * limits.height / limits.width + 0.5, layout="tight")
    colors = time_colormap()(np.linspace(0.0, 1.0, len(cloud)))
    axes_row = figure.subplots(1, len(panels), squeeze=False)[0]
    # Few points would hardly be seen.
    size = float(np.clip(200 / np.sqrt(max(valid.sum(), 1)), 1.2, 4))
    for axes, (title, _), world, centres in zip(axes_row, panels, clouds, sensors, strict=True):
        for image, color in enumerate(colors):
            shown = world[image][valid[image] & (world[image][..., 1] > CEILING_M)]
            axes.plot(shown[:, 0], shown[:, 2], ".", ms=size, mew=0, color=color)
        axes.plot(centres[:, 0], centres[:, 2], "-o", color=INK, ms=3, lw=1)
        figures.frame_map(axes, limits, "m" if axes is axes_row[0] else None)
        figures.set_title(axes, title, loc="left")
    return figure


def localization_figure(
    points_map: ArrayLike,
    T_map_keyframe: ArrayLike,
    T_map_scan: ArrayLike,
    *,
    is_wrong: ArrayLike | None = None,
    title: str,
) -> Figure:
    """Draws a map from above, the keyframes' positions, and the poses of the scans that were found as arrows.

    Args:
        points_map: (n, 3) points of the map, metres.
        T_map_keyframe: (k, 4, 4) at least one.
        T_map_scan: (s, 4, 4) of the scans that were found.
        is_wrong: (s,) scans that a reference puts elsewhere; None without a reference.
        title: title of the picture.

    Returns:
        The figure.
    """
    points, path = np.asarray(points_map, float).reshape(-1, 3), np.asarray(T_map_keyframe, float)[:, :3, 3]
    T = np.asarray(T_map_scan, float).reshape(-1, 4, 4)
    wrong = np.zeros(len(T), bool) if is_wrong is None else np.asarray(is_wrong, bool)
    # Few far points must not determine the limits.
    shown = np.concatenate([points[:, :2], path[:, :2], T[:, :2, 3]])
    limits = figures.plane_limits(np.percentile(shown, [0.5, 99.5], axis=0), 0.06)
    width_in, height_in = figures.size_in(limits)
    figure = figures.new_figure(width_in + 0.3, height_in + 0.8, layout="tight")
    axes = figure.subplots()
    axes.scatter(points[:, 0], points[:, 1], s=0.4, color=MUTED, alpha=0.35, linewidths=0, rasterized=True)
    axes.plot(path[:, 0], path[:, 1], ".", color=INK, ms=3, label=f"{len(path)} keyframes", zorder=4)
    head = HEAD_SHARE * max(limits.width, limits.height)
    for mask, color, label in ((~wrong, RIGHT, "found"), (wrong, ACCENT, "found elsewhere than the reference")):
        if mask.any():
            (x, y), (dx, dy) = T[mask, :2, 3].T, T[mask, :2, 0].T
            axes.quiver(x, y, dx, dy, color=color, scale=1 / head, scale_units="xy", width=0.004, zorder=6)
            axes.plot(x, y, "o", color=color, ms=3.5, label=f"{mask.sum()} {label}", zorder=5)
    figures.frame_map(axes, limits, "m")
    axes.legend(loc="upper right", fontsize=8, framealpha=0.85)
    figures.set_title(axes, title)
    return figure
