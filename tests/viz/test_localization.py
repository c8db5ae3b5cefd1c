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
    # Shape tells right and wrong apart where the colour cannot be seen; a ring does not hide the scan under it.
    assert right.get_marker() != wrong.get_marker()
    assert path.get_markerfacecolor() == "none"
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["3 keyframes", "1 found (arrow: forward)", "1 found elsewhere than the reference"]


def test_the_legend_lies_below_the_map() -> None:
    figure = viz.localization_figure(np.ones((9, 3)), np.eye(4)[None], np.eye(4)[None], title="t")
    figure.canvas.draw()
    (axes,) = figure.axes
    assert axes.get_legend().get_window_extent().y1 <= axes.get_window_extent().y0


def test_a_map_without_found_scans_is_drawn() -> None:
    figure = viz.localization_figure(np.zeros((0, 3)), np.eye(4)[None], np.zeros((0, 4, 4)), title="t")
    assert len(figure.axes[0].lines) >= 1
