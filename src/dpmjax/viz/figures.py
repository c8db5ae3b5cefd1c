"""Pictures of maps: a figure has panels, a panel has layers, a layer is points, a track or edges with a colour."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

# One colour for one thing in all pictures; wrong answers are red.
PATH, ODOMETRY, REFERENCE, LOOP, POINTS, WRONG = "#1f4e8c", "#e08a1e", "#b9c0c8", "#2a9d5c", "#9aa3ad", "#d1495b"
INK, MUTED, FRAME = "#1b1f24", "#6a737d", "#d6dadf"
# Colours of several maps, in turn; the first two differ in lightness too, so that they differ in grey.
AGENTS = ("#2f6fb5", ODOMETRY, LOOP, WRONG, "#7b4fa3", "#0f8b8d", "#8d6b3f", "#c04a9b")
# Inches: longer side of a panel by the number of columns; height of a line and width of a character.
_SIDES_IN, _SMALL_SIDE_IN, _GAP_IN, _LINE_IN, _CHARACTER_IN = {1: 6.4, 2: 4.6, 3: 4.2}, 3.1, 0.15, 0.19, 0.068


class Points(NamedTuple):
    """A cloud from above: each cell that has a point is painted, cells of two clouds are black.

    Attributes:
        positions: (n, d), of which x and y are drawn.
        color: one colour, or one for each point; the last point of a cell is seen.
        label: label for the legend.
    """

    positions: Float[np.ndarray, "n d"]
    color: str | UInt8[np.ndarray, "n 3"] = POINTS
    label: str = ""


class Track(NamedTuple):
    """A path, or marks.

    Attributes:
        positions: (n, d), of which x and y are drawn.
        color: its colour.
        label: label for the legend.
        style: format of matplotlib: "-" is a path whose start is a dot, "--" a dashed one, "o" draws marks alone.
        width: width of the path or of a mark, points.
    """

    positions: Float[np.ndarray, "n d"]
    color: str = PATH
    label: str = ""
    style: str = "-"
    width: float = 1.5


class Edges(NamedTuple):
    """Lines between pairs of positions.

    Attributes:
        ends: (m, 2, d), of which x and y are drawn.
        color: their colour.
        label: label for the legend.
        style: "-" or "--".
    """

    ends: Float[np.ndarray, "m 2 d"]
    color: str = LOOP
    label: str = ""
    style: str = "-"


Layer = Points | Track | Edges


class Limits(NamedTuple):
    """A rectangle of the plane, in the unit of the map."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    @property
    def sides(self) -> np.ndarray:
        """Extent along x and y."""
        return np.array([self.x_max - self.x_min, self.y_max - self.y_min])


class Panel(NamedTuple):
    """One map from above.

    Attributes:
        title: title; long lines are wrapped.
        layers: points, lines and texts of the panel, drawn in this order.
        reference: (n, d) true positions; rows of NaN interrupt the path. None where there are none.
        limits: shown part of the plane; None shows all layers.
    """

    title: str
    layers: Sequence[Layer]
    reference: Float[np.ndarray, "n d"] | None = None
    limits: Limits | None = None


class Bar(NamedTuple):
    """A bar that says which number a colour stands for."""

    label: str
    colormap: Colormap
    low: float
    high: float


def figure(
    panels: Sequence[Panel],
    *,
    title: str = "",
    unit: str = "m",
    num_columns: int = 4,
    is_shared: bool = False,
    bar: Bar | None = None,
) -> Figure:
    """Draws panels in rows, each with a scale bar, and one legend below.

    Args:
        panels: at least one.
        title: title of the picture.
        unit: unit of the positions, for the scale bars.
        num_columns: most panels of a row.
        is_shared: True gives all panels of a row the same limits: those of the last one, extended by at most half its
            size to show the panels before it.
        bar: bar of colours at the right.

    Returns:
        The figure; its axes are those of the panels, then the bar.

    Raises:
        ValueError: no panel.
    """
    if not panels:
        raise ValueError("panels: expected at least one")
    columns = min(num_columns, len(panels))
    rows = [panels[first : first + columns] for first in range(0, len(panels), columns)]
    limits = [each for row in rows for each in _limits_of_row(row, is_shared)]
    side_in = _SIDES_IN.get(columns, _SMALL_SIDE_IN)
    sizes_in = [each.sides * side_in / each.sides.max() for each in limits]
    widths = [max(size[0] for size in sizes_in[column::columns]) + _GAP_IN for column in range(columns)]
    titles = [_wrapped(panel.title, size[0]) for panel, size in zip(panels, sizes_in, strict=True)]
    lines = _LINE_IN * (1 + max(text.count("\n") for text in titles))
    heights = [max(size[1] for size in sizes_in[row * columns :][:columns]) + lines for row in range(len(rows))]
    width_in = sum(widths) + (0.8 if bar else 0)
    entries = _entries(panels)
    num_in_line = max(int(width_in / (_CHARACTER_IN * (9 + max(map(len, entries), default=0)))), 1)
    below_in = _LINE_IN * (1 + math.ceil(len(entries) / num_in_line)) + (2 * _LINE_IN if title else 0)
    drawn = Figure((width_in, sum(heights) + below_in), facecolor="white", layout="compressed")
    grid = drawn.subplots(len(rows), columns, squeeze=False, width_ratios=widths, height_ratios=heights).ravel()
    for axes in grid[len(panels) :]:
        axes.remove()
    for axes, panel, text, each, size in zip(grid, panels, titles, limits, sizes_in, strict=False):
        # A cell of a cloud is about two pixels wide, so that its colour can be seen.
        _draw_panel(axes, panel, each, round(75 * size[0]))
        axes.set_title(text, fontsize=9, color=INK, loc="left")
        frame_map(axes, each, unit)
    if title:
        drawn.suptitle(title, x=0.01, ha="left", fontsize=11, color=INK, fontweight="bold")
    if entries:
        add_legend(drawn, entries, num_in_line)
    if bar:
        shown = ScalarMappable(Normalize(bar.low, bar.high), bar.colormap)
        beside: Any = grid[: len(panels)].tolist()
        drawn.colorbar(shown, ax=beside, shrink=0.7, aspect=30, pad=0.02).set_label(bar.label, fontsize=8, color=MUTED)
        drawn.axes[-1].tick_params(labelsize=7, colors=MUTED)
    return drawn


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 160) -> None:
    """Writes the figure as a PNG."""
    figure.savefig(path, dpi=dpi, format="png", facecolor=figure.get_facecolor())


def add_legend(drawn: Figure, entries: dict[str, Any], num_columns: int) -> None:
    """Adds a small legend without a frame below the axes."""
    style: Any = {"frameon": False, "fontsize": 8, "labelcolor": MUTED, "loc": "outside lower left"}
    drawn.legend(list(entries.values()), list(entries), ncols=num_columns, **style)


def frame_map(axes: Axes, limits: Limits, unit: str) -> None:
    """Sets equal axes, limits and a thin frame without ticks; adds a bar of a round length, a fifth of the width."""
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=limits[:2], ylim=limits[2:], xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.8)
    length = round_length(limits.sides[0] / 5.0)
    x, y = np.array(limits[::2]) + 0.04 * limits.sides
    for color, width in (("white", 4.5), (INK, 2.0)):
        axes.plot([x, x + length], [y, y], color=color, linewidth=width, solid_capstyle="butt", zorder=8)
    box = {"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    style: Any = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 8, "color": INK}
    axes.annotate(f"{length:g} {unit}", (x + length / 2.0, y), xytext=(0, 4), bbox=box, zorder=9, **style)


def show_raster(axes: Axes, picture: np.ndarray, limits: Limits, **style: Any) -> AxesImage:
    """Draws a raster, its first row at the smallest y, with sharp pixels."""
    return axes.imshow(picture, origin="lower", extent=limits, interpolation="nearest", aspect="equal", **style)


def round_length(length: float) -> float:
    """Returns the largest of 1, 2, 5 times a power of ten that is not longer than `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))


def format_length(length: float, unit: str) -> str:
    """Returns a length with three significant digits and three decimals at most: `16.1 px`, `0.012 m`, `< 0.001 px`."""
    if not np.isfinite(length):
        return f"{length} {unit}"
    if abs(length) < 1e-3:
        return f"< 0.001 {unit}"
    return f"{length:.{min(3, max(0, 2 - int(np.floor(np.log10(abs(length))))))}f} {unit}"


def _limits_of_row(panels: Sequence[Panel], is_shared: bool) -> list[Limits]:
    """Returns limits that show references and layers; what diverges is cut at half an extent beyond."""
    boxes = []
    for panel in panels:
        box = _box(panel.layers)
        boxes.append(box if panel.reference is None else _cut(box, _box([Track(panel.reference)])))
    if is_shared:
        boxes = [_cut(np.concatenate(boxes), boxes[-1])] * len(panels)
    return [panel.limits or _with_margin(box) for panel, box in zip(panels, boxes, strict=True)]


def _box(layers: Sequence[Layer]) -> np.ndarray:
    """Returns the lowest and the highest x and y (2, 2) of the layers, without few far points."""
    corners = []
    for layer in layers:
        positions = np.asarray(layer[0], np.float64)
        positions = positions.reshape(-1, positions.shape[-1])[:, :2]
        positions = positions[np.isfinite(positions).all(axis=1)]
        if len(positions):
            # Few far points must not determine the limits.
            share = 0.005 if isinstance(layer, Points) else 0.0
            corners.append(np.quantile(positions, [share, 1 - share], axis=0))
    return np.vstack([np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))]) if corners else np.zeros((2, 2))


def _cut(positions: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Returns the box of positions and box; positions farther beyond it than half its extent are cut."""
    spare = 0.5 * float(np.ptp(box, axis=0).max())
    everything = np.vstack([np.clip(positions, box[0] - spare, box[1] + spare), box])
    return np.vstack([everything.min(axis=0), everything.max(axis=0)])


def _with_margin(box: np.ndarray) -> Limits:
    """Returns limits a little wider than a box; those of a straight road have a useful height too."""
    longer = float(np.ptp(box, axis=0).max()) or 1.0
    spare = np.maximum(0.4 * longer - np.ptp(box, axis=0), 0.0) / 2.0 + 0.04 * longer
    (x_min, y_min), (x_max, y_max) = (box + np.stack([-spare, spare])).tolist()
    return Limits(x_min, x_max, y_min, y_max)


def _wrapped(text: str, width_in: float) -> str:
    return "\n".join(textwrap.fill(line, int(width_in / _CHARACTER_IN)) for line in text.split("\n"))


def _entries(panels: Sequence[Panel]) -> dict[str, Any]:
    """Returns the entries of the legend, one for each label: references, tracks and edges, clouds."""
    entries: dict[str, Any] = {}
    square: Any = {"marker": "s", "ms": 5, "ls": "none"}
    for panel in panels:
        if panel.reference is not None:
            entries["reference"] = {"color": REFERENCE, "lw": 6}
        for layer in panel.layers:
            if isinstance(layer, Track):
                entries[layer.label] = _style_of(layer)
            elif isinstance(layer, Edges) and len(layer.ends):
                entries[layer.label] = {"color": layer.color, "ls": layer.style, "lw": 1.0}
            elif isinstance(layer, Points) and isinstance(layer.color, str):
                entries[layer.label] = {"color": layer.color, **square}
        if sum(isinstance(layer, Points) for layer in panel.layers) > 1:
            entries["points of two or more"] = {"color": INK, **square}
    return {label: Line2D([], [], **style) for label, style in entries.items() if label}


def _style_of(track: Track) -> dict[str, Any]:
    """Returns the style of a line: a path with a dot at its start, or marks."""
    if track.style not in ("-", "--"):
        edge = {"mec": "white", "mew": 0.5} if track.style in "o^X" else {}
        return {"color": track.color, "ls": "none", "marker": track.style, "ms": track.width, **edge}
    start = {"marker": "o", "markevery": [0], "ms": track.width + 4, "mec": "white"} if track.style == "-" else {}
    return {"color": track.color, "ls": track.style, "lw": track.width, "solid_capstyle": "round", **start}


def _draw_panel(axes: Axes, panel: Panel, limits: Limits, num_columns: int) -> None:
    clouds = [layer for layer in panel.layers if isinstance(layer, Points)]
    if clouds:
        num_points = sum(len(cloud.positions) for cloud in clouds)
        num_columns = min(num_columns, max(60, round(2 * num_points**0.5)))
        show_raster(axes, _cells(clouds, limits, num_columns), limits)
    if panel.reference is not None:
        axes.plot(*panel.reference[:, :2].T, color=REFERENCE, lw=6, solid_capstyle="round", zorder=3)
    for layer in panel.layers:
        if isinstance(layer, Track) and len(layer.positions):
            outline = [withStroke(linewidth=layer.width + 1.6, foreground="white", alpha=0.7)]
            effects = outline if layer.style == "-" else None
            axes.plot(*layer.positions[:, :2].T, zorder=5, path_effects=effects, **_style_of(layer))
        elif isinstance(layer, Edges) and len(layer.ends):
            style: Any = {"colors": layer.color, "linestyles": layer.style, "linewidths": 1.0, "zorder": 6}
            axes.add_collection(LineCollection(list(layer.ends[:, :, :2]), **style))


def _cells(clouds: Sequence[Points], limits: Limits, num_columns: int) -> np.ndarray:
    """Paints the cells (rows, columns, 3) of the clouds, from 0 to 255; cells of two or more clouds are black."""
    side = limits.sides[0] / num_columns
    shape = max(round(limits.sides[1] / side), 1), num_columns
    picture, num_clouds = np.full((shape[0] * shape[1], 3), 255, np.uint8), np.zeros(shape[0] * shape[1], int)
    for positions, color, _ in clouds:
        colors = np.rint(255 * np.array(to_rgb(color))) if isinstance(color, str) else color
        place = np.floor((np.asarray(positions)[:, :2] - [limits.x_min, limits.y_min]) / side)
        is_inside = ((place >= 0) & (place < shape[::-1])).all(axis=1)
        column, row = place[is_inside].astype(np.int64).T
        cells = row * num_columns + column
        picture[cells] = np.broadcast_to(colors, (len(place), 3))[is_inside]
        num_clouds[np.unique(cells)] += 1
    picture[num_clouds > 1] = np.rint(255 * np.array(to_rgb(INK)))
    return picture.reshape(*shape, 3)
