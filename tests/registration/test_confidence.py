"""Trust without the truth."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.registration import judge_trajectory
from dpmjax.registration.line_fitting import fit_lines
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet


@pytest.fixture(scope="module")
def walk():
    return simulate_sequence(0, 41, seed=1).take(slice(0, None, 4))


def lines_of(walk):
    return fit_lines(ScanSet(jnp.asarray(walk.points), jnp.asarray(walk.mask)))


def test_truth_is_trusted(walk) -> None:
    verdict = judge_trajectory(lines_of(walk), walk.mask, walk.reference_poses)
    assert verdict.is_good
    assert verdict.contradiction < 0.01


@pytest.mark.parametrize("shift", [(80.0, 0.0, 0.0), (0.0, 0.0, 0.6)])
def test_a_torn_map_is_not(walk, shift) -> None:
    poses = walk.reference_poses.copy()
    poses[len(poses) // 2 :] += shift
    assert not judge_trajectory(lines_of(walk), walk.mask, poses).is_good


def test_collapsed_poses_are_not(walk) -> None:
    assert not judge_trajectory(lines_of(walk), walk.mask, np.zeros((len(walk), 3))).is_good


def test_what_noise_has_drowned_is_not_trusted() -> None:
    walk = simulate_sequence(0, 41, seed=1, range_noise_px=12.0).take(slice(0, None, 4))
    assert not judge_trajectory(lines_of(walk), walk.mask, walk.reference_poses).is_good


def test_trust_does_not_depend_on_the_world_frame(walk) -> None:
    moved = walk.reference_poses + np.array([500.0, -300.0, 0.0])
    one = judge_trajectory(lines_of(walk), walk.mask, walk.reference_poses)
    other = judge_trajectory(lines_of(walk), walk.mask, moved)
    assert one.weakest_joint == pytest.approx(other.weakest_joint, abs=1e-3)
