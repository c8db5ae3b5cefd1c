"""Laws of the worlds, of the walk through them, and of the simulated sequence."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.stats import kstest

from dpmjax.simulation import World, make_world, simulate_sequence, simulate_trajectory
from dpmjax.simulation.walk2d import simulate_odometry
from dpmjax.simulation.world2d import beam_angles, cast_rays

WORLDS = [0, 1, 2]
NAMED = ["grove", "grove-4"]
world = lru_cache(make_world)


@lru_cache
def walk(index):
    return simulate_trajectory(world(index), 256, rng=np.random.default_rng([index, 0]))


@pytest.mark.parametrize("index", WORLDS + NAMED)
def test_world_is_the_papers_size_and_one_free_space(index):
    grid = world(index).is_obstacle
    assert grid.shape == (1024, 1024)
    assert label(~grid)[1] == 1
    assert 0.05 < grid.mean() < 0.6
    np.testing.assert_array_equal(make_world(index).is_obstacle, grid)


@pytest.mark.slow
def test_a_name_is_a_kind_with_a_seed():
    for name, index in (("office-3", 3), ("yard-1", 1), ("office", 0)):
        np.testing.assert_array_equal(make_world(name).is_obstacle, make_world(index).is_obstacle)
        assert make_world(name).name == make_world(index).name
    assert (world("grove").is_obstacle != world("grove-4").is_obstacle).mean() > 0.02


def longest_straight_edge(grid):
    edges = [grid[1:] != grid[:-1], (grid[:, 1:] != grid[:, :-1]).T]
    starts = [np.flatnonzero(np.diff(np.pad(line, 1).astype(int))) for edge in edges for line in edge]
    return max((int((run[1::2] - run[::2]).max()) for run in starts if len(run)), default=0)


def test_a_grove_has_no_straight_wall_and_no_view_of_the_border():
    for name in ("grove", "grove-4"):
        grid = world(name).is_obstacle
        assert longest_straight_edge(grid) < 60 < 300 < longest_straight_edge(world(0).is_obstacle)
        assert grid[[0, -1]].all()
        assert grid[:, [0, -1]].all()


@pytest.mark.parametrize("index", WORLDS)
def test_steps_have_the_papers_statistics(index):
    poses = walk(index)
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    turns = (np.diff(poses[:, 2]) + np.pi) % (2 * np.pi) - np.pi
    assert abs(steps.mean() - 8.16) < 0.5  # Five standard errors of 255 uniform steps.
    assert (np.abs(turns) <= np.deg2rad(10) + 1e-12).all()
    assert kstest(turns, "uniform", args=(-np.deg2rad(10), np.deg2rad(20))).pvalue > 1e-3


@pytest.mark.parametrize("index", WORLDS)
def test_walk_keeps_clear_of_walls_between_poses_too(index):
    poses = walk(index)
    step = np.diff(poses[:, :2], axis=0)
    ahead = cast_rays(world(index).is_obstacle, poses[:-1, :2], np.arctan2(step[:, 1], step[:, 0]))
    assert (ahead >= np.linalg.norm(step, axis=1) + 8.0).all()
    between = np.concatenate([poses[:-1, :2] + f * step for f in (0.0, 0.25, 0.5, 0.75)])
    fan = np.tile(beam_angles(64), len(between))
    assert cast_rays(world(index).is_obstacle, np.repeat(between, 64, axis=0), fan).min() >= 8.0


@pytest.mark.parametrize("index", WORLDS)
def test_walk_explores_and_comes_back(index):
    xy = walk(index)[:, :2]
    assert np.ptp(xy, axis=0).max() > 250
    seen_again = [np.linalg.norm(xy[: i - 60] - xy[i], axis=1).min() < 60 for i in range(61, 256)]
    assert np.mean(seen_again) > 0.05


def test_world_too_narrow_is_refused():
    grid = np.ones((100, 100), bool)
    grid[50:60, 10:90] = False
    with pytest.raises(ValueError, match="too narrow"):
        simulate_trajectory(World("slit", grid), 10, rng=np.random.default_rng(0))


def test_odometry_without_errors_is_the_walk_seen_from_its_first_pose():
    poses = walk(0)[:50]
    odometry = simulate_odometry(poses, rng=np.random.default_rng(0), translation_noise=0, rotation_noise_deg=0, bias=0)
    cos, sin = np.cos(poses[0, 2]), np.sin(poses[0, 2])
    np.testing.assert_allclose(odometry[:, :2] @ [[cos, sin], [-sin, cos]] + poses[0, :2], poses[:, :2], atol=1e-9)
    drifting = simulate_odometry(poses, rng=np.random.default_rng(0))
    assert 0.01 < np.linalg.norm(drifting[-1, :2] - odometry[-1, :2]) < 100


def test_the_walk_of_a_sequence_knows_nothing_of_noise():
    clean, noisy = (simulate_sequence(0, 6, seed=3, range_noise_px=x, with_odometry=x > 0) for x in (0.0, 1.0))
    np.testing.assert_array_equal(clean.reference_poses, noisy.reference_poses)
    assert not np.array_equal(clean.points, noisy.points)
    assert clean.points.shape == (6, 256, 2)
    assert clean.points.dtype == np.float32
    assert clean.unit == "px"
    assert clean.odometry_poses is None
    assert noisy.odometry_poses.shape == (6, 3)
    assert not np.array_equal(clean.points, simulate_sequence(0, 6, seed=4).points)
