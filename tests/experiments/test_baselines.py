"""Baselines that stand on other packages: swarms and Open3D's multiway registration."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.simulation import simulate_depth_sequence, simulate_sequence
from dpmjax.types import ScanSet
from experiments._baselines import Swarms, multiway, multiway_images, swarm_chain
from tests.optional import import_or_skip

QUICK = Swarms(num_particles=24, num_iterations=30, num_rounds=1, num_beams=64)


@pytest.fixture(scope="module")
def walk() -> ScanSequence:
    return simulate_sequence(0, 6, seed=3)


def scans_of(walk: ScanSequence, hidden: float = 0.0) -> ScanSet:
    """The scans; what is hidden holds `hidden`."""
    return ScanSet(np.where(walk.mask[..., None], walk.points, np.float32(hidden)), walk.mask)


def ate(poses: np.ndarray, walk: ScanSequence) -> float:
    return absolute_trajectory_error(poses[:, :2], walk.reference_poses[:, :2])


@pytest.fixture
def with_swarms() -> None:
    import_or_skip("evosax")


@pytest.fixture
def with_open3d() -> None:
    import_or_skip("open3d")


@pytest.mark.slow
@pytest.mark.usefixtures("with_swarms")
def test_swarms_find_a_short_walk(walk) -> None:
    start = ate(np.zeros((len(walk), 3)), walk)
    found = ate(swarm_chain(scans_of(walk), QUICK, key=jax.random.key(0)), walk)
    assert start > 10.0
    assert found < 3.0


@pytest.mark.usefixtures("with_swarms")
def test_swarms_never_see_masked_beams(walk) -> None:
    mask = walk.mask & (np.random.default_rng(0).uniform(size=walk.mask.shape) < 0.9)
    one, other = (
        swarm_chain(scans_of(replace(walk, mask=mask), hidden), QUICK._replace(num_iterations=3), key=jax.random.key(1))
        for hidden in (0.0, 1e4)
    )
    np.testing.assert_array_equal(one, other)


@pytest.mark.usefixtures("with_open3d")
def test_multiway_finds_a_short_walk(walk) -> None:
    poses = multiway(scans_of(walk))
    assert np.all(poses[0] == 0.0)
    assert ate(poses, walk) < 1.0


@pytest.mark.usefixtures("with_open3d")
def test_multiway_finds_small_motions_of_depth_images() -> None:
    view = simulate_depth_sequence(0, 2, seed=1)
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    T_world_camera[1:, 0, 3] = 0.03, 0.06
    points = np.stack([view.points[0] - T[:3, 3].astype(np.float32) for T in T_world_camera])
    found = multiway_images(points, np.stack([view.mask[0]] * 3))
    np.testing.assert_allclose(found, T_world_camera, atol=1e-3)
