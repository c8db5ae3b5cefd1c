"""Baselines: swarms, Open3D's multiway registration, and the plain chain of ICP."""

import itertools

import jax
import numpy as np
import pytest

from dpmjax import chamfer_distance, metrics
from dpmjax.deepmapping import preset
from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.simulation import simulate_depth_sequence, simulate_sequence
from dpmjax.types import ScanSet
from experiments._baselines import align, chain_icp, multiway, multiway_images, swarm_poses
from tests.optional import import_or_skip


@pytest.fixture(scope="module")
def walk() -> ScanSequence:
    return simulate_sequence(0, 6, seed=3)


def scans_of(walk: ScanSequence) -> ScanSet:
    return ScanSet(walk.points, walk.mask)


@pytest.mark.slow
def test_swarms_over_all_poses_improve_with_time(walk) -> None:
    import_or_skip("evosax")
    config, scans = preset("fast"), scans_of(walk.take(np.arange(3)))
    poses = [swarm_poses(scans, config, cpu_s=seconds, key=jax.random.key(0)) for seconds in (0.0, 2.0)]
    chain = [se2.transform_points(found, np.asarray(scans.points)) for found in poses]
    misfits = [np.mean([float(chamfer_distance(a, b)) for a, b in itertools.pairwise(points)]) for points in chain]
    assert misfits[1] <= misfits[0]
    assert all((found[0] == 0.0).all() for found in poses)


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_plain_chain_is_textbook_icp_composed(walk, metric) -> None:
    poses = chain_icp(scans_of(walk), metric)
    assert (poses[0] == 0.0).all()
    one, other = (np.asarray(walk.points[k][walk.mask[k]], np.float64) for k in (1, 2))
    step = align(other, one, metric, 1e-6)
    np.testing.assert_allclose(se2.compose(poses[1], step), poses[2], atol=1e-3)
    # At the end no pair of nearest points can be brought closer together.
    moved = se2.transform_points(step, other)
    nearest = one[np.linalg.norm(moved[:, None] - one, axis=-1).argmin(axis=1)]
    if metric == "point":
        R = metrics.align_rigid(moved, nearest)
        np.testing.assert_allclose(R, np.eye(3), atol=2e-2)


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_plain_icp_finds_a_small_motion(metric) -> None:
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    target = np.column_stack([3.0 * np.cos(angle) + 0.3 * np.cos(3 * angle), np.sin(angle)])
    pose = np.array([0.03, -0.02, 0.01])
    source = se2.transform_points(se2.inverse(pose), target)
    np.testing.assert_allclose(align(rng.permutation(source), target, metric, 1e-9), pose, atol=2e-3)


def test_multiway_finds_a_short_walk(walk) -> None:
    import_or_skip("open3d")
    poses = multiway(scans_of(walk))
    assert np.all(poses[0] == 0.0)
    assert absolute_trajectory_error(poses[:, :2], walk.reference_poses[:, :2]) < 1.0


def test_multiway_finds_small_motions_of_depth_images() -> None:
    import_or_skip("open3d")
    view = simulate_depth_sequence(0, 2, seed=1)
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    T_world_camera[1:, 0, 3] = 0.03, 0.06
    points = np.stack([view.points[0] - T[:3, 3].astype(np.float32) for T in T_world_camera])
    found = multiway_images(points, np.stack([view.mask[0]] * 3))
    np.testing.assert_allclose(found, T_world_camera, atol=1e-3)
