"""Pictures of SLAM, of registered scans and of pairs show all of their data."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

from dpmjax import viz
from dpmjax.types import ScanSet
from dpmjax.viz.figures import INK, PATH
from dpmjax.viz.scan_maps import UNEXPLORED_GREY
from dpmjax.viz.scan_pairs import SOURCE, TARGET
from tests.viz.test_figures import as_bytes, circle, colors_of, labels


def line_of(axes, color: str, num: int) -> np.ndarray:
    (line,) = (line for line in axes.lines if line.get_color() == color and len(line.get_xydata()) == num)
    return line.get_xydata()


def room(num_scans: int = 6, num_beams: int = 40):
    rng = np.random.default_rng(3)
    poses = np.stack([np.linspace(10, 60, num_scans), 20 + np.sin(np.arange(num_scans)), np.arange(num_scans) / 5], 1)
    walls = np.stack([rng.uniform(0, 80, (num_scans, num_beams)), rng.choice([0.0, 50.0], (num_scans, num_beams))], -1)
    offset, turn = walls - poses[:, None, :2], poses[:, 2, None]
    x = np.cos(turn) * offset[..., 0] + np.sin(turn) * offset[..., 1]
    y = -np.sin(turn) * offset[..., 0] + np.cos(turn) * offset[..., 1]
    return ScanSet(np.stack([x, y], -1), np.ones(walls.shape[:2], bool)), poses, walls


def test_a_trajectory_is_drawn_with_what_is_known():
    loops = np.stack([circle()[:3], circle()[-3:]], axis=1)
    tracks = [viz.Track(1.1 * circle(), viz.ODOMETRY, "odometry alone"), viz.Track(circle(), viz.PATH, "SLAM")]
    figure = viz.trajectory_figure("town", tracks, circle(), loops)
    assert labels(figure) == ["reference", "odometry alone", "SLAM", "3 loops"]
    assert labels(viz.trajectory_figure("town", tracks[1:])) == ["SLAM"]


def test_the_highest_point_of_a_cell_is_seen():
    points, heights = np.repeat(circle(), 2, axis=0), np.tile([-2.0, 5.0], 50)
    for order in (slice(None), slice(None, None, -1)):
        figure = viz.height_map_figure("a", points[order], heights[order], circle(radius=30.0))
        assert colors_of(figure.axes[0]) == {tuple(viz.height_colors(np.array([5.0]))[0].tolist())}
    assert labels(figure) == ["path of the lidar"]


def test_a_roof_over_the_path_is_left_out():
    rng = np.random.default_rng(0)
    points = np.vstack([rng.uniform(-25, 25, (20000, 3)), rng.uniform(-25, 25, (500, 3))])
    figure = viz.height_map_figure("a", points, np.r_[np.full(20000, 3.0), np.zeros(500)], circle())
    assert colors_of(figure.axes[0]) == {tuple(viz.height_colors(np.zeros(1))[0].tolist())}


def test_found_scans_are_drawn_where_they_are():
    keyframes, scans = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(4), (2, 1, 1))
    keyframes[:, 0, 3], scans[:, 1, 3] = [0, 5, 10], [2, 3]
    points = np.random.default_rng(0).uniform(-10, 10, (50, 3))
    figure = viz.localization_figure(points, keyframes, scans, title="t")
    (axes,) = figure.axes
    np.testing.assert_array_equal(line_of(axes, INK, 3)[:, 0], [0, 5, 10])
    np.testing.assert_array_equal(line_of(axes, PATH, 2), [[0, 2], [0, 3]])
    assert labels(figure) == ["3 keyframes", "2 found (line: forward)"]
    assert viz.localization_figure(np.zeros((0, 3)), np.eye(4)[None], np.zeros((0, 4, 4)), title="t").axes


def test_scans_lie_where_the_poses_say_in_the_frame_of_the_anchor():
    scans, poses, walls = room()
    cos, sin = np.cos(0.7), np.sin(0.7)
    turned = poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + [300.0, -40.0]
    moved = np.column_stack([turned, poses[:, 2] + 0.7])
    figure = viz.registered_scans_figure(scans, {"result": moved, "reference": poses}, "px")
    result, reference, bar = figure.axes
    assert (result.get_xlim(), result.get_ylim()) == (reference.get_xlim(), reference.get_ylim())
    np.testing.assert_array_equal(result.images[0].get_array(), reference.images[0].get_array())
    np.testing.assert_allclose(line_of(result, PATH, 6), poses[:, :2], atol=1e-9)
    for axis, limits in enumerate((reference.get_xlim(), reference.get_ylim())):
        assert limits[0] < walls[..., axis].min() < walls[..., axis].max() < limits[1]
    assert len(colors_of(reference)) == 6
    assert (bar.get_ylim(), bar.get_ylabel()) == ((1, 6), "scan")
    first, last, _ = viz.registered_scans_figure(scans, {"a": moved, "b": poses}, "px", anchor="a").axes
    assert (first.get_title("left"), last.get_title("left")) == ("b", "a")
    np.testing.assert_allclose(line_of(first, PATH, 6), moved[:, :2], atol=1e-9)


def test_masked_points_and_diverged_scans_are_not_drawn():
    scans, poses, _ = room()
    points, mask, poses = scans.points.copy(), scans.mask.copy(), poses.copy()
    mask[:, ::2], points[:, ::2], poses[-1] = False, 1e9, np.nan
    axes, _ = viz.registered_scans_figure(ScanSet(points, mask), {"result": poses}, "px").axes
    assert np.ptp(axes.get_xlim()) < 200
    assert len(colors_of(axes)) == 5
    with pytest.raises(ValueError, match=r"result: expected poses \(6, 3\)"):
        viz.registered_scans_figure(scans, {"result": poses[:2]}, "px")


def draw_occupancy(T_view_world, limits):
    """Draws a world of 10 x 10 m, whose wall is at the smallest y; returns its axes and pixels."""
    probability = np.zeros((20, 20))
    probability[:5] = 1.0
    picture = (probability, np.ones((20, 20), bool), (0, 10, 0, 10))
    figure = viz.occupancy_figure(picture, np.array([[1.0, 2.0]]), "m", T_view_world=T_view_world, limits=limits)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image, box = np.asarray(canvas.buffer_rgba())[..., :3].mean(axis=-1), figure.axes[0].get_window_extent()
    height = len(image)
    return figure.axes[0], image[height - int(box.y1) : height - int(box.y0), int(box.x0) : int(box.x1)]


def test_a_quarter_turn_of_the_world_turns_the_occupancy():
    T_view_world = np.array([[0.0, -1.0, 10.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    axes, image = draw_occupancy(T_view_world, viz.Limits(0.0, 20.0, 0.0, 10.0))
    assert axes.get_xlim() == (0, 20)
    np.testing.assert_allclose(line_of(axes, PATH, 1), [[8.0, 1.0]])
    middle, tenth = image[20:-60], image.shape[1] / 20
    free, wall, unseen = (middle[:, int((x + 0.5) * tenth)].mean() for x in (2, 8.5, 15))
    assert free > 240
    assert wall < 20
    assert unseen == pytest.approx(255 * UNEXPLORED_GREY, abs=2)


def test_images_from_above_lie_where_their_poses_say_and_the_ceiling_is_left_out():
    points = np.random.default_rng(0).uniform([-1, -0.5, 1], [1, 0.5, 3], (2, 4, 5, 3))
    points[0, 0, 0] = [0.0, -1.5, 50.0]
    mask = np.ones(points.shape[:3], bool)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [2.0, 0.0, 1.0]
    # The world of the reference has its z axis up: each panel is drawn in the frame of its first camera.
    upright = np.array([[1.0, 0, 0, 7], [0, 0, 1, 30], [0, -1, 0, 2], [0, 0, 0, 1]])
    figure = viz.from_above_figure([("found", T), ("reference", upright @ T)], points, mask)
    found, reference, bar = figure.axes
    np.testing.assert_array_equal(found.images[0].get_array(), reference.images[0].get_array())
    for axes in (found, reference):
        np.testing.assert_allclose(line_of(axes, PATH, 2), [[0.0, 0.0], [2.0, 1.0]], atol=1e-12)
        assert np.ptp(axes.get_ylim()) < 10
    assert bar.get_ylabel() == "image"


def wall(num: int = 4000) -> np.ndarray:
    return np.random.default_rng(0).uniform([-20, 9, 0], [20, 9.05, 2], (num, 3)).astype(np.float32)


def test_scans_that_meet_are_black_and_apart_have_two_colours():
    apart = np.eye(4)
    apart[1, 3] = -5
    pair = viz.RegisteredPair("pair", wall(), wall(), {"apart": apart, "met": np.eye(4)}, ("a.bin", "b.bin"))
    figure = viz.registered_pairs_figure([pair, pair])
    assert [colors_of(axes) for axes in figure.axes[:2]] == [{as_bytes(SOURCE), as_bytes(TARGET)}, {as_bytes(INK)}]
    assert labels(figure) == ["a.bin", "b.bin", "lidar of b.bin", "lidar of a.bin", "points of two or more"]
    assert [line_of(axes, SOURCE, 1)[0, 1] for axes in figure.axes[:2]] == [-5, 0]
    grey = [np.dot(to_rgb(color), (0.299, 0.587, 0.114)) for color in (INK, SOURCE, TARGET, "white")]
    assert np.diff(grey).min() > 0.15
