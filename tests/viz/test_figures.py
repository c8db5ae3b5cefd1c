"""Panels: all layers lie at their places in one frame. Curves: phases in order, gaps left out, reliability by bins."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from dpmjax import viz
from dpmjax.viz import Edges, Panel, Points, Track
from dpmjax.viz.figures import INK, REFERENCE
from tests.processes import run_python

RED, BLUE = "#ff0000", "#0000ff"


def circle(num: int = 50, radius: float = 20.0) -> np.ndarray:
    angles = np.linspace(0, 6, num)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles])


def labels(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def colors_of(axes) -> set[tuple[int, ...]]:
    picture = np.asarray(axes.images[0].get_array()).reshape(-1, 3)
    return {tuple(color) for color in np.unique(picture, axis=0).tolist()} - {(255, 255, 255)}


def as_bytes(color: str) -> tuple[int, ...]:
    return tuple(round(255 * share) for share in to_rgb(color))


def test_layers_are_drawn_where_they_are_and_named_once():
    track, ends = circle(), np.stack([circle()[:3], circle()[-3:]], axis=1)
    layers = [Points(track, RED, "points"), Track(track, BLUE, "path"), Edges(ends, RED, "3 loops")]
    figure = viz.figure([Panel("a", layers, track), Panel("b", layers)], title="both", unit="px")
    assert labels(figure) == ["reference", "points", "path", "3 loops"]
    assert [axes.get_title("left") for axes in figure.axes] == ["a", "b"]
    lines = [line for line in figure.axes[0].lines if len(line.get_xydata()) == 50]
    assert [line.get_color() for line in lines] == [REFERENCE, BLUE]
    for line in lines:
        np.testing.assert_array_equal(line.get_xydata(), track[:, :2])
    np.testing.assert_array_equal(figure.axes[0].collections[0].get_segments(), ends[..., :2])
    assert any(text.get_text().endswith(" px") for text in figure.axes[0].texts)
    assert figure.axes[0].get_aspect() == 1.0


def test_a_cell_has_the_colour_of_its_cloud_and_is_black_where_two_meet():
    rng = np.random.default_rng(0)
    low, high = rng.uniform([0, 0], [20, 2], (400, 2)), rng.uniform([0, 18], [20, 20], (400, 2))
    axes = viz.figure([Panel("", [Points(low, RED), Points(high, BLUE), Points(high, BLUE)])]).axes[0]
    assert colors_of(axes) == {as_bytes(RED), as_bytes(INK)}
    picture = np.asarray(axes.images[0].get_array())
    assert (picture[: len(picture) // 2] == as_bytes(RED)).all(axis=-1).any()
    assert not (picture[len(picture) // 2 :] == as_bytes(RED)).all(axis=-1).any()


def test_a_track_that_leaves_the_reference_does_not_shrink_it():
    (axes,) = viz.figure([Panel("", [Track(50 * circle(), RED)], circle())]).axes
    assert 40 < np.ptp(axes.get_xlim()) < 100


def test_panels_of_a_shared_row_have_the_limits_of_the_last_one_and_no_more_than_half_beyond():
    panels = [Panel("", [Track(each)]) for each in (1000 * circle(), circle() + 5, circle())]
    figure = viz.figure(panels, is_shared=True)
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in figure.axes}) == 1
    assert np.ptp(figure.axes[0].get_xlim()) < 100


@pytest.mark.parametrize(
    "positions", [np.zeros((0, 3)), np.zeros((1, 3)), circle()[:2], np.column_stack([np.arange(9.0)] * 3)]
)
def test_empty_short_and_straight_data_still_give_a_picture(positions, tmp_path):
    layers = [Points(positions), Track(positions), Edges(np.zeros((0, 2, 3)), label="no loop")]
    figure = viz.figure([Panel("a", layers, np.full((1, 3), np.nan))])
    viz.save_figure(figure, tmp_path / "a.png", dpi=40)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert labels(figure) == ["reference"]


def test_a_figure_without_a_panel_is_refused():
    with pytest.raises(ValueError, match="panels"):
        viz.figure([])


@pytest.mark.slow
def test_drawing_leaves_no_global_state_and_no_early_matplotlib():
    code = (
        "import sys, numpy as np, dpmjax.viz as viz; assert not {'jax', 'matplotlib'} & set(sys.modules);"
        "viz.figure([viz.Panel('a', [viz.Track(np.zeros((2, 3)))])]);"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    assert run_python("-c", code).returncode == 0


def test_phases_are_named_once_in_order_and_wide_values_get_a_logarithmic_axis():
    seconds, ate = np.linspace(0.0, 6.0, 30), np.full(30, np.nan)
    ate[::5] = 100.0 * np.exp(-seconds[::5])
    phases = ["L-Net"] * 10 + ["free poses"] * 19 + ["polish"]
    curves = {"loss": 1.0 / (1.0 + seconds), "ATE, px": ate}
    first, second = viz.curves_figure(seconds, curves, x_label="run time, s", phases=phases).axes
    assert [text.get_text() for text in first.texts] == ["L-Net", "free poses", "polish"]
    assert [line.get_xdata()[0] for line in second.lines[1:]] == [0.0, seconds[9], seconds[28]]
    assert (first.get_yscale(), second.get_yscale()) == ("linear", "log")
    np.testing.assert_array_equal(second.lines[0].get_xdata(), seconds[::5])
    assert second.get_xlabel() == "run time, s"


def test_training_curves_leave_out_what_was_not_measured():
    steps, loss, recall = np.arange(100), np.linspace(2.0, 1.0, 100), np.full(100, np.nan)
    recall[[0, 50]] = [0.1, 0.6]
    rows = viz.curves_figure(steps, {"loss": loss, "recall": recall}).axes
    assert [axes.get_ylabel() for axes in rows] == ["loss", "recall"]
    np.testing.assert_array_equal(rows[1].lines[0].get_xydata(), [[0, 0.1], [50, 0.6]])
    # The running mean of a straight line is that line, away from its ends.
    np.testing.assert_allclose(rows[0].lines[1].get_ydata()[5:-5], loss[5:-5])


def test_a_single_record_without_a_loss_gives_a_picture_and_other_lengths_are_refused(tmp_path):
    viz.save_figure(viz.curves_figure([0.0], {"loss": [np.nan]}, phases=["polish"]), tmp_path / "loss.png", dpi=50)
    assert (tmp_path / "loss.png").stat().st_size > 1000
    for curves in ({}, {"loss": [1.0, 2.0]}):
        with pytest.raises(ValueError, match="expected one or more steps"):
            viz.curves_figure([0.0], curves)


def test_reliability_puts_each_bin_at_its_means():
    figure = viz.reliability_figure(np.array([0.05, 0.05, 0.93, 0.97]), [False, True, True, True], title="t")
    x, y = figure.axes[0].lines[1].get_data()
    np.testing.assert_allclose(x, [0.05, 0.95])
    np.testing.assert_allclose(y, [0.5, 1.0])
    assert "4 pairs" in figure.axes[0].get_title()
    assert viz.reliability_figure([], [], title="t").axes
