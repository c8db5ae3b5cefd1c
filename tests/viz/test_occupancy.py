"""The occupancy picture: black, white and grey in the shares of occupied, free and unexplored cells."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from dpmjax.viz import Limits, occupancy_figure
from dpmjax.viz.occupancy import UNEXPLORED_GREY


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
    image = rendered_map(occupancy_figure((probability, explored, (0, 100, 0, 60)), None, "px"))
    grey = np.abs(image - round(255 * UNEXPLORED_GREY)).max(axis=-1) <= 2
    white = image.min(axis=-1) > 250
    black = image.max(axis=-1) < 5
    assert grey.mean() == pytest.approx((~explored).mean(), abs=0.03)  # frame and scale bar cover up to 3 %
    assert white.mean() == pytest.approx((explored & (probability < 0.5)).mean(), abs=0.03)
    assert black.mean() == pytest.approx((explored & (probability > 0.5)).mean(), abs=0.03)


def test_row_zero_is_the_smallest_y():
    probability, explored = np.zeros((20, 20)), np.ones((20, 20), bool)
    probability[:5] = 1.0
    image = rendered_map(occupancy_figure((probability, explored, (0, 10, 0, 10)), None, "m"))
    assert image[-20:].mean() < 60
    assert image[20:100].mean() > 240


def test_trajectory_is_drawn_in_world_coordinates():
    probability, explored = example()
    path = np.array([[10.0, 10.0], [90.0, 50.0]])
    figure = occupancy_figure((probability, explored, (0, 100, 0, 60)), path, "px")
    assert any(np.array_equal(line.get_xydata(), path) for line in figure.axes[0].lines)
    assert figure.axes[0].get_xlim() == (0, 100)
    assert figure.axes[0].get_ylim() == (0, 60)


def test_a_quarter_turn_of_the_world_turns_the_picture():
    probability, explored = np.zeros((20, 20)), np.ones((20, 20), bool)
    probability[:5] = 1.0  # the wall of the smallest y
    T_view_world = np.array([[0.0, -1.0, 10.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    path = np.array([[1.0, 2.0]])
    limits = Limits(0.0, 20.0, 0.0, 10.0)
    figure = occupancy_figure(
        (probability, explored, (0, 10, 0, 10)), path, "m", T_view_world=T_view_world, limits=limits
    )
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
        occupancy_figure((np.zeros((4, 5)), np.ones(explored_shape, bool), extent), None, "px")
