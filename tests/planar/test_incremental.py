from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import planar_scans
from dpmjax.slam import incremental_icp
from dpmjax.slam.planar.track import scan_odometry
from tests.planar.conftest import ate


@pytest.fixture(scope="module")
def chained(walk_scans) -> np.ndarray:
    return incremental_icp(walk_scans).poses


def test_chain_recovers_a_noise_free_walk(walk, chained) -> None:
    assert ate(chained, walk.reference_poses) < 0.05
    true = se2.relative(walk.reference_poses[:1], walk.reference_poses)
    np.testing.assert_allclose(chained, true, atol=0.2)
    np.testing.assert_array_equal(chained[0], np.zeros(3))


def test_chain_is_bounded_under_noise(noisy_walk, noisy_walk_scans) -> None:
    assert ate(incremental_icp(noisy_walk_scans).poses, noisy_walk.reference_poses) < 1.5


@pytest.mark.slow
def test_point_metric_recovers_the_walk_roughly(walk, walk_scans) -> None:
    poses, steps = incremental_icp(walk_scans, "point")
    assert ate(poses, walk.reference_poses) < 3.0
    assert len(steps.poses) == len(poses) - 1


def test_odometry_is_the_guess(walk, walk_scans) -> None:
    # Without it, a scan turned by half a turn against the one before would not be found.
    turned = walk.reference_poses.copy()
    turned[12:, 2] += np.pi
    sign = np.where(np.arange(24) < 12, 1.0, -1.0)[:, None, None].astype(np.float32)
    names = ("points", "normals", "centroids")
    scans = replace(walk_scans, **{name: sign * getattr(walk_scans, name) for name in names})
    rng = np.random.default_rng(0)
    steps = se2.relative(turned[:-1], turned[1:]) + rng.normal(size=(23, 3)) * [2.0, 2.0, 0.03]
    poses, _ = incremental_icp(scans, odometry=se2.chain(steps))
    assert ate(poses, turned) < 0.1
    assert abs(se2.wrap_angle(poses[12:13, 2] - poses[11, 2])[0]) > 2.5


@pytest.mark.slow
def test_a_scan_that_fits_nowhere_is_bridged(walk, chained) -> None:
    points = np.array(walk.points)
    # Someone stands around the sensor: short ranges all round.
    points[11] *= 4.0 / np.linalg.norm(points[11], axis=-1, keepdims=True)
    points[11] *= np.random.default_rng(0).uniform(0.7, 1.3, (len(points[11]), 1)).astype(np.float32)
    poses = incremental_icp(planar_scans(points, walk.mask)).poses
    others = np.delete(np.arange(len(poses)), 11)
    assert ate(poses[others], walk.reference_poses[others]) < 0.1


@pytest.mark.slow
def test_a_step_without_a_match_is_no_standing_robot(walk) -> None:
    points = walk.points[:4].copy()
    points[3] = 0.2 * points[3]
    scans = planar_scans(points)
    motion = scan_odometry(scans)
    assert np.hypot(*(motion[3] - motion[2])[:2]) > 0.5 * scans.typical_range
    assert np.hypot(*(motion[2] - motion[1])[:2]) < 0.5 * scans.typical_range


def test_one_scan_is_a_trajectory(walk_scans) -> None:
    np.testing.assert_array_equal(incremental_icp(walk_scans.take(slice(1))).poses, np.zeros((1, 3)))
