"""The bound on positions, against the one world where it can be written down."""

import numpy as np
import pytest

from dpmjax.metrics import position_bound
from dpmjax.simulation import cast_scans

HALF_WIDTH = 100


def bound_in_room(poses: np.ndarray, *, noise: float = 1.0, num_beams: int = 256) -> np.ndarray:
    grid = np.ones((2 * HALF_WIDTH + 2,) * 2, bool)
    grid[1:-1, 1:-1] = False
    return position_bound(lambda at: cast_scans(grid, at, num_beams=num_beams), poses, range_noise=noise)


CENTRE = np.array([[HALF_WIDTH + 1.0, HALF_WIDTH + 1.0, 0.3]])


@pytest.mark.parametrize("num_beams", [256, 1024])
def test_bound_in_the_middle_of_a_square_room_is_that_of_the_integral(num_beams: int) -> None:
    # The squares of 1 / cos over two quarters of a turn are 2 / pi of all beams; x, y and heading are independent.
    bound = bound_in_room(CENTRE, num_beams=num_beams)
    np.testing.assert_allclose(bound, np.sqrt(np.pi / num_beams), rtol=0.01)


def test_bound_is_infinite_where_a_direction_is_open() -> None:
    bound = bound_in_room(CENTRE, num_beams=2)
    assert np.isinf(bound).all()


def test_bound_is_kept_by_an_estimator_that_knows_the_room() -> None:
    # Least squares on noisy ranges from the true place, one step: its spread is the bound.
    rng, num_beams = np.random.default_rng(0), 256
    angles = np.arange(num_beams) * (2 * np.pi / num_beams)
    direction = np.stack([np.cos(angles), np.sin(angles)], 1)
    is_x = np.abs(direction[:, 0]) > np.abs(direction[:, 1])
    facing = np.where(is_x[:, None], [1.0, 0.0], [0.0, 1.0])
    jacobian = -facing * np.sign(direction) / np.abs((facing * direction).sum(1, keepdims=True))
    errors = np.linalg.lstsq(jacobian, rng.normal(size=(num_beams, 4000)))[0]
    bound = bound_in_room(CENTRE * [1, 1, 0], num_beams=num_beams)
    np.testing.assert_allclose(np.sqrt((errors**2).sum(0).mean()), bound[0], rtol=0.05)
