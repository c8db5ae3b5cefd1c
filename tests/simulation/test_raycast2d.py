"""Laws of the ray caster; oracles are fine marching and the analytic box."""

import numpy as np
import pytest

from dpmjax.simulation.walk2d import scan_world
from dpmjax.simulation.world2d import beam_angles, cast_rays

EXACT = 1e-9  # float64 products of coordinates up to 1e3.
FLOAT32 = 1e-4  # The same stored as float32.


def march(is_obstacle, origin, angle, step=1e-3):
    """Length at which a beam first stands in an obstacle or outside, by small steps."""
    height, width = is_obstacle.shape
    length = np.arange(0, 60, step)
    cell = np.floor(origin + length[:, None] * [np.cos(angle), np.sin(angle)]).astype(int)
    outside = (cell < 0).any(1) | (cell >= [width, height]).any(1)
    inside = np.clip(cell, 0, [width - 1, height - 1])
    return length[np.argmax(outside | is_obstacle[inside[:, 1], inside[:, 0]])]


@pytest.mark.parametrize("density", [0.02, 0.2])
def test_beams_end_where_marching_ends(density):
    rng = np.random.default_rng(1)
    grid = rng.random((40, 30)) < density
    free = np.argwhere(~grid)[rng.integers(0, (~grid).sum(), 60)]
    origins, angles = free[:, ::-1] + rng.uniform(0.01, 0.99, (60, 2)), rng.uniform(-4, 4, 60)
    ranges = cast_rays(grid, origins, angles)
    marched = np.array([march(grid, o, a) for o, a in zip(origins, angles, strict=True)])
    # Marching is late by a step at most, unless it jumps over a corner: such a beam cuts less than a step of a pixel.
    late = marched - ranges
    assert (late > -1e-9).all()
    assert (late <= 1e-3 + EXACT).mean() >= 0.98


def test_empty_image_gives_the_border_box_exactly():
    rng = np.random.default_rng(2)
    origins, angles = rng.uniform([0, 0], [50, 30], (200, 2)), rng.uniform(-np.pi, np.pi, 200)
    ranges = cast_rays(np.zeros((30, 50), bool), origins, angles)
    d = np.column_stack([np.cos(angles), np.sin(angles)])
    wall = np.where(d > 0, [50.0, 30.0], 0.0)
    np.testing.assert_allclose(ranges, ((wall - origins) / d).min(axis=1), atol=EXACT)


@pytest.mark.parametrize(("angle", "expected"), [(0.0, 4.5), (np.pi, 2.5), (np.pi / 2, 3.5), (-np.pi / 2, 2.5)])
def test_axis_parallel_beams_are_exact(angle, expected):
    grid = np.zeros((9, 9), bool)
    grid[2, 7] = grid[6, 2] = True
    np.testing.assert_allclose(cast_rays(grid, [[2.5, 2.5]], [angle]), expected, atol=1e-12)


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_beams_that_start_on_a_corner_run_along_edges_to_the_end(quarter):
    grid = np.zeros((33, 33), bool)
    grid[[0, -1]] = grid[:, [0, -1]] = True
    ranges = cast_rays(grid, [[16.0, 16.0]], [quarter * np.pi / 2])
    np.testing.assert_allclose(ranges, 16 if quarter < 2 else 15, atol=1e-9)


def test_diagonal_gap_is_closed():
    grid = np.zeros((6, 6), bool)
    grid[3, 2] = grid[2, 3] = True
    np.testing.assert_allclose(cast_rays(grid, [[2.5, 2.5]], [np.pi / 4]), np.sqrt(0.5), atol=EXACT)


@pytest.mark.parametrize("origin", [[1.5, 1.5], [-0.1, 2.0], [9.0, 2.0], [np.nan, 2.0]])
def test_origin_outside_of_free_space_is_refused(origin):
    grid = np.zeros((9, 9), bool)
    grid[1, 1] = True
    with pytest.raises(ValueError, match="origins must lie"):
        cast_rays(grid, [origin], [0.0])


def test_no_beams_give_no_hits():
    assert cast_rays(np.zeros((5, 5), bool), np.zeros((0, 2)), []).shape == (0,)


def test_scan_is_in_the_sensor_frame_and_starts_ahead():
    pose = np.array([20.3, 11.8, 0.7])
    points, mask = scan_world(np.zeros((40, 50), bool), pose[None], num_beams=64)
    assert mask.all()
    np.testing.assert_allclose(np.arctan2(points[0, :, 1], points[0, :, 0]) % (2 * np.pi), beam_angles(64), atol=1e-6)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    world = points[0] @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    at_wall = np.minimum(np.abs(world - [0, 0]), np.abs(world - [50, 40])).min(axis=1)
    np.testing.assert_allclose(at_wall, 0, atol=FLOAT32)


def test_beams_beyond_the_limit_are_masked_and_zero():
    points, mask = scan_world(np.zeros((100, 100), bool), [[50.2, 50.1, 0.0]], num_beams=128, max_range=55.0)
    ranges = scan_world(np.zeros((100, 100), bool), [[50.2, 50.1, 0.0]], num_beams=128)[0]
    np.testing.assert_array_equal(mask, np.linalg.norm(ranges, axis=2) <= 55.0)
    assert 0 < mask.sum() < 128
    assert (points[~mask] == 0).all()


def test_range_noise_lies_along_the_beam_and_has_its_deviation():
    world, pose = np.zeros((400, 400), bool), [[200.0, 200.0, 0.3]] * 40
    clean, _ = scan_world(world, pose)
    noisy, _ = scan_world(world, pose, range_noise_px=2.0, rng=np.random.default_rng(5))
    again, _ = scan_world(world, pose, range_noise_px=2.0, rng=np.random.default_rng(5))
    np.testing.assert_array_equal(noisy, again)
    error = np.linalg.norm(noisy, axis=2) - np.linalg.norm(clean, axis=2)
    assert abs(error.std() - 2.0) < 0.1
    assert abs(error.mean()) < 0.1
    with pytest.raises(ValueError, match="rng"):
        scan_world(world, pose, range_noise_px=2.0)
