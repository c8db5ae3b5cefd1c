"""Curves: phases of a fit in order, gaps left out, axes that suit the values; times and memory by size."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.viz import History, history_figure, save_figure, size_figure


def example(num_records=30):
    seconds = np.linspace(0.0, 6.0, num_records)
    ate = np.full(num_records, np.nan)
    ate[::5] = 100.0 * np.exp(-seconds[::5])
    phase = ["L-Net"] * 10 + ["free poses"] * (num_records - 11) + ["polish"]
    return History(seconds, 1.0 / (1.0 + seconds), phase, ate)


def test_phases_are_named_once_in_order():
    figure = history_figure(example(), "px")
    names = [text.get_text() for text in figure.axes[0].texts]
    assert names == ["L-Net", "free poses", "polish"]
    assert len(figure.axes[0].lines) == 3


def test_ate_joins_the_measured_records_and_ends_with_its_value():
    history = example()
    axes = history_figure(history, "px").axes[1]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), history.seconds[::5])
    assert axes.texts[-1].get_text() == "0.567 px"
    assert axes.get_ylabel() == "ATE (px)"


def test_wide_positive_values_get_a_logarithmic_axis():
    loss_axes, ate_axes = history_figure(example(), "m").axes
    assert loss_axes.get_yscale() == "linear"
    assert ate_axes.get_yscale() == "log"


def test_without_reference_there_is_one_panel():
    history = example()
    assert len(history_figure(History(history.seconds, history.loss, history.phase), "m").axes) == 1
    nothing_measured = History(history.seconds, history.loss, history.phase, np.full(30, np.nan))
    assert len(history_figure(nothing_measured, "m").axes) == 1


def test_a_single_record_and_missing_losses_still_give_a_picture(tmp_path):
    history = History(np.zeros(1), np.full(1, np.nan), ["polish"], np.ones(1))
    save_figure(history_figure(history, "px"), tmp_path / "loss.png", dpi=50)
    assert (tmp_path / "loss.png").stat().st_size > 1000


def test_columns_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match=r"\[3, 3, 2\]"):
        history_figure(History(np.zeros(3), np.zeros(3), ["a", "b"]), "px")


def test_seconds_and_memory_are_drawn_apart_with_the_limit():
    curves = {"num_scans": [64, 256, 1024], "step (s)": [0.1, 0.2, 0.2], "peak memory (GB)": [0.5, 0.6, 0.9]}
    left, right = size_figure(curves, memory_limit_gb=4.0).axes
    assert [line.get_label() for line in left.lines] == ["step (s)"]
    np.testing.assert_array_equal(left.lines[0].get_xydata(), [[64, 0.1], [256, 0.2], [1024, 0.2]])
    memory, limit = right.lines
    np.testing.assert_array_equal(memory.get_ydata(), [0.5, 0.6, 0.9])
    assert set(limit.get_ydata()) == {4.0}
    assert (left.get_xscale(), left.get_yscale(), right.get_yscale()) == ("log", "log", "linear")
    assert [text.get_text() for text in left.get_xticklabels()] == ["64", "256", "1024"]


def test_a_curve_of_another_length_is_refused():
    with pytest.raises(ValueError, match="curves: expected"):
        size_figure({"num_scans": [64, 256], "step (s)": [0.1]}, memory_limit_gb=4.0)
