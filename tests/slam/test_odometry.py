"""Laws of the geometry: a scan of a simulated room finds its pose among recent scans."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid
from dpmjax.slam import PosePrior, SurfaceGeometry
from dpmjax.slam.keyframes import diagonal_information, orthonormal, turn_rad


def planes(rng: np.random.Generator, *, is_corridor: bool = False, num: int = 4000) -> np.ndarray:
    """Points on floor and walls; a corridor has no end, a room has one and a pillar."""
    a, b = rng.uniform(-1, 1, (2, num))
    floor = np.column_stack([20 * a, 4 * b, np.full(num, -1.5)])
    walls = np.column_stack([20 * a, np.where(b > 0, 4.0, -4.0), 3 * rng.uniform(-0.5, 1, num)])
    parts = [floor, walls]
    if not is_corridor:
        ends = np.column_stack([np.where(a > 0, 15.0, -13.0), 4 * b, 3 * rng.uniform(-0.5, 1, num)])
        pillar = np.column_stack([np.full(num, 5.0), 1 + 0.7 * a, 3 * rng.uniform(-0.5, 1, num)])
        parts += [ends, pillar]
    return np.concatenate(parts)


def motion(x: float, y: float, heading_deg: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", heading_deg, degrees=True).as_matrix()
    T[:2, 3] = x, y
    return T


def seen_from(points: np.ndarray, T_world_scan: np.ndarray) -> np.ndarray:
    return (points - T_world_scan[:3, 3]) @ T_world_scan[:3, :3]


@pytest.fixture(scope="module")
def geometry() -> SurfaceGeometry:
    return SurfaceGeometry()


@pytest.mark.parametrize(("x", "y", "heading_deg"), [(0.3, 0.1, 3.0), (1.0, -0.2, -20.0), (0.0, 0.0, 35.0)])
def test_a_scan_finds_its_pose(geometry, x, y, heading_deg) -> None:
    rng = np.random.default_rng(0)
    true = motion(x, y, heading_deg)
    local_map = geometry.insert(None, geometry.measure(planes(rng)), np.eye(4), 0)
    found = geometry.align(local_map, geometry.measure(seen_from(planes(rng), true)), PosePrior(np.eye(4), np.eye(4)))
    apart = rigid.inverse(true) @ found.T_map_scan
    assert np.linalg.norm(apart[:3, 3]) < 0.03
    assert turn_rad(apart) < 0.01
    assert found.score > 0.5


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_sparse_scan_of_a_robot_that_tilts_finds_its_pose(geometry, axis) -> None:
    # A lidar of few beams on a vehicle that balances: 1,200 points, 12 degrees from one scan to the next.
    rng = np.random.default_rng(1)
    true = motion(1.0, 0.1, 3.0)
    true[:3, :3] = true[:3, :3] @ Rotation.from_euler(axis, 12.0, degrees=True).as_matrix()
    local_map = geometry.insert(None, geometry.measure(planes(rng, num=1500)), np.eye(4), 0)
    sparse = seen_from(planes(rng, num=300), true)
    prior = PosePrior(np.eye(4), motion(1.0, 0.0, 0.0))
    found = geometry.align(local_map, geometry.measure(sparse), prior)
    apart = rigid.inverse(true) @ found.T_map_scan
    assert np.linalg.norm(apart[:3, 3]) < 0.1
    assert turn_rad(apart) < 0.02


def test_a_corridor_is_weak_along_its_axis(geometry) -> None:
    rng = np.random.default_rng(0)
    weakness = []
    for is_corridor in (False, True):
        scans = [geometry.measure(planes(rng, is_corridor=is_corridor)) for _ in range(2)]
        local_map = geometry.insert(None, scans[0], np.eye(4), 0)
        found = geometry.align(local_map, scans[1], PosePrior(np.eye(4), np.eye(4)))
        covariance = np.linalg.inv(found.information)
        weakness.append(covariance[0, 0] / covariance[1, 1])
        np.testing.assert_allclose(found.information, found.information.T)
    assert weakness[1] > 5 * weakness[0]


def test_a_scan_of_another_place_scores_low(geometry) -> None:
    rng = np.random.default_rng(0)
    local_map = geometry.insert(None, geometry.measure(planes(rng)), np.eye(4), 0)
    elsewhere = geometry.measure(rng.uniform(-8, 8, (4000, 3)))
    assert geometry.align(local_map, elsewhere, PosePrior(np.eye(4), np.eye(4))).score < 0.3


def test_empty_scans_are_none(geometry) -> None:
    assert geometry.measure(np.zeros((0, 3))) is None
    assert geometry.measure(np.zeros((5000, 3))) is None
    assert geometry.measure(np.full((5000, 3), 1e6)) is None


def test_a_moved_map_gives_the_moved_pose(geometry) -> None:
    rng = np.random.default_rng(0)
    scans = [geometry.measure(planes(rng)) for _ in range(2)]
    local_map = geometry.insert(None, scans[0], np.eye(4), 0)
    T_new_map = motion(2.0, 1.0, 50.0)
    found = geometry.align(local_map, scans[1], PosePrior(np.eye(4), np.eye(4)))
    moved = geometry.align(geometry.move(local_map, T_new_map), scans[1], PosePrior(T_new_map, np.eye(4)))
    np.testing.assert_allclose(moved.T_map_scan, T_new_map @ found.T_map_scan, atol=1e-9)


def test_a_scan_that_tells_nothing_new_does_not_join(geometry) -> None:
    measured = geometry.measure(planes(np.random.default_rng(0)))
    local_map = geometry.insert(None, measured, np.eye(4), 0)
    assert geometry.insert(local_map, measured, motion(0.01, 0, 0), 1) is local_map
    for step in range(1, geometry.config.num_frames + 8):
        local_map = geometry.insert(local_map, measured, motion(3 * step, 0, 0), step)
    assert len(local_map.frames) == geometry.config.num_frames


def test_a_map_that_has_lost_old_scans_is_that_of_the_scans_it_holds(geometry) -> None:
    rng = np.random.default_rng(0)
    measured = [geometry.measure(planes(rng)) for _ in range(geometry.config.num_frames + 4)]
    local_map = None
    for scan, one in enumerate(measured):
        local_map = geometry.insert(local_map, one, motion(2.0 * scan, 0.1 * scan, 3.0 * scan), scan)
        local_map = geometry.move(local_map, motion(-1.0, 0.5, 4.0))
    again = geometry.unpack(geometry.pack(local_map), lambda scan: measured[scan])
    assert set(local_map.scans) == set(range(4, len(measured)))
    for name in ("points", "normals", "flatness", "samples"):
        np.testing.assert_array_equal(getattr(again.surface, name), getattr(local_map.surface, name))


def test_rounding_errors_of_a_rotation_are_removed() -> None:
    T = motion(1, 2, 30)
    rough = T.copy()
    rough[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    R = orthonormal(rough)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(orthonormal(T), T, atol=1e-12)


def test_information_is_the_inverse_covariance() -> None:
    np.testing.assert_allclose(np.linalg.inv(diagonal_information(0.1, 0.02)), np.diag([0.01] * 3 + [0.0004] * 3))
