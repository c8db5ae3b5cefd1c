"""The adjustment to lines that all scans make together."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.metrics import position_bound
from dpmjax.simulation import cast_scans, make_world
from dpmjax.slam.planar.lines import adjust_to_lines
from tests.planar.conftest import ate


@pytest.fixture(scope="module")
def start(noisy_walk) -> np.ndarray:
    shake = np.random.default_rng(1).normal(size=(len(noisy_walk), 3)) * [0.5, 0.5, 0.005]
    shake[0] = 0.0
    return noisy_walk.reference_poses + shake


@pytest.fixture(scope="module")
def aligned(noisy_walk_scans, start) -> np.ndarray:
    return adjust_to_lines(noisy_walk_scans, start)


@pytest.mark.slow
def test_lines_bring_poses_near_the_bound(noisy_walk, start, aligned) -> None:
    # The bound is for a world that is known; 24 scans make a world that is 1.6 times worse, at most.
    cast = partial(cast_scans, make_world(0).is_obstacle, num_beams=noisy_walk.mask.shape[1])
    bound = position_bound(cast, noisy_walk.reference_poses, range_noise=1.0)
    best = float(np.sqrt((bound**2).mean()))
    assert ate(start, noisy_walk.reference_poses) > 4 * best
    assert 0.8 * best < ate(aligned, noisy_walk.reference_poses) < 1.6 * best


def test_lines_hold_the_first_pose(start, aligned) -> None:
    np.testing.assert_allclose(aligned[0], start[0], atol=1e-6)


def test_lines_move_with_the_world(noisy_walk_scans, start, aligned) -> None:
    offset = np.array([300.0, -200.0, 1.1])
    moved = adjust_to_lines(noisy_walk_scans, se2.compose(offset, start))
    np.testing.assert_allclose(se2.relative(np.broadcast_to(offset, moved.shape), moved), aligned, atol=2e-3)


def test_lines_do_not_depend_on_the_order_of_scans(noisy_walk_scans, start, aligned) -> None:
    order = np.concatenate([[0], np.random.default_rng(3).permutation(np.arange(1, len(start)))])
    shuffled = adjust_to_lines(noisy_walk_scans.take(order), start[order])
    np.testing.assert_allclose(shuffled, aligned[order], atol=2e-3)


def test_lines_leave_alone_what_has_no_noise_or_no_neighbour(noisy_walk_scans, start) -> None:
    quiet = replace(noisy_walk_scans, noise=0.0)
    np.testing.assert_array_equal(adjust_to_lines(quiet, start), start)
    alone = noisy_walk_scans.take(slice(1))
    np.testing.assert_array_equal(adjust_to_lines(alone, start[:1]), start[:1])


def test_lines_survive_scans_that_share_nothing(noisy_walk_scans, start) -> None:
    is_other = np.arange(len(start))[:, None] != 5
    blind = replace(noisy_walk_scans, is_on_line=noisy_walk_scans.is_on_line & is_other)
    aligned = adjust_to_lines(blind, start)
    assert np.isfinite(aligned).all()
    # Nothing says where it is: it stays.
    np.testing.assert_allclose(aligned[5], start[5], atol=1e-3)
