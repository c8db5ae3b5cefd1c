"""Pictures of a training: every curve and every match where it belongs."""

from __future__ import annotations

import numpy as np

from dpmjax import viz


def test_training_curves_leave_out_what_was_not_measured():
    steps = np.arange(100)
    loss, recall = np.linspace(2.0, 1.0, 100), np.full(100, np.nan)
    recall[[0, 50]] = [0.1, 0.6]
    rows = viz.curves_figure(steps, {"loss": loss, "recall": recall}).axes
    assert [axes.get_ylabel() for axes in rows] == ["loss", "recall"]
    np.testing.assert_array_equal(rows[1].lines[0].get_xydata(), [[0, 0.1], [50, 0.6]])
    # The running mean of a straight line is that line, away from its ends.
    np.testing.assert_allclose(rows[0].lines[1].get_ydata()[5:-5], loss[5:-5])


def test_matches_join_the_clouds_and_wrong_ones_stand_out():
    source, target = np.zeros((3, 3)), np.ones((4, 3))
    T = np.eye(4)
    T[:2, 3] = [2.0, 3.0]
    matched = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
    pair = viz.RegisteredPair("pair", source, target, {"laid onto the target": T})
    figure = viz.matches_figure(pair, matched, matched, [True, False])
    left, right = figure.axes
    right_match, wrong_match = left.lines[2:4]
    assert right_match.get_color() != wrong_match.get_color()
    assert (left.get_title(), right.get_title()) == ("pair", "laid onto the target")
    np.testing.assert_allclose(right.lines[1].get_xydata(), np.tile([2.0, 3.0], (3, 1)))
