"""Pictures of SLAM runs are drawn from any run, and show what they are given."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax import viz


def circle(num: int = 50, radius_m: float = 20.0) -> np.ndarray:
    angles = np.linspace(0, 6, num)
    return np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), 0 * angles])


def labels(figure) -> list[str]:
    return [text.get_text() for text in figure.axes[0].get_legend().get_texts()]


def test_a_trajectory_is_drawn_with_what_is_known() -> None:
    ours, errors = circle(), np.linspace(0, 1, 50)
    loops = np.stack([ours[:3], ours[-3:]], axis=1)
    odometry = viz.Track("odometry alone", ours * 1.1, errors)
    figure = viz.trajectory_figure("town", [odometry, viz.Track("SLAM", ours, errors)], ours, loops)
    assert labels(figure) == ["reference", "odometry alone", "SLAM", "3 loops", "start"]
    assert len(figure.axes) == 2
    figure = viz.trajectory_figure("town", [viz.Track("SLAM", ours)], None, np.zeros((0, 2, 3)))
    assert labels(figure) == ["SLAM", "start"]
    assert len(figure.axes) == 1


def test_a_height_map_names_the_path_of_the_lidar() -> None:
    figure = viz.height_map_figure("a", np.zeros((0, 3)), np.zeros(0), circle())
    assert labels(figure) == ["path of the lidar", "start"]


def test_tracks_differ_in_line_style() -> None:
    tracks = [viz.Track(name, circle()) for name in ("the map before", "odometry alone", "SLAM")]
    (axes,) = viz.trajectory_figure("town", tracks, None, circle()[None, :2]).axes
    drawn = {line.get_label(): line for line in axes.lines}
    assert len({(drawn[track.label].get_color(), drawn[track.label].is_dashed()) for track in tracks}) == 3
    assert "1 loop" in [text.get_text() for text in axes.get_legend().get_texts()]


@pytest.mark.parametrize("positions", [np.zeros((1, 3)), circle()[:2], np.column_stack([np.arange(9.0)] * 3)])
def test_short_and_straight_drives_are_drawn(positions, tmp_path) -> None:
    figure = viz.trajectory_figure("a", [viz.Track("SLAM", positions)], None, np.zeros((0, 2, 3)))
    viz.save_figure(figure, tmp_path / "a.png", dpi=40)
    viz.save_figure(viz.height_map_figure("a", np.zeros((0, 3)), np.zeros(0), positions), tmp_path / "b.png", dpi=40)


def test_the_highest_point_of_a_pixel_is_seen() -> None:
    points = np.repeat(circle(), 2, axis=0)
    heights = np.tile([-2.0, 5.0], 50)
    for order in (slice(None), slice(None, None, -1)):
        figure = viz.height_map_figure("a", points[order], heights[order], circle(radius_m=30.0))
        picture = np.asarray(figure.axes[0].images[0].get_array())
        seen = np.unique(picture[(picture != 255).any(axis=2)], axis=0)
        np.testing.assert_array_equal(seen, viz.height_colors(np.array([5.0])))


def test_colours_rise_with_height_and_end_at_the_bounds() -> None:
    colors = viz.height_colors(np.array([-100.0, -2.5, 5.5, 100.0]))
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[2], colors[3])
    assert colors.dtype == np.uint8


def test_a_roof_over_the_path_is_left_out() -> None:
    path, rng = circle(), np.random.default_rng(0)
    roof, walls = rng.uniform(-25, 25, (20000, 3)), rng.uniform(-25, 25, (500, 3))
    points = np.vstack([roof, walls])
    heights = np.r_[np.full(20000, 3.0), np.zeros(500)]
    picture = np.asarray(viz.height_map_figure("a", points, heights, path).axes[0].images[0].get_array())
    seen = np.unique(picture[(picture != 255).any(axis=2)], axis=0)
    np.testing.assert_array_equal(seen, viz.height_colors(np.zeros(1)))
