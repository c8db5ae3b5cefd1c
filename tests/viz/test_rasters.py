"""The world from above: shares of occupied, free and unexplored cells; errors of poses; clouds of depth images."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dpmjax.viz import ErrorMap, Limits, error_maps_figure, from_above_figure, occupancy_figure
from dpmjax.viz.registered_scans import UNEXPLORED_GREY


def draw_occupancy(probability, explored, extent, unit, path=((0.0, 0.0),), **view):
    """The picture in the frame of the world, and all of it."""
    view = {"T_view_world": np.eye(3), "limits": Limits(*extent), **view}
    return occupancy_figure((probability, explored, extent), np.array(path), unit, **view)


def example():
    probability = np.zeros((30, 50))
    probability[12:15, 10:40] = 1.0
    explored = np.zeros((30, 50), bool)
    explored[5:25, 5:45] = True
    return probability, explored


def rendered_map(figure, dpi=100):
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    box = figure.axes[0].get_window_extent()
    height = len(image)
    return image[height - int(box.y1) : height - int(box.y0), int(box.x0) : int(box.x1)]


def test_shares_of_black_white_and_grey_are_those_of_the_map():
    probability, explored = example()
    image = rendered_map(draw_occupancy(probability, explored, (0, 100, 0, 60), "px"))
    grey = np.abs(image - round(255 * UNEXPLORED_GREY)).max(axis=-1) <= 2
    white = image.min(axis=-1) > 250
    black = image.max(axis=-1) < 5
    assert grey.mean() == pytest.approx((~explored).mean(), abs=0.03)  # frame and scale bar cover up to 3 %
    assert white.mean() == pytest.approx((explored & (probability < 0.5)).mean(), abs=0.03)
    assert black.mean() == pytest.approx((explored & (probability > 0.5)).mean(), abs=0.03)


def test_row_zero_is_the_smallest_y():
    probability, explored = np.zeros((20, 20)), np.ones((20, 20), bool)
    probability[:5] = 1.0
    image = rendered_map(draw_occupancy(probability, explored, (0, 10, 0, 10), "m"))
    assert image[-20:].mean() < 60
    assert image[20:100].mean() > 240


def test_trajectory_is_drawn_in_world_coordinates():
    probability, explored = example()
    path = np.array([[10.0, 10.0], [90.0, 50.0]])
    figure = draw_occupancy(probability, explored, (0, 100, 0, 60), "px", path)
    assert any(np.array_equal(line.get_xydata(), path) for line in figure.axes[0].lines)
    assert figure.axes[0].get_xlim() == (0, 100)
    assert figure.axes[0].get_ylim() == (0, 60)


def test_a_quarter_turn_of_the_world_turns_the_picture():
    probability, explored = np.zeros((20, 20)), np.ones((20, 20), bool)
    probability[:5] = 1.0  # the wall of the smallest y
    T_view_world = np.array([[0.0, -1.0, 10.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    path = np.array([[1.0, 2.0]])
    limits = Limits(0.0, 20.0, 0.0, 10.0)
    figure = draw_occupancy(probability, explored, (0, 10, 0, 10), "m", path, T_view_world=T_view_world, limits=limits)
    assert figure.axes[0].get_xlim() == (0, 20)
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xydata(), [[8.0, 1.0]])
    image = rendered_map(figure).mean(axis=-1)
    middle = image[20:-40]  # without the frame and the scale bar
    tenth = image.shape[1] / 20
    columns = [middle[:, int((x + 0.5) * tenth)].mean() for x in (2, 8.5, 15)]
    assert columns[0] > 240  # free
    assert columns[1] < 20  # the wall, now at the largest x of the world
    assert columns[2] == pytest.approx(255 * UNEXPLORED_GREY, abs=2)  # nobody looked


@pytest.mark.parametrize(
    ("explored_shape", "extent", "message"), [((3, 3), (0, 1, 0, 1), r"\(3, 3\)"), ((4, 5), (1, 1, 0, 1), "extent")]
)
def test_wrong_shapes_are_refused(explored_shape, extent, message):
    with pytest.raises(ValueError, match=message):
        draw_occupancy(np.zeros((4, 5)), np.ones(explored_shape, bool), extent, "px")


def test_errors_are_drawn_on_one_scale_with_titles_trajectory_and_bar():
    error = np.array([[0.0, 50.0], [np.nan, 500.0]])
    path = np.array([[1.0, 1.0], [3.0, 2.0]])
    maps = [ErrorMap("as fitted", "median 50 px", error), ErrorMap("trained", "median 5 px", 0.1 * error)]
    figure = error_maps_figure(maps, (0.0, 4.0, 0.0, 4.0), path, "px", worst=200.0)
    *panels, bar = figure.axes
    assert [axes.get_title(loc="left").strip() for axes in panels] == ["as fitted", "trained"]
    assert [axes.texts[0].get_text() for axes in panels] == ["median 50 px", "median 5 px"]
    for axes, panel in zip(panels, maps, strict=True):
        (image,) = axes.images
        np.testing.assert_array_equal(image.get_array().filled(np.nan), panel.error)
        assert image.get_clim() == (0.0, 200.0)
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), path)
    assert bar.get_ylabel() == "error, px"
    # The smaller errors are the darker picture.
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50


def test_panels_of_different_shapes_are_refused():
    maps = [ErrorMap("a", "", np.zeros((2, 2))), ErrorMap("b", "", np.zeros((3, 2)))]
    with pytest.raises(ValueError, match="panels of one shape"):
        error_maps_figure(maps, (0.0, 1.0, 0.0, 1.0), np.zeros((2, 2)), "px", worst=1.0)


def test_images_from_above_lie_where_their_poses_say_and_the_ceiling_is_left_out():
    points = np.random.default_rng(0).uniform([-1, -0.5, 1], [1, 0.5, 3], (2, 4, 5, 3))
    points[0, 0, 0] = [0.0, -1.5, 2.0]
    mask = np.ones(points.shape[:3], bool)
    mask[1, 0] = False
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = [2.0, 0.0, 1.0]
    # The world of the reference has its z axis up: each panel is drawn in the frame of its first camera.
    upright = np.array([[1.0, 0, 0, 7], [0, 0, 1, 30], [0, -1, 0, 2], [0, 0, 0, 1]])
    *panels, _ = from_above_figure([("found", T), ("reference", upright @ T)], points, mask).axes
    assert [axes.get_title(loc="left") for axes in panels] == ["found", "reference"]
    for axes in panels:
        first, second, path = axes.lines[:3]
        assert len(first.get_xdata()) == 19
        assert len(second.get_xdata()) == 15
        np.testing.assert_allclose(second.get_xydata(), points[1][mask[1]][:, [0, 2]] + [2.0, 1.0])
        np.testing.assert_allclose(path.get_xydata(), [[0.0, 0.0], [2.0, 1.0]])
    with pytest.raises(ValueError, match="panels"):
        from_above_figure([], points, mask)


def test_images_from_above_fill_the_panel_and_have_a_bar_of_their_numbers():
    points = np.random.default_rng(0).uniform([-0.3, -0.5, 0.2], [0.3, 0.5, 0.8], (3, 4, 5, 3))
    figure = from_above_figure([("found", np.tile(np.eye(4), (3, 1, 1)))], points, np.ones(points.shape[:3], bool))
    panel, bar = figure.axes
    assert np.ptp(panel.get_xlim()) < 1.5 * np.ptp(points[..., 0])
    assert [text.get_text() for text in bar.texts] == ["image 1", "image 3"]
    assert panel.get_aspect() == 1.0
    assert any(text.get_text().endswith(" m") for text in panel.texts)
