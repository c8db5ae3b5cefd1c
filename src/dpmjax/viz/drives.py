"""Pictures of a SLAM run from above: trajectories with their loops, and the map by height."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from dpmjax.viz.figures import (
    ACCENT,
    INK,
    MUTED,
    Limits,
    add_axes,
    draw_loops,
    frame_map,
    new_figure,
    pixels_of,
    plane_limits,
    size_in,
    style_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

OURS, ODOMETRY, LOOP = "#1f4e8c", "#e08a1e", "#2a9d5c"
HEIGHTS_M = (-2.5, 5.5)
"""Heights above the lidar that the colours of maps span."""

_ROOF_M = 1.0


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
        tracks: the last one is the result; those before are drawn thinner.
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
    limits = plane_limits(np.concatenate(shown)[:, :2], 0.06)
    (width_in, height_in), has_errors = size_in(limits), any(track.errors_m is not None for track in tracks)
    total_in = (width_in + (4.1 if has_errors else 0.3), height_in + 1.05)
    figure = new_figure(*total_in)
    axes = add_axes(figure, (0.15, 0.65, width_in, height_in))
    if reference is not None:
        axes.plot(*reference[:, :2].T, color="#b9c0c8", lw=4.2, solid_capstyle="round", label="reference", zorder=2)
    for track in tracks:
        axes.plot(*track.positions[:, :2].T, label=track.label, zorder=4, **_style(track, tracks))
    if len(loops):
        draw_loops(axes, loops, f"{len(loops)} loops", LOOP)
    axes.plot(*tracks[-1].positions[:1, :2].T, "o", ms=6, color=INK, mec="white", zorder=7, label="start")
    frame_map(axes, limits, "m")
    axes.set_title(title, fontsize=11, color=INK, loc="left", fontweight="bold")
    axes.legend(
        loc="upper left", bbox_to_anchor=(-0.01, -0.01), ncols=3, frameon=False, fontsize=8, labelcolor=MUTED,
        borderaxespad=0.2,
    )  # fmt: skip
    if has_errors:
        panel_in = min(height_in, 3.0)
        _draw_errors(add_axes(figure, (width_in + 0.75, 0.65 + height_in - panel_in, 3.1, panel_in)), tracks)
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
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if _is_roofed(points, heights_m, path):
        points, heights_m = points[heights_m < _ROOF_M], heights_m[heights_m < _ROOF_M]
    # Few far points must not determine the limits.
    low, high = np.quantile(points[:, :2], [0.005, 0.995], axis=0) if len(points) else (np.zeros(2), np.ones(2))
    limits = plane_limits(np.vstack([path[:, :2], [low, high]]), 0.03)
    width_in, height_in = size_in(limits)
    figure = new_figure(width_in + 1.05, height_in + 0.5)
    axes = add_axes(figure, (0.12, 0.12, width_in, height_in))
    axes.imshow(
        _raster(points, heights_m, limits, int(160 * width_in), int(160 * height_in)),
        origin="lower",
        extent=limits,
        interpolation="nearest",
    )
    axes.plot(*path[:, :2].T, color=ACCENT, lw=1.0, zorder=4)
    frame_map(axes, limits, "m")
    axes.set_title(title, fontsize=11, color=INK, loc="left", fontweight="bold")
    bar_in = min(height_in, 3.0)
    bar = add_axes(figure, (width_in + 0.27, 0.12 + (height_in - bar_in) / 2, 0.13, bar_in))
    shown = figure.colorbar(ScalarMappable(Normalize(*HEIGHTS_M), _colormap()), cax=bar, extend="both")
    shown.set_label("height above the lidar, m", fontsize=8, color=MUTED)
    bar.tick_params(labelsize=7, colors=MUTED)
    return figure


def height_colors(heights_m: Float[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns the colours of heights above the lidar, for maps.

    Args:
        heights_m: metres.

    Returns:
        Red, green, blue from 0 to 255.
    """
    share = (np.asarray(heights_m, np.float64) - HEIGHTS_M[0]) / (HEIGHTS_M[1] - HEIGHTS_M[0])
    return np.asarray(_colormap()(np.clip(share, 0, 1), bytes=True))[:, :3]


def _colormap() -> Colormap:
    import matplotlib
    from matplotlib.colors import LinearSegmentedColormap

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
    points: Float[np.ndarray, "n 3"], heights_m: Float[np.ndarray, " n"], limits: Limits, columns: int, rows: int
) -> UInt8[np.ndarray, "r c 3"]:
    """Makes the picture: the highest point of each pixel; pixels without points are white."""
    pixel, is_inside = pixels_of(points, limits, columns, rows)
    highest = np.full(rows * columns, -np.inf)
    np.maximum.at(highest, pixel, heights_m[is_inside])
    picture = np.full((rows * columns, 3), 255, np.uint8)
    is_seen = np.isfinite(highest)
    picture[is_seen] = height_colors(highest[is_seen])
    return picture.reshape(rows, columns, 3)


def _draw_errors(axes: Axes, tracks: Sequence[Track]) -> None:
    for track in tracks:
        if track.errors_m is not None:
            way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(track.positions, axis=0), axis=1))])
            axes.plot(way, track.errors_m, **_style(track, tracks))
    style_axes(axes, "distance driven, m")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    axes.set_title("distance to the aligned reference, m", fontsize=8.5, color=MUTED, loc="left")


def _style(track: Track, tracks: Sequence[Track]) -> dict[str, Any]:
    """Returns the line style of a track; the last track is the result."""
    return {"color": OURS, "lw": 1.5} if track is tracks[-1] else {"color": ODOMETRY, "lw": 1.1, "ls": (0, (4, 2))}
