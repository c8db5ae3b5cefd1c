"""Picture of several agents: the map, the trajectory and the loops of each component, from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from dpmjax.viz import figures
from dpmjax.viz.figures import INK, MUTED, Limits

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours of the agents, in turn.
COLORS = ("#1f4e8c", "#d1495b", "#2a9d5c", "#e08a1e", "#7b4fa3", "#0f8b8d", "#8d6b3f", "#c04a9b")

GAP_IN, TITLE_IN, LEGEND_IN, DOTS_PER_IN = 0.2, 0.6, 0.8, 100

# Least height of drawn points relative to the lidar, which excludes the ground.
MIN_HEIGHT_M = -1.0


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
    figure = figures.new_figure(width_in, height_in + TITLE_IN + LEGEND_IN)
    left_in = GAP_IN
    for panel, size, each in zip(panels, sizes, limits, strict=True):
        axes = figures.add_axes(figure, (left_in, LEGEND_IN + height_in - size[1], *size))
        _draw_panel(axes, panel, each, size)
        left_in += size[0] + GAP_IN
    place = (GAP_IN / width_in, 1 - 0.1 / (height_in + TITLE_IN + LEGEND_IN))
    figure.text(*place, title, fontsize=11, color=INK, ha="left", va="top", fontweight="bold")
    return figure


def _draw_panel(axes: Axes, panel: AgentPanel, limits: Limits, size: tuple[float, float]) -> None:
    figures.show_raster(axes, _raster(panel, limits, (int(DOTS_PER_IN * size[1]), int(DOTS_PER_IN * size[0]))), limits)
    references = [agent.reference for agent in panel.agents if agent.reference is not None]
    for number, reference in enumerate(references):
        label = None if number else "reference"
        axes.plot(*reference[:, :2].T, color=INK, lw=0.6, ls=(0, (5, 3)), label=label, zorder=6)
    for agent in panel.agents:
        axes.plot(*agent.positions[:, :2].T, color="white", lw=4.4, zorder=3, solid_capstyle="round")
        axes.plot(*agent.positions[:, :2].T, color=agent.color, lw=2.6, label=agent.label, zorder=4)
        axes.plot(*agent.positions[:1, :2].T, "o", ms=5.5, color=agent.color, mec="white", zorder=8)
    if len(panel.loops):
        label = f"{len(panel.loops)} loop{'s' * (len(panel.loops) != 1)} between them"
        figures.draw_loops(axes, panel.loops, label, INK)
    figures.frame_map(axes, limits, "m")
    axes.set_title(panel.title, fontsize=9, color=MUTED, loc="left")
    figures.add_legend(axes, columns=max(int(size[0] / 1.6), 1), bbox_to_anchor=(-0.02, -0.01))


def _limits_of(panel: AgentPanel) -> Limits:
    """Returns the limits of the trajectories and of most points, without few far points."""
    shown = [agent.positions[:, :2] for agent in panel.agents]
    points = np.concatenate([agent.points[:, :2] for agent in panel.agents])
    if len(points):
        shown.append(np.quantile(points, [0.01, 0.99], axis=0))
    return figures.plane_limits(np.concatenate(shown), 0.03)


def _raster(panel: AgentPanel, limits: Limits, shape: tuple[int, int]) -> UInt8[np.ndarray, "r c 3"]:
    """Makes the picture: each pixel has the colour of the agents with points there, stronger for more points."""
    from matplotlib.colors import to_rgb

    size = shape[0] * shape[1]
    color, total = np.zeros((size, 3)), np.zeros(size)
    for agent in panel.agents:
        points = agent.points[agent.heights_m > MIN_HEIGHT_M, :2]
        count = np.bincount(figures.pixels_of(points, limits, shape)[0], minlength=size)
        color += count[:, None] * np.array(to_rgb(agent.color))
        total += count
    is_seen = total > 0
    strong = np.quantile(total[is_seen], 0.9) if is_seen.any() else 1.0
    alpha = np.where(is_seen, 0.35 + 0.6 * np.clip(total / max(strong, 1.0), 0, 1), 0.0)[:, None]
    mixed = alpha * color / np.maximum(total, 1)[:, None] + 1 - alpha
    return np.asarray(np.round(255 * mixed), np.uint8).reshape(*shape, 3)
