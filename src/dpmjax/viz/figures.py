"""Common parts of pictures: an empty figure, the frame of a map, a scale bar, and the file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

INK = "#1b1f24"
MUTED = "#6a737d"
FRAME = "#d6dadf"
ACCENT = "#d1495b"
_LONGER_SIDE_IN, _SHORTER_SIDE_IN = 6.4, 2.6
# A cell of a cloud is about two pixels wide, so that its colour can be seen.
_CELLS_PER_IN = 75


class Limits(NamedTuple):
    """A rectangle of the plane, in the unit of the map."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x_max - self.x_min

    @property
    def height(self) -> float:
        """Extent along y."""
        return self.y_max - self.y_min


def new_figure(width_in: float, height_in: float, layout: Literal["tight"] | None = None) -> Figure:
    """Returns a white figure that belongs to no window and to no global state; "tight" makes room for labels."""
    return Figure(figsize=(width_in, height_in), facecolor="white", layout=layout)


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 160) -> None:
    """Writes the figure as a PNG; the file appears whole or not at all."""
    path = Path(path)
    unfinished = path.with_name(f".{path.name}.tmp")
    try:
        figure.savefig(unfinished, dpi=dpi, format="png", facecolor=figure.get_facecolor())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def style_axes(axes: Axes, x_label: str = "", y_label: str = "") -> None:
    """Adds labels, a light grid, small ticks and a thin frame to the axes of a curve."""
    axes.set_xlabel(x_label, fontsize=9, color=INK)
    axes.set_ylabel(y_label, fontsize=9, color=INK)
    axes.grid(color=FRAME, lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def set_title(axes: Axes, text: str, size: float = 10.0, **style: Any) -> None:
    """Writes the title of axes."""
    axes.set_title(text, fontsize=size, color=INK, **style)


def add_legend(target: Axes | Figure, *entries: Any, columns: int, **place: Any) -> None:
    """Adds a small legend without a frame, in a number of columns, below the axes unless `place` says otherwise."""
    place = {"loc": "upper left", "bbox_to_anchor": (-0.01, -0.01), **place}
    target.legend(*entries, ncols=columns, frameon=False, fontsize=8, labelcolor=MUTED, **place)


def show_raster(axes: Axes, picture: np.ndarray, limits: Limits, **style: Any) -> AxesImage:
    """Draws a raster, its first row at the smallest y, with sharp pixels."""
    return axes.imshow(picture, origin="lower", extent=limits, interpolation="nearest", **style)


def annotate_corner(axes: Axes, text: str, offset: tuple[float, float], **style: Any) -> None:
    """Writes text at the upper left corner of the axes, shifted right and up by points."""
    style = {"fontsize": 8.5, "color": MUTED, **style}
    axes.annotate(text, (0, 1), xytext=offset, xycoords="axes fraction", textcoords="offset points", **style)


def frame_map(axes: Axes, limits: Limits, unit: str | None = None) -> None:
    """Sets equal axes, limits and a thin frame without ticks for a map panel; adds a scale bar if there is a unit."""
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=limits[:2], ylim=limits[2:], xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(FRAME)
        spine.set_linewidth(0.8)
    if unit is not None:
        _add_scale_bar(axes, limits, unit)


def _add_scale_bar(axes: Axes, limits: Limits, unit: str) -> None:
    """Draws a bar of a round length, about a fifth of the width, in the lower left corner."""
    length = round_length(limits.width / 5.0)
    x, y = limits.x_min + 0.04 * limits.width, limits.y_min + 0.04 * limits.height
    for color, width in (("white", 4.5), (INK, 2.0)):
        axes.plot([x, x + length], [y, y], color=color, linewidth=width, solid_capstyle="butt", zorder=8)
    box = {"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    style: Any = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 8, "color": INK}
    axes.annotate(f"{length:g} {unit}", (x + length / 2.0, y), xytext=(0, 4), bbox=box, zorder=9, **style)


def round_length(length: float) -> float:
    """Returns the largest of 1, 2, 5 times a power of ten that is not longer than `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))


def draw_trajectory(axes: Axes, trajectory_world: np.ndarray, color: str) -> None:
    """Draws the path of the sensor and marks where it starts."""
    axes.plot(*trajectory_world.T, color="white", linewidth=2.6, alpha=0.7, zorder=5, solid_joinstyle="round")
    axes.plot(*trajectory_world.T, color=color, linewidth=1.2, zorder=6, solid_joinstyle="round")
    axes.plot(*trajectory_world[:1].T, "o", markersize=6, color=color, markeredgecolor="white", zorder=7)


def format_length(length: float, unit: str) -> str:
    """Returns a length with three significant digits and three decimals at most: `16.1 px`, `0.012 m`, `< 0.001 px`."""
    if not np.isfinite(length):
        return f"{length} {unit}"
    if abs(length) < 1e-3:
        return f"< 0.001 {unit}"
    decimals = min(3, max(0, 2 - int(np.floor(np.log10(abs(length))))))
    return f"{length:.{decimals}f} {unit}"


def add_axes(figure: Figure, place_in: tuple[float, float, float, float]) -> Axes:
    """Adds axes at left, bottom, with width and height in inches."""
    (left, bottom, width, height), (whole, high) = place_in, figure.get_size_inches()
    return figure.add_axes((left / whole, bottom / high, width / whole, height / high))


def plane_limits(positions: Float[np.ndarray, "n 2"], margin_share: float, *, least_margin: float = 1.0) -> Limits:
    """Returns a rectangle round positions; that of a straight road has a useful height too.

    Args:
        positions: positions, at least one.
        margin_share: margin as a share of the longer side, added on all sides.
        least_margin: least margin, in the unit of the positions.

    Returns:
        The limits.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    margin = max(margin_share * float((high - low).max()), least_margin)
    narrow = np.maximum((high - low).max() * 0.35 - (high - low), 0) / 2
    (x_min, y_min), (x_max, y_max) = low - narrow - margin, high + narrow + margin
    return Limits(float(x_min), float(x_max), float(y_min), float(y_max))


def size_in(limits: Limits) -> tuple[float, float]:
    """Returns width and height of the panel of a map.

    Args:
        limits: limits of the map.

    Returns:
        Inches.
    """
    scale = _LONGER_SIDE_IN / max(limits.width, limits.height)
    return max(limits.width * scale, _SHORTER_SIDE_IN), max(limits.height * scale, _SHORTER_SIDE_IN)


def draw_loops(axes: Axes, loops: Float[np.ndarray, "m 2 3"], label: str, color: str) -> None:
    """Draws loops, at least one, as lines between the positions of their ends."""
    axes.add_collection(LineCollection(list(loops[:, :, :2]), colors=color, linewidths=1.0, zorder=5, label=label))
    axes.plot(*loops.reshape(-1, 3)[:, :2].T, ".", ms=3.2, color=color, zorder=6)


def pixels_of(
    points: Float[np.ndarray, "n d"], limits: Limits, shape: tuple[int, int]
) -> tuple[Int64[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
    """Returns the pixels of the points inside the limits in a flat raster of this shape, and True for points inside."""
    rows, columns = shape
    place = (points[:, :2] - [limits.x_min, limits.y_min]) / [limits.width / columns, limits.height / rows]
    column, row = np.floor(place).astype(np.int64).T
    is_inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return row[is_inside] * columns + column[is_inside], is_inside


def show_clouds(axes: Axes, clouds: Sequence[Float[np.ndarray, "_ d"]], colors: Sequence[str], limits: Limits) -> float:
    """Draws clouds from above in square cells; no cloud hides another.

    A cell with points of one cloud has the colour of this cloud, a cell with points of two or more clouds is black.

    Args:
        axes: axes of the map, of their final size.
        clouds: at least one; x and y are drawn.
        colors: color of each cloud.
        limits: limits of the map.

    Returns:
        The side of a cell in the unit of the map.
    """
    side = float(limits.width) / (_CELLS_PER_IN * axes.get_window_extent().width / axes.figure.dpi)
    shape = max(round(limits.height / side), 1), max(round(limits.width / side), 1)
    picture, num_clouds = np.ones((shape[0] * shape[1], 3)), np.zeros(shape[0] * shape[1], int)
    for cloud, color in zip(clouds, colors, strict=True):
        cells = np.unique(pixels_of(cloud, limits, shape)[0])
        picture[cells] = to_rgb(color)
        num_clouds[cells] += 1
    picture[num_clouds > 1] = to_rgb(INK)
    show_raster(axes, picture.reshape(*shape, 3), limits)
    return side


def cell_entry(color: str, label: str) -> Line2D:
    """Returns an entry of a legend: a square of this colour, as points of a cloud have it."""
    return Line2D([], [], color=color, marker="s", ms=5, ls="none", label=label)
