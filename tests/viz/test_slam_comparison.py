"""Pictures of several SLAM methods: what they show, and that a lost method does not shrink the others."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax import viz

WAY = np.column_stack([np.linspace(0, 100, 20), np.zeros(20), np.zeros(20)])


def test_every_method_has_its_colour_and_a_lost_one_leaves_the_panel() -> None:
    panels = {
        "street": viz.TrackPanel({"ours": WAY + 0.1, "lost": 50 * WAY}, WAY),
        "no reference": viz.TrackPanel({"ours": WAY}, None),
    }
    figure = viz.trajectories_figure(panels, {"ours": "blue", "lost": "red"})
    street, other = figure.axes
    assert [street.get_title(), other.get_title()] == list(panels)
    colors = {line.get_label(): line.get_color() for line in street.lines}
    assert (colors["ours"], colors["lost"]) == ("blue", "red")
    assert street.get_xlim()[1] < 300
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"reference", "ours", "lost"}


@pytest.mark.parametrize("num_drives", [1, 5])
def test_the_legend_lies_below_the_panels_and_within_the_figure(num_drives: int) -> None:
    names = [f"method {number} with a long name" for number in range(6)]
    panel = viz.TrackPanel(dict.fromkeys(names, WAY[:, [1, 0, 2]]), WAY[:, [1, 0, 2]])
    figure = viz.trajectories_figure({f"{n}": panel for n in range(num_drives)}, dict.fromkeys(names, "blue"))
    figure.canvas.draw()
    box, lowest = figure.legends[0].get_window_extent(), min(axes.get_window_extent().y0 for axes in figure.axes)
    assert 0 <= box.y0 < box.y1 < lowest
    assert 0 <= box.x0 < box.x1 <= figure.bbox.x1


def test_maps_are_drawn_in_megabytes_on_a_logarithmic_axis() -> None:
    curve = (np.array([10.0, 50.0]), np.array([1e6, 5e6]))
    figure = viz.growth_figure({"street": {"points": curve}, "room": {"points": curve, "ours": curve}})
    assert [axes.get_yscale() for axes in figure.axes] == ["log", "log"]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), [1, 5])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["points", "ours"]


def test_pictures_of_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="panel"):
        viz.growth_figure({})
    with pytest.raises(ValueError, match="panels"):
        viz.trajectories_figure({}, {})
    with pytest.raises(ValueError, match="colours"):
        viz.trajectories_figure({"street": viz.TrackPanel({"ours": WAY}, WAY)}, {})
