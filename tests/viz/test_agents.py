"""Pictures of several agents."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb

from dpmjax import viz
from dpmjax.viz.figures import INK


def track(color: str, offset_m: float, *, num_points: int = 400) -> viz.AgentTrack:
    rng = np.random.default_rng(0)
    positions = np.column_stack([np.arange(20.0), np.full(20, offset_m), np.zeros(20)])
    points = rng.uniform([0, offset_m - 2, 0], [20, offset_m + 2, 1], (num_points, 3))
    return viz.AgentTrack("agent", color, positions, None, points, np.zeros(num_points))


def test_agents_of_one_frame_share_a_panel() -> None:
    panels = [viz.AgentPanel("two", [track("#ff0000", 0.0), track("#0000ff", 10.0)], np.zeros((3, 2, 3)))]
    panels.append(viz.AgentPanel("one", [track("#00ff00", 0.0)], np.zeros((0, 2, 3))))
    figure = viz.agents_figure("agents", panels)
    assert [axes.get_title("left") for axes in figure.axes] == ["two", "one"]
    for axes, panel in zip(figure.axes, panels, strict=True):
        colors = {line.get_color() for line in axes.lines}
        assert {agent.color for agent in panel.agents} <= colors
        assert axes.get_aspect() == 1.0
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert {"agent", "3 loops between them", "points of two or more"} <= set(labels)


def test_a_path_on_another_one_does_not_hide_it() -> None:
    agents = [track(color, 0.0) for color in viz.COLORS[:4]]
    (axes,) = viz.agents_figure("agents", [viz.AgentPanel("four", agents, np.zeros((0, 2, 3)))]).axes
    drawn = [line.get_linewidth() for line in axes.lines if line.get_label() == "agent"]
    assert len(drawn) == len(agents)
    assert max(np.diff(drawn)) < 0


def test_a_pixel_has_the_colour_of_who_saw_it() -> None:
    agents = [track("#ff0000", 0.0), track("#0000ff", 20.0)]
    figure = viz.agents_figure("agents", [viz.AgentPanel("two", agents, np.zeros((0, 2, 3)))])
    (image,) = figure.axes[0].images
    shown = np.asarray(image.get_array())
    height = len(shown)
    low, high = shown[: height // 2].reshape(-1, 3), shown[height // 2 :].reshape(-1, 3)
    for half, color in ((low, "#ff0000"), (high, "#0000ff")):
        darkest = half[half.sum(axis=1).argmin()]
        assert np.argmax(darkest) == np.argmax(to_rgb(color))


def test_agents_that_saw_nothing_are_drawn() -> None:
    nothing = track("#ff0000", 0.0, num_points=0)
    assert viz.agents_figure("agents", [viz.AgentPanel("one", [nothing], np.zeros((0, 2, 3)))]).axes


def test_points_of_two_agents_at_one_place_have_a_colour_of_their_own() -> None:
    agents = [track("#ff0000", 0.0), track("#0000ff", 0.0)]
    (axes,) = viz.agents_figure("agents", [viz.AgentPanel("two", agents, np.zeros((0, 2, 3)))]).axes
    picture = np.asarray(axes.images[0].get_array()).reshape(-1, 3)
    seen = np.unique(picture[(picture != 1.0).any(axis=1)], axis=0)
    np.testing.assert_allclose(seen, [to_rgb(INK)])
