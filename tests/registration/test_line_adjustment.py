"""The alignment to walls that all scans make together."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.metrics import absolute_trajectory_error, position_bound
from dpmjax.registration import WallConfig, align_to_walls
from dpmjax.registration.line_fitting import fit_lines
from dpmjax.simulation import cast_scans, make_world
from dpmjax.types import ScanSet

CONFIG = WallConfig(num_neighbours=12, num_rounds=3)


def ate(poses: np.ndarray, reference: np.ndarray) -> float:
    return absolute_trajectory_error(poses[:, :2], reference[:, :2])


@pytest.fixture(scope="module")
def start(noisy_walk) -> np.ndarray:
    shake = np.random.default_rng(1).normal(size=(len(noisy_walk), 3)) * [0.5, 0.5, 0.005]
    shake[0] = 0.0
    return noisy_walk.reference_poses + shake


@pytest.fixture(scope="module")
def aligned(noisy_walk_lines, start) -> np.ndarray:
    return align_to_walls(noisy_walk_lines, start, CONFIG)


def test_walls_bring_poses_near_the_bound(noisy_walk, start, aligned) -> None:
    # The bound is for a world that is known; 24 scans make a world that is 1.6 times worse, at most.
    cast = partial(cast_scans, make_world(0).is_obstacle, num_beams=noisy_walk.mask.shape[1])
    bound = position_bound(cast, noisy_walk.reference_poses, range_noise=1.0)
    best = float(np.sqrt((bound**2).mean()))
    assert ate(start, noisy_walk.reference_poses) > 4 * best
    assert 0.8 * best < ate(aligned, noisy_walk.reference_poses) < 1.6 * best


def test_walls_hold_the_first_pose(start, aligned) -> None:
    np.testing.assert_allclose(aligned[0], start[0], atol=1e-6)


def test_walls_move_with_the_world(noisy_walk_lines, start, aligned) -> None:
    offset = np.array([300.0, -200.0, 1.1])
    moved = align_to_walls(noisy_walk_lines, se2.compose(offset, start), CONFIG)
    np.testing.assert_allclose(se2.relative(np.broadcast_to(offset, moved.shape), moved), aligned, atol=2e-3)


def test_walls_do_not_depend_on_the_order_of_scans(noisy_walk_lines, start, aligned) -> None:
    order = np.concatenate([[0], np.random.default_rng(3).permutation(np.arange(1, len(start)))])
    shuffled = align_to_walls(jax.tree.map(lambda x: x[order], noisy_walk_lines), start[order], CONFIG)
    np.testing.assert_allclose(shuffled, aligned[order], atol=2e-3)


def test_walls_never_use_masked_beams(noisy_walk, start) -> None:
    mask = noisy_walk.mask & (np.random.default_rng(2).uniform(size=noisy_walk.mask.shape) < 0.9)
    results = []
    for filling in (0.0, np.nan):
        points = np.where(mask[..., None], noisy_walk.points, np.float32(filling))
        results.append(align_to_walls(fit_lines(ScanSet(jnp.asarray(points), jnp.asarray(mask))), start, CONFIG))
    np.testing.assert_array_equal(results[0], results[1])


def test_walls_leave_alone_what_has_no_noise_or_no_neighbour(noisy_walk_lines, start) -> None:
    quiet = noisy_walk_lines.replace(noise=jnp.zeros_like(noisy_walk_lines.noise))
    np.testing.assert_array_equal(align_to_walls(quiet, start, CONFIG), start)
    alone = jax.tree.map(lambda x: x[:1], noisy_walk_lines)
    np.testing.assert_array_equal(align_to_walls(alone, start[:1], CONFIG), start[:1])


def test_walls_survive_scans_that_share_nothing(noisy_walk_lines, start) -> None:
    blind = noisy_walk_lines.replace(mask=noisy_walk_lines.mask.at[5].set(False))
    aligned = align_to_walls(blind, start, CONFIG)
    assert np.isfinite(aligned).all()
    # Nothing says where it is: it stays.
    np.testing.assert_allclose(aligned[5], start[5], atol=1e-3)
