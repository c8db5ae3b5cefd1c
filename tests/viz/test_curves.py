"""Curves: phases in order, gaps left out, axes that suit the values; reliability by bins."""

import numpy as np
import pytest

from dpmjax import viz


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
