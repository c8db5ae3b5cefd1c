"""Pictures of the other experiments: what is drawn is what was given, in its frame and with its unit."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax import viz


def test_error_maps_share_their_colours_and_show_where_nothing_was_measured():
    error = np.array([[0.0, 50.0], [np.nan, 400.0]])
    maps = [viz.ErrorMap("fit", "median 1 px", error), viz.ErrorMap("trained", "median 2 px", error / 2)]
    path = np.array([[1.0, 2.0], [3.0, 4.0]])
    figure = viz.error_maps_figure(maps, (0, 10, 0, 20), path, "px", worst=200.0)
    for axes, panel in zip(figure.axes, maps, strict=False):
        image = axes.images[0]
        assert (image.get_clim(), image.get_extent()) == ((0.0, 200.0), [0, 10, 0, 20])
        np.testing.assert_array_equal(np.ma.getmaskarray(image.get_array()), np.isnan(panel.error))
        assert axes.get_title(loc="left").strip() == panel.title
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), path)
    assert figure.axes[-1].get_ylabel() == "error, px"
    with pytest.raises(ValueError, match="worst"):
        viz.error_maps_figure(maps, (0, 10, 0, 20), path, "px", worst=0.0)


def test_depth_images_from_above_lie_on_the_last_panel_without_their_ceiling():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (2, 4, 5, 3))
    points[:, 0, :, 1] = -3.0  # the ceiling: y points down
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.5
    moved = poses.copy()
    moved[:, :3, 3] += [7.0, 0.0, -3.0]
    figure = viz.from_above_figure([("moved", moved), ("reference", poses)], points, np.ones((2, 4, 5), bool))
    left, right = figure.axes
    assert left.get_xlim() == right.get_xlim()
    for one, other in zip(left.lines[:3], right.lines[:3], strict=True):
        np.testing.assert_allclose(one.get_xydata(), other.get_xydata(), atol=1e-9)
    below = points[0][points[0, ..., 1] > -0.9]
    np.testing.assert_allclose(right.lines[0].get_xydata(), below[:, [0, 2]])


def test_sizes_are_drawn_as_time_and_memory_apart():
    curves = {"num_scans": [64, 256], "step (s)": [0.1, 0.2], "peak memory (GB)": [0.5, 1.0]}
    left, right = viz.size_figure(curves, memory_limit_gb=4.0).axes
    np.testing.assert_array_equal(left.lines[0].get_xydata(), [[64, 0.1], [256, 0.2]])
    np.testing.assert_array_equal(right.lines[0].get_ydata(), [0.5, 1.0])
    assert {line.get_ydata()[0] for line in right.lines} >= {4.0}
    assert (left.get_xscale(), left.get_yscale(), right.get_yscale()) == ("log", "log", "linear")
    with pytest.raises(ValueError, match="curves"):
        viz.size_figure({"num_scans": [64], "step (s)": [0.1, 0.2]}, memory_limit_gb=4.0)


def test_toy_picture_marks_both_ends_and_the_visited_places():
    x = np.linspace(-6, 6, 50)
    figure = viz.toy_figure(
        x,
        x**2,
        x / 2,
        x**2 + 1,
        visited=([3.0, 2.0], [9.0, 4.0]),
        direct_end=(2.3, 5.3),
        network_end=(-1.4, 2.0),
        network_end_z=0.7,
    )
    drawn = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    np.testing.assert_allclose(drawn["direct descent ends"], [[2.3, 5.3]])
    np.testing.assert_allclose(drawn["z* of the network"], [[0.7, 2.0]])
    np.testing.assert_allclose(drawn["x* = f(z*)"], [[-1.4, 2.0]])
    assert len(drawn["x visited by the network"]) == 2


def test_endings_count_every_seed_and_tell_the_share():
    x = np.linspace(-6, 6, 50)
    ends = {"network": np.array([-1.4, -1.4, 3.0, np.nan]), "direct": np.array([2.0, 2.0, 99.0, -1.4])}
    figure = viz.endings_figure(x, x**2, ends, {"network": 0.5, "direct": 0.25})
    counts = [sum(patch.get_height() for patch in axes.patches) for axes in figure.axes[1:]]
    assert counts == [3, 4]
    assert figure.axes[1].texts[0].get_text() == "network: 50.0 % at the global minimum"
    with pytest.raises(ValueError, match="shares"):
        viz.endings_figure(x, x**2, ends, {"network": 0.5})


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
    figure = viz.matches_figure(source, target, T, matched, matched, [True, False], "pair")
    left, right = figure.axes
    right_match, wrong_match = left.lines[2:4]
    assert right_match.get_color() != wrong_match.get_color()
    assert left.get_title() == "pair"
    np.testing.assert_allclose(right.lines[1].get_xydata(), np.tile([2.0, 3.0], (3, 1)))
