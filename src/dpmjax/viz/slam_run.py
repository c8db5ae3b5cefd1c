"""Pictures of SLAM from above: trajectories with loops, the map by height, scans found in it; and the live viewer."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from dpmjax.sequences import counted
from dpmjax.viz import figures
from dpmjax.viz.figures import ACCENT, INK, MUTED, Limits

OURS, ODOMETRY, LOOP = "#1f4e8c", "#e08a1e", "#2a9d5c"
# Length of an arrow as a share of the longer side; grey of points, darker than that of words.
HEAD_SHARE, POINTS = 0.04, "#9aa3ad"
# Heights above the lidar that the colours of maps span.
HEIGHTS_M = (-2.5, 5.5)

_ROOF_M = 1.0
# Points and colours of the live viewer.
_RADIUS_M = 0.04
_TRAJECTORY, _LOOP = (31, 78, 140), (42, 157, 92)


class Track(NamedTuple):
    """One trajectory of a picture.

    Attributes:
        label: label for the legend.
        positions: (n, 3) metres; all tracks of a picture are in one frame.
        errors_m: (n,) distance of each scan to the reference; None where there is none.
    """

    label: str
    positions: Float[np.ndarray, "n 3"]
    errors_m: Float[np.ndarray, " n"] | None = None


def trajectory_figure(
    title: str,
    tracks: Sequence[Track],
    reference: Float[np.ndarray, "n 3"] | None,
    loops: Float[np.ndarray, "m 2 3"],
) -> Figure:
    """Draws trajectories from above with the reference and the loops; and the errors beside them.

    Args:
        title: title of the picture.
        tracks: at most three; the last one is the result, drawn on those before.
        reference: positions in the same frame; None where there is none.
        loops: positions of both ends of each accepted loop.

    Returns:
        The figure; without errors it has no second panel.

    Raises:
        ValueError: no track.
    """
    if not tracks:
        raise ValueError("tracks: expected at least one")
    shown = [track.positions for track in tracks] + ([] if reference is None else [reference])
    limits = figures.plane_limits(np.concatenate(shown)[:, :2], 0.06)
    (width_in, height_in), has_errors = figures.size_in(limits), any(track.errors_m is not None for track in tracks)
    figure = figures.new_figure(width_in + (4.1 if has_errors else 0.3), height_in + 1.05)
    axes = figures.add_axes(figure, (0.15, 0.65, width_in, height_in))
    if reference is not None:
        axes.plot(*reference[:, :2].T, color="#b9c0c8", lw=5.5, solid_capstyle="round", label="reference", zorder=2)
    for track in tracks:
        axes.plot(*track.positions[:, :2].T, label=track.label, zorder=4, **_style(track, tracks))
    if len(loops):
        figures.draw_loops(axes, loops, counted(len(loops), "loop"), LOOP)
    axes.plot(*tracks[-1].positions[:1, :2].T, "o", ms=6, color=INK, mec="white", zorder=7, label="start")
    figures.frame_map(axes, limits, "m")
    figures.set_title(axes, title, 11, loc="left", fontweight="bold")
    figures.add_legend(axes, columns=3, borderaxespad=0.2)
    if has_errors:
        panel_in = min(height_in, 3.0)
        _draw_errors(figures.add_axes(figure, (width_in + 0.75, 0.65 + height_in - panel_in, 3.1, panel_in)), tracks)
    return figure


def height_map_figure(
    title: str, points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], path: Float[np.ndarray, "k 3"]
) -> Figure:
    """Draws a map from above: the highest point of each pixel, by its height above the lidar that passed there.

    Under a roof, points more than a metre above the lidar are left out, so that the walls are visible.

    Args:
        title: title of the picture.
        points: metres, in the world.
        heights_m: of each point above the lidar.
        path: positions of the lidar.

    Returns:
        The figure.
    """
    if _is_roofed(points, heights_m, path):
        points, heights_m = points[heights_m < _ROOF_M], heights_m[heights_m < _ROOF_M]
    # Few far points must not determine the limits.
    low, high = np.quantile(points[:, :2], [0.005, 0.995], axis=0) if len(points) else (np.zeros(2), np.ones(2))
    limits = figures.plane_limits(np.vstack([path[:, :2], [low, high]]), 0.03)
    width_in, height_in = figures.size_in(limits)
    figure = figures.new_figure(width_in + 1.05, height_in + 0.75)
    axes = figures.add_axes(figure, (0.12, 0.37, width_in, height_in))
    figures.show_raster(axes, _raster(points, heights_m, limits, (int(160 * height_in), int(160 * width_in))), limits)
    axes.plot(*path[:, :2].T, color="white", lw=2.6, zorder=4)
    axes.plot(*path[:, :2].T, color=ACCENT, lw=1.3, zorder=5, label="path of the lidar")
    axes.plot(*path[:1, :2].T, "o", ms=5, color=ACCENT, mec="white", zorder=7, label="start")
    figures.frame_map(axes, limits, "m")
    figures.set_title(axes, title, 11, loc="left", fontweight="bold")
    figures.add_legend(axes, columns=2)
    bar_in = min(height_in, 3.0)
    bar = figures.add_axes(figure, (width_in + 0.27, 0.37 + (height_in - bar_in) / 2, 0.13, bar_in))
    shown = figure.colorbar(ScalarMappable(Normalize(*HEIGHTS_M), _height_colormap()), cax=bar, extend="both")
    shown.set_label("height above the lidar, m", fontsize=8, color=MUTED)
    bar.tick_params(labelsize=7, colors=MUTED)
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
    figure = figures.new_figure(width_in + 0.3, height_in + 0.75)
    axes = figures.add_axes(figure, (0.15, 0.37, width_in, height_in))
    figures.show_clouds(axes, [points], [POINTS], limits)
    # The rings lie on the arrows: a keyframe under a scan is visible, and so is the scan.
    keyframes = counted(len(path), "keyframe")
    axes.plot(*path[:, :2].T, "o", mfc="none", mec=INK, mew=0.8, ms=6, label=keyframes, zorder=7)
    length = HEAD_SHARE * max(limits.width, limits.height)
    right = (~wrong, OURS, "o", 4, "found (arrow: forward)")
    for mask, color, marker, size, label in (right, (wrong, ACCENT, "X", 7, "found elsewhere than the reference")):
        if mask.any():
            (x, y), (dx, dy) = T[mask, :2, 3].T, T[mask, :2, 0].T
            axes.quiver(x, y, dx, dy, color=color, scale=1 / length, scale_units="xy", width=0.0025, zorder=6)
            axes.plot(x, y, marker, color=color, ms=size, ls="none", label=f"{mask.sum()} {label}", zorder=6)
    figures.frame_map(axes, limits, "m")
    figures.add_legend(axes, columns=3)
    figures.set_title(axes, title, 11, loc="left", fontweight="bold")
    return figure


def height_colors(heights_m: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of heights above the lidar, for maps.

    Args:
        heights_m: metres.

    Returns:
        Red, green, blue from 0 to 255.
    """
    share = (np.asarray(heights_m, np.float64) - HEIGHTS_M[0]) / (HEIGHTS_M[1] - HEIGHTS_M[0])
    return np.asarray(_height_colormap()(np.clip(share, 0, 1), bytes=True))[:, :3]


def _height_colormap() -> Colormap:
    # The ground is pale on white paper; what stands on it goes from blue over violet to amber.
    high = matplotlib.colormaps["plasma"](np.linspace(0.05, 0.85, 8))
    colors = [(0.0, "#e3e7ec"), (0.15, "#cfd6de"), *zip(np.linspace(0.24, 1.0, 8), high, strict=True)]
    return LinearSegmentedColormap.from_list("dpmjax_height", colors)


def _is_roofed(
    points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], path: Float[np.ndarray, "k 3"]
) -> bool:
    """Returns True where points lie above most of the path, within a metre."""
    above = np.unique(np.floor(points[heights_m > _ROOF_M, :2]).astype(np.int64), axis=0)
    cells = np.unique(np.floor(path[:, :2]).astype(np.int64), axis=0)
    num_below = len(cells) + len(above) - len(np.unique(np.vstack([cells, above]), axis=0))
    return num_below > 0.7 * len(cells)


def _raster(
    points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], limits: Limits, shape: tuple[int, int]
) -> UInt8[np.ndarray, "r c 3"]:
    """Makes the picture: the highest point of each pixel; pixels without points are white."""
    pixel, is_inside = figures.pixels_of(points, limits, shape)
    highest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(highest, pixel, heights_m[is_inside])
    picture = np.where(np.isfinite(highest)[:, None], height_colors(highest), np.uint8(255))
    return picture.reshape(*shape, 3)


def _draw_errors(axes: Axes, tracks: Sequence[Track]) -> None:
    for track in tracks:
        if track.errors_m is not None:
            way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(track.positions, axis=0), axis=1))])
            axes.plot(way, track.errors_m, **{**_style(track, tracks), "lw": 1.2})
    figures.style_axes(axes, "distance driven, m")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    axes.set_title("distance to the aligned reference, m", fontsize=8.5, color=MUTED, loc="left")


def _style(track: Track, tracks: Sequence[Track]) -> dict[str, Any]:
    """Returns the line style of a track; the last one, the result, is thin, so that it does not hide the others."""
    others = [{"color": ODOMETRY, "lw": 2.4, "ls": (0, (3, 1.5))}, {"color": INK, "lw": 3.6, "ls": (0, (0.5, 1))}]
    number = next(number for number, other in enumerate(reversed(tracks)) if other is track)
    return others[(number - 1) % len(others)] if number else {"color": OURS, "lw": 1.3}


class LiveViewer:
    """Shows scans, keyframes, trajectory and loops while they are found.

    Keyframes are children of their poses: a loop that moves the map moves the picture.

    Args:
        name: name of the recording.
        path: file that is written without a screen, for viewers of the same version only.
    """

    def __init__(self, name: str, path: Path) -> None:
        import rerun

        self._rerun, self._recording = rerun, rerun.RecordingStream(f"dpmjax {name}")
        self._log = partial(rerun.log, recording=self._recording)
        self._T_world_keyframe = np.zeros((0, 4, 4))
        # A Linux machine without a display cannot open a window.
        if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
            rerun.spawn(recording=self._recording)
        else:
            rerun.save(path, recording=self._recording)

    def show_scan(self, number: int, points: Float[np.ndarray, "n 3"], T_world_scan: Float[np.ndarray, "4 4"]) -> None:
        """Shows the newest scan.

        Args:
            number: number of the scan.
            points: metres, in the frame of the lidar.
            T_world_scan: pose of the scan.
        """
        self._rerun.set_time("scan", sequence=number, recording=self._recording)
        self._log_pose("world/lidar", T_world_scan)
        self._log_points("world/lidar/points", points)

    def show_map(self, T_world_keyframe: np.ndarray, newest: np.ndarray, loops: np.ndarray) -> None:
        """Shows the map after a new keyframe.

        Args:
            T_world_keyframe: (k, 4, 4) poses of all keyframes, at least one.
            newest: (n, 3) points of the last keyframe, metres, in the frame of the lidar.
            loops: (m, 2, 3) positions of both ends of each accepted loop.
        """
        before, self._T_world_keyframe = self._T_world_keyframe, T_world_keyframe
        for row, T in enumerate(T_world_keyframe):
            if row >= len(before) or not np.array_equal(before[row], T):
                self._log_pose(f"world/keyframes/{row}", T)
        self._log_points(f"world/keyframes/{len(T_world_keyframe) - 1}/points", newest)
        lines = self._rerun.LineStrips3D
        self._log("world/trajectory", lines([T_world_keyframe[:, :3, 3]], colors=[_TRAJECTORY]))
        self._log("world/loops", lines(loops, colors=[_LOOP]))

    def close(self) -> None:
        """Writes the remaining data."""
        self._recording.flush()

    def _log_pose(self, entity: str, T: Float[np.ndarray, "4 4"]) -> None:
        self._log(entity, self._rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _log_points(self, entity: str, points: Float[np.ndarray, "n 3"]) -> None:
        self._log(entity, self._rerun.Points3D(points, colors=height_colors(points[:, 2]), radii=[_RADIUS_M]))
