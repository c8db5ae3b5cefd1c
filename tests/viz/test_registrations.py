from __future__ import annotations

import numpy as np

from dpmjax import viz


def test_reliability_puts_each_bin_at_its_means() -> None:
    confidence = np.array([0.05, 0.05, 0.93, 0.97])
    figure = viz.reliability_figure(confidence, [False, True, True, True], title="t")
    x, y = figure.axes[0].lines[1].get_data()
    np.testing.assert_allclose(x, [0.05, 0.95])
    np.testing.assert_allclose(y, [0.5, 1.0])
    assert "4 pairs" in figure.axes[0].get_title()


def test_reliability_of_nothing_is_drawn() -> None:
    assert viz.reliability_figure([], [], title="t").axes


def test_pairs_are_drawn_under_both_motions() -> None:
    T = np.eye(4)
    T[0, 3] = 7
    pair = viz.RegisteredPair(
        "pair", np.zeros((1, 3), np.float32), np.ones((2, 3), np.float32), {"found": T, "true": np.eye(4)}
    )
    figure = viz.registered_pairs_figure([pair, pair])
    assert len(figure.axes) == 4
    found, true = (axes.lines[1].get_xdata() for axes in figure.axes[:2])
    np.testing.assert_array_equal(found, [7])
    np.testing.assert_array_equal(true, [0])
