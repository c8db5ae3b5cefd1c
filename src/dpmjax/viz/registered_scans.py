"""Pictures of a registration: the same scans under several sets of poses, the map of M-Net, depth images from above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
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
from dpmjax.viz.figures import ACCENT, INK, MUTED, Limits

PANEL_WIDTH_IN = 4.2
HEADER_IN = 0.62
FOOTER_IN = 0.75
GAP_IN = 0.14
MAX_POINTS_PER_PANEL = 120_000
OUTER_QUANTILE = 0.002
MARGIN = 0.04
UNEXPLORED_GREY = 0.74
OCCUPANCY_SIDE_IN, OCCUPANCY_GAP_IN, LEGEND_IN = 6.4, 0.12, 0.3
# Points with a smaller y than this, in the frame of the first camera, are the ceiling.
CEILING_M = -0.9


@dataclass(frozen=True)
class Panel:
    """One set of poses of the scans.

    Attributes:
        title: name of the method of these poses.
        scans: points (n, b, 2) in the sensor frames, and mask (n, b), True where there is a point.
        poses: (n, 3) x, y, heading (radians) of the sensor in the world of this panel.
        ate: absolute trajectory error in the unit of the figure, or None.
        point_distance: mean point distance in the unit of the figure, or None.
        is_reference: all panels are aligned with this one.
    """

    title: str
    scans: ScanSet
    poses: NDArray[np.floating]
    ate: float | None = None
    point_distance: float | None = None
    is_reference: bool = False

    def __post_init__(self) -> None:
        """Checks the shapes.

        Raises:
            ValueError: they do not fit each other.
        """
        points, mask, poses = (np.shape(x) for x in (self.scans.points, self.scans.mask, self.poses))
        if len(points) != 3 or points[-1] != 2 or mask != points[:2] or poses != (points[0], 3):
            got = f"got points {points}, mask {mask}, poses {poses}"
            raise ValueError(f"expected points (n, b, 2), mask (n, b), poses (n, 3); {got}")

    @property
    def trajectory_world(self) -> NDArray[np.float64]:
        """Sensor positions (n, 2)."""
        return np.asarray(self.poses, np.float64)[:, :2]

    @property
    def points_world(self) -> NDArray[np.float64]:
        """Points (n, b, 2) in the world frame of the panel."""
        poses, points = np.asarray(self.poses, np.float64), np.asarray(self.scans.points, np.float64)
        return np.asarray(se2.transform_points(poses, points))

    def visible_points(self) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Returns the points (m, 2) that can be drawn, and the index (m,) of the scan of each point."""
        points = self.points_world
        is_drawable = np.asarray(self.scans.mask, bool) & np.isfinite(points).all(axis=-1)
        return points[is_drawable], np.nonzero(is_drawable)[0]


def registered_scans_figure(panels: Sequence[Panel], unit: str) -> Figure:
    """Draws the panels side by side in one frame with one scale.

    The rigid motion that brings its trajectory closest aligns each panel with the reference panel, or without one with
    the last. All panels have the same limits. One colour a scan, running with time; trajectory in black, its start
    marked with a dot. At most `MAX_POINTS_PER_PANEL` points are drawn, chosen evenly by a fixed seed and in random
    order, so that late scans do not hide early ones.

    Args:
        panels: panels, at least one; all of the same scans.
        unit: unit of lengths, "px" or "m".

    Returns:
        The figure; its first axes have the limits of all panels.

    Raises:
        ValueError: no panel, or panels of different numbers of scans.
    """
    sizes = [len(panel.poses) for panel in panels]
    if len(set(sizes)) != 1:
        raise ValueError(f"expected one or more panels of the same scans; got panels of {sizes} scans")
    anchor = next((panel for panel in panels if panel.is_reference), panels[-1])
    aligned = [panel if panel is anchor else _laid_onto(panel, anchor) for panel in panels]
    limits = _shared_limits(aligned, aligned[panels.index(anchor)])

    height_in = PANEL_WIDTH_IN * limits.height / limits.width
    width_in = len(panels) * PANEL_WIDTH_IN + (len(panels) + 1) * GAP_IN
    figure = figures.new_figure(width_in, height_in + HEADER_IN + FOOTER_IN)
    colormap = time_colormap()
    for column, panel in enumerate(aligned):
        left_in = GAP_IN + column * (PANEL_WIDTH_IN + GAP_IN)
        _draw_panel(figures.add_axes(figure, (left_in, FOOTER_IN, PANEL_WIDTH_IN, height_in)), panel, unit, colormap)
        figures.frame_map(figure.axes[-1], limits, None if column else unit)
    _add_time_bar(figure, len(anchor.poses), "scan", "path of the sensor, its start a dot")
    return figure


def time_colormap() -> Colormap:
    """Returns violet over red to amber: even in lightness, and nowhere too pale for a white ground."""
    colors = matplotlib.colormaps["plasma"](np.linspace(0.0, 0.86, 256))
    return LinearSegmentedColormap.from_list("dpmjax_time", colors)


def _laid_onto(panel: Panel, anchor: Panel) -> Panel:
    """Returns the panel moved rigidly, its trajectory as close as possible to the anchor's (least squares)."""
    source, target = panel.trajectory_world, anchor.trajectory_world
    is_used = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    T_anchor_panel = best_motion(source, target, is_used.astype(np.float64))
    return replace(panel, poses=se2.compose(se2.from_matrix(T_anchor_panel), np.asarray(panel.poses, np.float64)))


def _shared_limits(panels: Sequence[Panel], anchor: Panel) -> Limits:
    """Returns limits that show every panel; a diverged panel is cut at half the anchor's size beyond the anchor."""
    low, high = _extent(anchor)
    size = np.max(high - low)
    lows, highs = zip(*(_extent(panel) for panel in panels), strict=True)
    low = np.maximum(np.min(lows, axis=0), low - 0.5 * size)
    high = np.minimum(np.max(highs, axis=0), high + 0.5 * size)
    # A corridor must not become a strip that is too thin to read or too tall for the page.
    margin = MARGIN * np.max(high - low)
    width, height = high - low + 2.0 * margin
    width, height = max(width, 0.7 * height), max(height, 0.45 * width)
    centre = (low + high) / 2.0
    return Limits(centre[0] - width / 2.0, centre[0] + width / 2.0, centre[1] - height / 2.0, centre[1] + height / 2.0)


def _extent(panel: Panel) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Returns the corners of the box around trajectory and nearly all points; a unit box where there is nothing."""
    points, _ = panel.visible_points()
    corners = [panel.trajectory_world[np.isfinite(panel.trajectory_world).all(axis=-1)]]
    if len(points):
        corners.append(np.quantile(points, [OUTER_QUANTILE, 1.0 - OUTER_QUANTILE], axis=0))
    stacked = np.concatenate(corners)
    if not len(stacked):
        return np.full(2, -0.5), np.full(2, 0.5)
    low, high = stacked.min(axis=0), stacked.max(axis=0)
    if np.max(high - low) <= 0.0:
        return low - 0.5, high + 0.5
    return low, high


def _draw_panel(axes: Axes, panel: Panel, unit: str, colormap: Colormap) -> None:
    points, scans = panel.visible_points()
    order = np.random.default_rng(0).permutation(len(points))[:MAX_POINTS_PER_PANEL]
    size = np.clip(50_000.0 / max(1, len(order)), 0.45, 4.0)
    colors = colormap(scans[order] / max(1, len(panel.poses) - 1))
    axes.scatter(points[order, 0], points[order, 1], size, colors, linewidths=0, rasterized=True, zorder=2)
    figures.draw_trajectory(axes, panel.trajectory_world, "black")
    known = {"ATE": panel.ate, "point distance": panel.point_distance}
    numbers = [f"{name} {figures.format_length(value, unit)}" for name, value in known.items() if value is not None]
    # A long title is drawn smaller, so that it does not run into the next panel.
    title_size = min(12.5, 480.0 / max(1, len(panel.title)))
    figures.annotate_corner(axes, panel.title, (1, 21), fontsize=title_size, fontweight="bold", color=INK)
    figures.annotate_corner(axes, "   ".join(numbers), (1, 7), fontsize=9.5)


def _add_time_bar(figure: Figure, num: int, noun: str, path_label: str) -> None:
    """Adds a thin colour bar of the scans or images under the panels, and names the path."""
    width_in = figure.get_figwidth()
    length_in = min(3.0, 0.5 * width_in)
    axes = figures.add_axes(figure, (0.5 * (width_in - length_in), 0.44, length_in, 0.09))
    axes.imshow(np.linspace(0.0, 1.0, 256)[None, :], aspect="auto", cmap=time_colormap())
    axes.set_axis_off()
    style: Any = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "center", "fontsize": 8.5}
    axes.annotate(f"{noun} 1", (0, 0.5), xytext=(-6, 0), ha="right", color=MUTED, **style)
    axes.annotate(f"{noun} {num}", (1, 0.5), xytext=(6, 0), ha="left", color=MUTED, **style)
    path = Line2D([], [], color=INK, marker="o", ms=4, lw=1.2, label=path_label)
    figures.add_legend(figure, handles=[path], columns=1, loc="lower center", bbox_to_anchor=(0.5, 0.0))


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
    probability, explored = np.asarray(picture[0], np.float64), np.asarray(picture[1], bool)
    if probability.ndim != 2 or explored.shape != probability.shape:
        raise ValueError(f"expected two arrays (h, w); got probability {probability.shape}, explored {explored.shape}")
    extent = Limits(*(float(edge) for edge in picture[2]))
    if not (extent.width > 0.0 and extent.height > 0.0):
        raise ValueError(f"expected an extent (x_min, x_max, y_min, y_max) with min < max; got {tuple(extent)}")
    scale_in = OCCUPANCY_SIDE_IN / max(limits.width, limits.height)
    width_in, height_in = limits.width * scale_in, limits.height * scale_in
    figure = figures.new_figure(width_in + 2.0 * OCCUPANCY_GAP_IN, height_in + 2.0 * OCCUPANCY_GAP_IN + LEGEND_IN)
    axes = figures.add_axes(figure, (OCCUPANCY_GAP_IN, OCCUPANCY_GAP_IN + LEGEND_IN, width_in, height_in))
    brightness = np.where(explored, 1.0 - np.clip(probability, 0.0, 1.0), UNEXPLORED_GREY)
    axes.set_facecolor(str(UNEXPLORED_GREY))
    image = figures.show_raster(axes, brightness, extent, cmap="gray", vmin=0.0, vmax=1.0)
    image.set_transform(Affine2D(T_view_world) + axes.transData)
    figures.draw_trajectory(axes, trajectory_world @ T_view_world[:2, :2].T + T_view_world[:2, 2], ACCENT)
    figures.frame_map(axes, limits, unit)
    greys = {"occupied": "0.0", "free": "1.0", "not seen": str(UNEXPLORED_GREY)}
    entries: list[Artist] = [Patch(fc=grey, ec=MUTED, lw=0.5, label=name) for name, grey in greys.items()]
    entries.append(Line2D([], [], color=ACCENT, marker="o", ms=4, lw=1.2, label="path, its start a dot"))
    figures.add_legend(axes, handles=entries, columns=4)
    return figure


def from_above_figure(panels: Sequence[tuple[str, NDArray[np.float64]]], points: ArrayLike, mask: ArrayLike) -> Figure:
    """Draws depth images from above, without the ceiling, one colour for each image, for several sets of poses.

    Args:
        panels: title and (n, 4, 4) T_world_camera in metres; each is drawn in the frame of its first camera.
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
    # The axis down is that of the first camera; a world may have another one.
    aligned = [np.linalg.inv(T[0]) @ T for T in poses]
    clouds = [np.einsum("nij,nhwj->nhwi", T[:, :3, :3], cloud) + T[:, None, None, :3, 3] for T in aligned]
    sensors = [T[:, :3, 3] for T in aligned]
    low, high = np.quantile(clouds[-1][valid][:, [0, 2]], [0.002, 0.998], axis=0)
    # A room is small: a margin of metres would be most of the picture.
    limits = figures.plane_limits(np.vstack([sensors[-1][:, [0, 2]], [low, high]]), 0.06, least_margin=0.05)
    height_in = PANEL_WIDTH_IN * limits.height / limits.width
    width_in = len(panels) * (PANEL_WIDTH_IN + GAP_IN) + GAP_IN
    figure = figures.new_figure(width_in, height_in + HEADER_IN + FOOTER_IN)
    colors = time_colormap()(np.linspace(0.0, 1.0, len(cloud)))
    # Few points would hardly be seen.
    size = float(np.clip(200 / np.sqrt(max(valid.sum(), 1)), 1.2, 4))
    for column, ((title, _), world, centres) in enumerate(zip(panels, clouds, sensors, strict=True)):
        left_in = GAP_IN + column * (PANEL_WIDTH_IN + GAP_IN)
        axes = figures.add_axes(figure, (left_in, FOOTER_IN, PANEL_WIDTH_IN, height_in))
        for image, color in enumerate(colors):
            shown = world[image][valid[image] & (world[image][..., 1] > CEILING_M)]
            axes.plot(shown[:, 0], shown[:, 2], ".", ms=size, mew=0, color=color)
        axes.plot(centres[:, 0], centres[:, 2], "-o", color=INK, ms=3, lw=1)
        figures.frame_map(axes, limits, None if column else "m")
        figures.set_title(axes, title, loc="left")
    _add_time_bar(figure, len(cloud), "image", "camera at each image")
    return figure
