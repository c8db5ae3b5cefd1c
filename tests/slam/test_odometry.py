"""Laws of the geometry: a scan of a simulated room finds its pose in the local map."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dpmjax import model_preset
from dpmjax.deeppointmap.compact_scans import CompactScan, compact_elements, compact_image
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import turn_rad
from dpmjax.scan import Scan
from dpmjax.scan.lidar.record import MAX_ELEMENTS, SPREAD_M
from dpmjax.scan.lidar.slide import sigma_along
from dpmjax.slam import Alignment, KeyframeMap, LocalMap, OdometryConfig, SurfaceGeometry
from dpmjax.slam.keyframe_map import Keyframe, add_keyframe
from dpmjax.slam.local_map import local_map_of
from dpmjax.slam.surface_geometry import CONTRADICTION_WEIGHT
from dpmjax.types import SurfaceElements
from experiments.made_cases import scan_gallery


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


def compacted(scan: Scan) -> CompactScan:
    """The scan as a map keeps it, without descriptors."""
    none = np.zeros((0, 1), np.int8), np.zeros(0, np.float32), np.zeros(0, np.int8)
    surface = scan.surface
    elements = SurfaceElements(surface.points, surface.normals, surface.flatness, np.ones(len(surface.points), bool))
    return CompactScan(compact_elements(elements), *none, compact_image(scan.image))


def map_of_one(scan: Scan) -> LocalMap:
    """The local map after the first keyframe."""
    keyframe = Keyframe(0, np.eye(4), 0.0, 0, scan.extent_m, compacted(scan))
    return local_map_of(add_keyframe(KeyframeMap(), keyframe, np.eye(4), np.ones(1), None), (), OdometryConfig())


@pytest.fixture(scope="module")
def geometry() -> SurfaceGeometry:
    return SurfaceGeometry(model_preset("small"))


@pytest.fixture(scope="module")
def room(geometry) -> LocalMap:
    return map_of_one(geometry.thin(planes(np.random.default_rng(0))))


def assert_is_at(found: Alignment, true: np.ndarray, most_m: float, most_rad: float) -> None:
    apart = rigid.inverse(true) @ found.T_map_scan
    assert np.linalg.norm(apart[:3, 3]) < most_m
    assert turn_rad(apart) < most_rad


@pytest.mark.parametrize(("x", "y", "heading_deg"), [(0.3, 0.1, 3.0), (0.0, 0.0, 0.0), (-0.2, 0.2, -4.0)])
def test_a_scan_finds_its_pose_from_a_guess_that_is_nearly_right(geometry, room, x, y, heading_deg) -> None:
    true = motion(x, y, heading_deg)
    scan = geometry.thin(seen_from(planes(np.random.default_rng(1)), true))
    found = geometry.align(room, scan, np.eye(4))
    assert_is_at(found, true, 0.03, 0.01)
    assert found.score > 0.5


@pytest.mark.parametrize(
    ("x", "y", "heading_deg"), [(1.0, -0.2, -20.0), (0.0, 0.0, 35.0), (1.5, 0.0, 0.0), (0.0, 0.0, 170.0)]
)
def test_a_scan_finds_its_pose_among_other_motions(geometry, room, x, y, heading_deg) -> None:
    true = motion(x, y, heading_deg)
    scan = geometry.thin(seen_from(planes(np.random.default_rng(1)), true))
    starts = geometry.other_motions(np.eye(4), scan.extent_m)
    found = geometry.search(room, scan, starts)
    assert_is_at(found, true, 0.03, 0.01)
    assert found.score > 0.5
    # The order of the first guesses decides nothing.
    np.testing.assert_allclose(geometry.search(room, scan, starts[::-1]).T_map_scan, found.T_map_scan, atol=0.02)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_sparse_scan_of_a_robot_that_tilts_finds_its_pose(geometry, axis) -> None:
    # A lidar of few beams on a vehicle that balances: 1,200 points, 12 degrees from one scan to the next.
    rng = np.random.default_rng(1)
    true = motion(1.0, 0.1, 3.0)
    true[:3, :3] = true[:3, :3] @ Rotation.from_euler(axis, 12.0, degrees=True).as_matrix()
    local_map = map_of_one(geometry.thin(planes(rng, num=1500)))
    sparse = geometry.thin(seen_from(planes(rng, num=300), true))
    found = geometry.search(local_map, sparse, geometry.other_motions(motion(1.0, 0.0, 0.0), sparse.extent_m))
    assert_is_at(found, true, 0.1, 0.02)


def beams_in_corridor(x: float, end_m: float) -> np.ndarray:
    """A lidar of 64 beams in a bare corridor of 3 m, which sees the end wall within 60 m."""
    elevation, azimuth = np.meshgrid(
        np.deg2rad(np.linspace(-15, 15, 64)), np.linspace(-np.pi, np.pi, 900), indexing="ij"
    )
    rays = np.column_stack(
        [part.ravel() for part in (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth))]
        + [np.sin(elevation).ravel()]
    )
    least, most = np.array([-500 - x, -1.5, -1.0]), np.array([end_m - x, 1.5, 1.8])
    with np.errstate(divide="ignore"):
        ranges = np.where(rays > 0, most / rays, np.where(rays < 0, least / rays, np.inf)).min(axis=1)
    ranges += np.random.default_rng(round(100 * x)).normal(0, 0.02, len(ranges))
    return (rays * ranges[:, None])[ranges < 60]


def test_slices_of_a_corridor_do_not_hold_a_scan_back(geometry) -> None:
    # Beams meet far walls in slices across the corridor, which move with the lidar. The end wall does not.
    first, second = (geometry.thin(beams_in_corridor(x, 40.0)) for x in (0.0, 0.5))
    assert abs(second.weak_axis[0]) > 0.999
    found = geometry.align(map_of_one(first), second, np.eye(4))
    assert_is_at(found, motion(0.5, 0, 0), 0.05, 0.005)
    assert sigma_along(found.information, second.weak_axis) < 0.1


def test_without_an_end_in_sight_the_way_along_a_corridor_is_unknown(geometry) -> None:
    first, second = (geometry.thin(beams_in_corridor(x, 500.0)) for x in (0.0, 0.5))
    found = geometry.align(map_of_one(first), second, np.eye(4))
    assert sigma_along(found.information, second.weak_axis) > 1
    assert sigma_along(found.information, np.array([0.0, 1.0, 0.0])) < 0.1
    assert geometry.thin(planes(np.random.default_rng(0))).weak_axis is None


@pytest.mark.parametrize("relief_m", [0.03, 0.12, 0.2])
def test_a_relief_of_centimetres_holds_the_way_along_a_wall(geometry, relief_m: float) -> None:
    first, second = (geometry.thin(scan_gallery(x, relief_m)) for x in (0.0, 0.15))
    found = geometry.align(map_of_one(first)._replace(surface=first.surface), second, np.eye(4))
    assert_is_at(found, motion(0.15, 0, 0), 0.05, 0.005)
    assert sigma_along(found.information, second.weak_axis) < 0.2


def test_a_bare_wall_holds_no_way_along_it(geometry) -> None:
    first, second = (geometry.thin(scan_gallery(x, 0.0)) for x in (0.0, 0.15))
    for start in (np.eye(4), motion(0.15, 0, 0)):
        found = geometry.align(map_of_one(first)._replace(surface=first.surface), second, start)
        assert sigma_along(found.information, second.weak_axis) > 1


def test_a_scan_of_another_place_scores_low(geometry, room) -> None:
    elsewhere = geometry.thin(np.random.default_rng(0).uniform(-8, 8, (4000, 3)))
    assert geometry.align(room, elsewhere, np.eye(4)).score < 0.3
    starts = geometry.other_motions(np.eye(4), elsewhere.extent_m)
    assert geometry.search(room, elsewhere, starts).score < 0.3


def test_ground_does_not_outvote_walls(geometry) -> None:
    # Nine tenths of the scan are ground, and the map holds nothing else.
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-1, 1, (2, 9000))
    ground = np.column_stack([20 * a, 20 * b, np.full(9000, -1.5)])
    walls = np.column_stack([np.full(500, 8.0), 4 * b[:500], 1 + 2 * a[:500]])
    sides = np.column_stack([8 * a[:500], np.full(500, 5.0), 1 + 2 * b[:500]])
    local_map = map_of_one(geometry.thin(ground))
    alone = geometry.align(local_map, geometry.thin(ground), np.eye(4))
    scan = geometry.thin(np.concatenate([ground, walls, sides]))
    surface = scan.surface
    ground_share = np.mean(np.abs(surface.normals[surface.samples, 2]) > 0.9)
    assert alone.matched_share > 0.95
    assert geometry.align(local_map, scan, np.eye(4)).matched_share < ground_share - 0.1


def test_an_element_of_the_map_in_free_space_lowers_the_score(geometry, room) -> None:
    points = planes(np.random.default_rng(1))
    half = geometry.thin(points[points[:, 0] > 0])
    # Beams that end behind the pillar of the map, through it.
    is_pillar = np.isclose(points[:, 0], 5.0, atol=1e-6)
    through = geometry.thin(points[(points[:, 0] > 0) & ~is_pillar])
    seen, missed = (geometry.align(room, scan, np.eye(4)) for scan in (half, through))
    assert seen.contradicted_share < 0.002
    assert missed.contradicted_share > 0.008
    for found in (seen, missed):
        assert found.score == found.matched_share - CONTRADICTION_WEIGHT * found.contradicted_share


def test_empty_scans_are_none(geometry) -> None:
    assert geometry.thin(np.zeros((0, 3))) is None
    for points in (np.zeros((5000, 3)), np.full((5000, 3), 1e6)):
        with pytest.warns(UserWarning, match="is it in metres"):
            assert geometry.thin(points) is None
    assert geometry.thin(planes(np.random.default_rng(0), num=20)) is None


def test_a_thinned_scan_is_of_points_of_the_scan(geometry) -> None:
    points = planes(np.random.default_rng(0))
    scan = geometry.thin(points)
    surface = scan.surface
    assert cKDTree(points).query(surface.points)[0].max() < 1e-4
    assert 0.95 * MAX_ELEMENTS < len(surface.points) <= MAX_ELEMENTS
    # The elements stand for all of the scan: no point is far from them.
    assert cKDTree(surface.points).query(points)[0].max() < 2 * SPREAD_M
    np.testing.assert_allclose(scan.extent_m, np.median(np.linalg.norm(points, axis=1)), rtol=0.2)
    # A scan that is far from empty is one whatever its number of points.
    assert geometry.thin(planes(np.random.default_rng(0), num=100)) is not None
