"""Curves: phases of a fit in order, gaps left out, axes that suit the values; times and memory by size."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.viz import history_figure, save_figure


def example(num_records=30):
    seconds = np.linspace(0.0, 6.0, num_records)
    ate = np.full(num_records, np.nan)
    ate[::5] = 100.0 * np.exp(-seconds[::5])
    phase = ["L-Net"] * 10 + ["free poses"] * (num_records - 11) + ["polish"]
    return seconds, 1.0 / (1.0 + seconds), phase, ate


def test_phases_are_named_once_in_order():
    figure = history_figure(*example(), "px")
    names = [text.get_text() for text in figure.axes[0].texts]
    assert names == ["L-Net", "free poses", "polish"]
    assert len(figure.axes[0].lines) == 3


def test_ate_joins_the_measured_records_and_ends_with_its_value():
    seconds, *columns = example()
    axes = history_figure(seconds, *columns, "px").axes[1]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), seconds[::5])
    assert axes.texts[-1].get_text() == "0.567 px"
    assert axes.get_ylabel() == "ATE (px)"


def test_wide_positive_values_get_a_logarithmic_axis():
    loss_axes, ate_axes = history_figure(*example(), "m").axes
    assert loss_axes.get_yscale() == "linear"
    assert ate_axes.get_yscale() == "log"


def test_without_reference_there_is_one_panel():
    seconds, loss, phase, _ = example()
    assert len(history_figure(seconds, loss, phase, np.full(30, np.nan), "m").axes) == 1


def test_a_single_record_and_missing_losses_still_give_a_picture(tmp_path):
    figure = history_figure(np.zeros(1), np.full(1, np.nan), ["polish"], np.ones(1), "px")
    save_figure(figure, tmp_path / "loss.png", dpi=50)
    assert (tmp_path / "loss.png").stat().st_size > 1000


def test_columns_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match=r"\[3, 3, 2, 3\]"):
        history_figure(np.zeros(3), np.zeros(3), ["a", "b"], np.zeros(3), "px")
