from __future__ import annotations

import numpy as np

from dpmjax import viz


def test_found_scans_are_drawn_where_they_are() -> None:
    keyframes, scans = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(4), (2, 1, 1))
    keyframes[:, 0, 3] = [0, 5, 10]
    scans[:, 1, 3] = [2, 3]
    points = np.random.default_rng(0).uniform(-10, 10, (50, 3))
    figure = viz.localization_figure(points, keyframes, scans, is_wrong=[False, True], title="t")
    path, right, wrong = figure.axes[0].lines[:3]
    np.testing.assert_array_equal(path.get_xdata(), [0, 5, 10])
    np.testing.assert_array_equal(right.get_ydata(), [2])
    np.testing.assert_array_equal(wrong.get_ydata(), [3])


def test_a_map_without_found_scans_is_drawn() -> None:
    figure = viz.localization_figure(np.zeros((0, 3)), np.eye(4)[None], np.zeros((0, 4, 4)), title="t")
    assert len(figure.axes[0].lines) >= 1
