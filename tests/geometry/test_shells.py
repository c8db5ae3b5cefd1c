"""Laws of shells: points at the largest range are no echoes, walls and rooms are."""

import numpy as np
import pytest

from dpmjax.geometry.shells import shell_radius, without_shell


def directions(count: int, dim: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).standard_normal((count, dim))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def room(dim: int, half: float = 10.0, count: int = 4000) -> np.ndarray:
    """Points on the walls of a square or a cube about the sensor, off its centre."""
    ways = directions(count, dim)
    offset = np.full(dim, 0.3) * half
    reach = (half - np.sign(ways) * offset) / np.abs(ways)
    return ways * reach.min(axis=1, keepdims=True)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.4])
def test_a_shell_is_found_and_the_room_stays(dim: int, noise: float, share: float) -> None:
    walls, count = room(dim), round(share * 4000)
    ranges = 40.0 + noise * np.random.default_rng(1).standard_normal((count, 1))
    radius = shell_radius(np.concatenate([walls, ranges * directions(count, dim, seed=1)]))
    assert np.linalg.norm(walls, axis=1).max() < radius
    assert (ranges < radius).mean() < 0.03


def test_the_codes_of_one_sensor_are_one_shell() -> None:
    codes = np.random.default_rng(0).choice([8.183, 8.187, 8.189, 8.191], (800, 1))
    radius = shell_radius(np.concatenate([room(2, half=4.0), codes * directions(800, 2, seed=1)]))
    assert 8.1 < radius < 8.183


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_are_no_shell(dim: int) -> None:
    assert shell_radius(room(dim)) is None
    # A far wall ahead, which nothing exceeds.
    angles = np.linspace(-0.6, 0.6, 500)
    wall = np.stack([30.0 * np.ones(500), 30.0 * np.tan(angles), *np.zeros((dim - 2, 500))], axis=1)
    assert shell_radius(np.concatenate([room(dim), wall])) is None
    # Ranges that are cut off have the same density up to their end.
    cut = room(dim, half=50.0, count=20000) * np.random.default_rng(2).uniform(0, 1, (20000, 1))
    assert shell_radius(cut[np.linalg.norm(cut, axis=1) < 20.0]) is None


def test_a_round_tank_is_no_shell() -> None:
    assert shell_radius(5.0 * directions(2000, 3)) is None


def test_few_points_are_no_shell() -> None:
    assert shell_radius(np.zeros((0, 3))) is None
    assert shell_radius(np.concatenate([room(3), 40.0 * directions(8, 3)])) is None


def test_a_shell_is_left_out_with_a_warning() -> None:
    walls = room(3)
    scan = np.concatenate([walls, 40.0 * directions(200, 3, seed=1), np.full((1, 3), np.nan)])
    with pytest.warns(UserWarning, match="without an echo"):
        kept = without_shell(scan)
    np.testing.assert_array_equal(kept, np.concatenate([walls, scan[-1:]]))
    assert without_shell(walls) is walls
