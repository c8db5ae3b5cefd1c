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
    right_match, wrong_match = left.collections
    assert (right_match.get_label(), wrong_match.get_label()) == ("1 right match", "1 wrong match")
    # Style tells them apart where the colour cannot be seen.
    assert right_match.get_linestyle() != wrong_match.get_linestyle()
    for match, start in ((right_match, [0.0, 0.0]), (wrong_match, [0.5, 0.5])):
        np.testing.assert_allclose(match.get_segments()[0][0], start)
    many = viz.matches_figure(pair, np.zeros((400, 3)), np.zeros((400, 3)), np.ones(400)).axes[0].collections[0]
    assert len(many.get_segments()) == 30
    assert many.get_label() == "400 right matches, 30 drawn"
    titles = left.get_title(loc="left"), right.get_title(loc="left")
    assert titles == ("pair", "laid onto the target")
    source_at = next(line for line in right.lines if line.get_label() == "lidar of source")
    np.testing.assert_allclose(source_at.get_xydata(), [[2.0, 3.0]])
    assert all(any(text.get_text().endswith(" m") for text in axes.texts) for axes in (left, right))
