"""Pictures of several maps: methods of SLAM on several drives, the growth of their maps, and agents that meet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from dpmjax.sequences import counted
from dpmjax.viz import figures
from dpmjax.viz.figures import INK, MUTED, Limits

# Colours of the agents, in turn; the first two differ in lightness too, so that they differ in grey.
COLORS = ("#2f6fb5", "#e08a1e", "#2a9d5c", "#d1495b", "#7b4fa3", "#0f8b8d", "#8d6b3f", "#c04a9b")
GAP_IN, TITLE_IN, BELOW_IN = 0.2, 0.6, 0.8
# Points of the widest and the narrowest path; a narrower path lies on a wider one, so that none hides another.
_WIDEST, _NARROWEST = 6.0, 1.6
# Least height of drawn points of agents relative to the lidar, which excludes the ground.
MIN_HEIGHT_M = -1.0
_COLUMNS = 4
_CURVE_COLORS = ("#8a929b", "#e08a1e", "#1f4e8c", "#4f8fcf", "#2a9d5c", "#7a5aa6")
_MARGIN = 0.12
# Inches: side of a panel; width of a character of the legend, height of a line.
_PANEL_IN, _CHARACTER_IN, _LINE_IN = 3.1, 0.065, 0.18
# Characters that the line and the gaps of an entry of the legend take.
_NUM_BESIDE = 9
# Trajectories are cut at this share of the extent of the reference beyond it, so that a diverged one does not set the
# limits.
_SHARE_OUTSIDE = 0.5


class TrackPanel(NamedTuple):
    """The trajectories of one drive, all in one frame.

    Attributes:
        tracks: (n, 3) positions by method, metres.
        reference: (n, 3) true positions; None where there are none.
    """

    tracks: Mapping[str, Float[np.ndarray, "n 3"]]
    reference: Float[np.ndarray, "n 3"] | None


def trajectories_figure(panels: Mapping[str, TrackPanel], colors: Mapping[str, str]) -> Figure:
    """Draws a small panel for each drive, from above, with all methods and the reference.

    Args:
        panels: by name of the drive.
        colors: by method; the legend has their order.

    Returns:
        The figure.

    Raises:
        ValueError: no panel, or a method without a colour.
    """
    methods = {method for panel in panels.values() for method in panel.tracks}
    if not panels or not methods <= set(colors):
        raise ValueError(f"expected panels, and colours of {sorted(methods)}; got colours of {sorted(colors)}")
    figure, grid = _panels(len(panels), _PANEL_IN)
    for axes, (name, panel) in zip(grid, panels.items(), strict=True):
        if panel.reference is not None:
            axes.plot(*panel.reference[:, :2].T, color="#b9c0c8", lw=3.6, solid_capstyle="round", label="reference")
        for method in [method for method in colors if method in panel.tracks]:
            axes.plot(*panel.tracks[method][:, :2].T, color=colors[method], lw=1.0, label=method)
        figures.frame_map(axes, figures.plane_limits(_shown(panel), _MARGIN), "m")
        figures.set_title(axes, name, 8.5)
    shown = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in grid]
    entries = {label: handle for handles in shown for handle, label in handles}
    _add_legend(figure, entries)
    return figure


def _panels(num: int, height_in: float, *, is_y_shared: bool = False) -> tuple[Figure, list[Axes]]:
    """Makes a figure of several panels; `_add_legend` adds the space of the legend."""
    columns = min(num, _COLUMNS)
    num_rows = math.ceil(num / columns)
    figure = figures.new_figure(_PANEL_IN * columns, height_in * num_rows)
    grid = figure.subplots(num_rows, columns, squeeze=False, sharey=is_y_shared).ravel().tolist()
    for axes in grid[num:]:
        axes.set_axis_off()
    return figure, grid[:num]


def _add_legend(figure: Figure, entries: Mapping[str, Artist]) -> None:
    """Adds one legend for all panels, below them."""
    entry_in = _CHARACTER_IN * (_NUM_BESIDE + max(map(len, entries)))
    num_columns = max(int(figure.get_figwidth() / entry_in), 1)
    legend_in = _LINE_IN * (1 + math.ceil(len(entries) / num_columns))
    figure.set_figheight(figure.get_figheight() + legend_in)
    figure.tight_layout(rect=(0, legend_in / figure.get_figheight(), 1, 1))
    place = {"loc": "lower center", "bbox_to_anchor": None}
    figures.add_legend(figure, entries.values(), entries.keys(), columns=num_columns, **place)


def _shown(panel: TrackPanel) -> NDArray[np.float64]:
    """Returns the positions that set the limits; trajectories are clipped near the reference."""
    everything = np.concatenate([positions[:, :2] for positions in panel.tracks.values()] or [np.zeros((1, 2))])
    if panel.reference is None:
        return np.asarray(everything, np.float64)
    low, high = panel.reference[:, :2].min(axis=0), panel.reference[:, :2].max(axis=0)
    spare = _SHARE_OUTSIDE * (high - low).max()
    return np.vstack([panel.reference[:, :2], np.clip(everything, low - spare, high + spare)])


def growth_figure(
    panels: Mapping[str, Mapping[str, tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]]],
) -> Figure:
    """Draws the bytes of the forms of a map over the metres driven, on a logarithmic axis.

    Args:
        panels: by name of the drive and of the form: metres driven, and bytes.

    Returns:
        The figure.

    Raises:
        ValueError: no panel.
    """
    if not panels:
        raise ValueError("panels: expected at least one")
    figure, grid = _panels(len(panels), 0.85 * _PANEL_IN, is_y_shared=True)
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    colors = {name: _CURVE_COLORS[number % len(_CURVE_COLORS)] for number, name in enumerate(names)}
    entries: dict[str, Artist] = {}
    for axes, (drive, curves) in zip(grid, panels.items(), strict=True):
        for name, (metres, sizes) in curves.items():
            (entries[name],) = axes.plot(metres, sizes / 1e6, "-o", ms=2.5, lw=1.3, color=colors[name])
        axes.set_yscale("log")
        axes.set_xlim(left=0)
        figures.set_title(axes, drive, 8.5)
        figures.style_axes(axes, "distance driven, m", "map, MB" if axes is grid[0] else "")
    _add_legend(figure, entries)
    return figure


class AgentTrack(NamedTuple):
    """Points and trajectory of one agent.

    Attributes:
        label: label for the legend.
        color: color of the agent.
        positions: (n, 3) metres.
        reference: (n, 3) in the same frame; None where there is none.
        points: (m, 3) measured points.
        heights_m: (m,) of the points above the lidar.
    """

    label: str
    color: str
    positions: Float[np.ndarray, "n 3"]
    reference: Float[np.ndarray, "n 3"] | None
    points: Float[np.ndarray, "m 3"]
    heights_m: Float[np.ndarray, " m"]


class AgentPanel(NamedTuple):
    """Agents that share one frame.

    Attributes:
        title: title of the panel.
        agents: agents, at least one.
        loops: (l, 2, 3) positions of both ends of each loop between agents.
    """

    title: str
    agents: Sequence[AgentTrack]
    loops: Float[np.ndarray, "l 2 3"]


def agents_figure(title: str, panels: Sequence[AgentPanel]) -> Figure:
    """Draws the maps of agents from above; unconnected agents have separate panels.

    Args:
        title: title of the picture.
        panels: one for each component.

    Returns:
        The figure.
    """
    limits = [_limits_of(panel) for panel in panels]
    sizes = [figures.size_in(each) for each in limits]
    width_in = sum(size[0] + GAP_IN for size in sizes) + GAP_IN
    height_in = max(size[1] for size in sizes)
    figure = figures.new_figure(width_in, height_in + TITLE_IN + BELOW_IN)
    left_in = GAP_IN
    for panel, size, each in zip(panels, sizes, limits, strict=True):
        axes = figures.add_axes(figure, (left_in, BELOW_IN + height_in - size[1], *size))
        _draw_panel(axes, panel, each, size)
        left_in += size[0] + GAP_IN
    place = (GAP_IN / width_in, 1 - 0.1 / (height_in + TITLE_IN + BELOW_IN))
    figure.text(*place, title, fontsize=11, color=INK, ha="left", va="top", fontweight="bold")
    return figure


def _draw_panel(axes: Axes, panel: AgentPanel, limits: Limits, size: tuple[float, float]) -> None:
    clouds = [agent.points[agent.heights_m > MIN_HEIGHT_M] for agent in panel.agents]
    figures.show_clouds(axes, clouds, [agent.color for agent in panel.agents], limits)
    references = [agent.reference for agent in panel.agents if agent.reference is not None]
    for number, reference in enumerate(references):
        label = None if number else "reference"
        axes.plot(*reference[:, :2].T, color=INK, lw=0.6, ls=(0, (5, 3)), label=label, zorder=6)
    widths = np.linspace(_WIDEST, _NARROWEST, len(panel.agents)) if len(panel.agents) > 1 else [_NARROWEST]
    for agent, width in zip(panel.agents, widths, strict=True):
        path = agent.positions[:, :2].T
        axes.plot(*path, color="white", lw=width + 1.6, zorder=4, solid_capstyle="round")
        axes.plot(*path, color=agent.color, lw=width, label=agent.label, zorder=4, solid_capstyle="round")
        axes.plot(*path[:, :1], "o", ms=width + 4, color=agent.color, mec="white", zorder=8)
    if len(panel.loops):
        label = f"{counted(len(panel.loops), 'loop')} between them"
        figures.draw_loops(axes, panel.loops, label, INK)
    figures.frame_map(axes, limits, "m")
    axes.set_title(panel.title, fontsize=9, color=MUTED, loc="left")
    entries = axes.get_legend_handles_labels()[0]
    if len(panel.agents) > 1:
        entries.append(figures.cell_entry(INK, "points of two or more"))
    entries.append(Line2D([], [], color=MUTED, marker="o", mec="white", ls="none", label="start"))
    figures.add_legend(axes, handles=entries, columns=max(int(size[0] / 1.6), 1), bbox_to_anchor=(-0.02, -0.01))


def _limits_of(panel: AgentPanel) -> Limits:
    """Returns the limits of the trajectories and of most points, without few far points."""
    shown = [agent.positions[:, :2] for agent in panel.agents]
    points = np.concatenate([agent.points[:, :2] for agent in panel.agents])
    if len(points):
        shown.append(np.quantile(points, [0.01, 0.99], axis=0))
    return figures.plane_limits(np.concatenate(shown), 0.03)
