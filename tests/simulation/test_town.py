"""Towns, drives through them and what a lidar sees there."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.io import open_lidar_sequence
from dpmjax.simulation import HDL64E, DriveConfig, LidarSensor, TownConfig, drive, make_town, scan_town
from dpmjax.simulation.town.terrain import with_equal_passes

SENSOR = LidarSensor("test", HDL64E.elevations_deg[::4], 360, max_range_m=80.0)
SHORT = TownConfig(route_length_m=500)


@pytest.fixture(scope="module")
def town():
    return make_town(3, SHORT)


@pytest.fixture(scope="module")
def way(town):
    return drive(town)


def scan(town, way, index, seed=0):
    pose, time = way.T_world_lidar[index], way.times[index]
    return scan_town(town.primitives, pose, time, key=jax.random.key(seed), sensor=SENSOR)


@pytest.mark.slow
def test_a_key_makes_one_scan(town, way, assert_compiles_nothing):
    first = scan(town, way, 10)
    with assert_compiles_nothing():
        again, other = scan(town, way, 10), scan(town, way, 30, seed=1)
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.mask, again.mask)
    assert not np.array_equal(first.points, other.points)


def test_points_lie_on_beams_within_range(town, way):
    cloud = scan(town, way, 40)
    points, mask = np.asarray(cloud.points), np.asarray(cloud.mask)
    assert points.shape == (SENSOR.num_rays, 3)
    assert 0.5 < mask.mean() < 1.0
    ranges = np.linalg.norm(points[mask], axis=1)
    assert ranges.min() >= SENSOR.min_range_m
    assert ranges.max() <= SENSOR.max_range_m + 1e-3
    assert not points[~mask].any()
    beams = np.repeat(np.radians(SENSOR.elevations_deg), SENSOR.num_azimuths)[mask]
    np.testing.assert_allclose(np.arcsin(points[mask, 2] / ranges), beams, atol=1e-4)


@cache
def route(kind):
    return drive(make_town(1, TownConfig(route=kind, route_length_m=1200, block_m=90))).T_world_lidar


@pytest.mark.parametrize(
    "kind", ["loop", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("there_and_back", "wander"))]
)
def test_routes_close_and_have_the_wanted_length(kind):
    poses = route(kind)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 1.5
    assert steps.max() < 1.0
    assert steps.sum() == pytest.approx(1200, rel=0.35)


def test_reverse_drives_the_other_lane(town, way):
    back = drive(town, DriveConfig(is_reversed=True)).T_world_lidar
    apart = np.linalg.norm(back[:, None, :2, 3] - way.T_world_lidar[None, :, :2, 3], axis=-1).min(1)
    assert np.median(apart) == pytest.approx(3.4, abs=0.6)


def test_poses_are_rigid_and_stand_on_the_ground(town, way):
    poses = way.T_world_lidar
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
    np.testing.assert_allclose(poses[:, 2, 3] - town.terrain.height_at(poses[:, :2, 3]), 1.73, atol=1e-9)
    assert (poses[:, 2, 2] > 0.98).all()
    assert (np.diff(way.times) > 0).all()


@pytest.mark.slow
def test_a_car_that_turns_slowly_takes_longer_on_the_same_way():
    town = make_town(3, TownConfig(route="there_and_back", route_length_m=300.0))
    fast, slow = (drive(town, DriveConfig(max_turn_deg_s=limit)) for limit in (np.inf, 30.0))

    def turns_deg(way):
        forward = way.T_world_lidar[:, :2, 0] / np.linalg.norm(way.T_world_lidar[:, :2, 0], axis=1, keepdims=True)
        return np.degrees(np.arccos(np.clip((forward[:-1] * forward[1:]).sum(1), -1.0, 1.0)))

    assert turns_deg(fast).max() > 6.0
    # Ten scans a second; directions are interpolated between places half a metre apart.
    assert turns_deg(slow).max() < 3.3
    assert slow.times[-1] > fast.times[-1]
    np.testing.assert_allclose(slow.T_world_lidar[-1, :2, 3], fast.T_world_lidar[-1, :2, 3], atol=1.0)


def test_a_second_scan_of_a_place_fits_the_first(town, way):
    """The world stands still: points of one scan, moved by the true poses, lie on those of the next."""
    from scipy.spatial import KDTree

    clouds = [scan(town, way, index, seed=index) for index in (60, 62)]
    points = [np.asarray(c.points)[np.asarray(c.mask)] for c in clouds]
    world = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(points, way.T_world_lidar[[60, 62]], strict=True)]
    near = np.linalg.norm(points[1], axis=1) < 12
    distance = KDTree(world[0]).query(world[1][near])[0]
    assert np.median(distance) < 0.2


def test_traffic_moves(town):
    from dpmjax.simulation.town.primitives import traffic_boxes

    here = jnp.array([1e4, 1e4, 0.0])
    look = jax.jit(traffic_boxes)
    start, later = (look(town.primitives.traffic, here, np.float32(time)) for time in (0.0, 0.5))
    mask = np.asarray(start.mask & later.mask)
    way = np.linalg.norm(np.asarray(later.centres - start.centres)[mask], axis=1)
    assert mask.sum() > 5
    assert np.median(way) > 0.3
    assert np.percentile(way, 80) < 7.0


def test_a_street_is_laid_along_a_real_drive(real_data):
    from dpmjax.io import read_poses

    text = (real_data / "poses" / "kitti_00_calib.txt").read_text()
    (numbers,) = (line.split()[1:] for line in text.splitlines() if line.startswith("Tr:"))
    T_cam0_lidar = np.vstack([np.array(numbers, float).reshape(3, 4), [0, 0, 0, 1]])
    real = np.linalg.inv(T_cam0_lidar) @ read_poses(real_data / "poses" / "kitti_07.txt") @ T_cam0_lidar
    town = make_town(0, trajectory=real)
    poses = drive(town).T_world_lidar
    apart = np.linalg.norm(poses[:, None, :3, 3] - real[None, :, :3, 3], axis=-1).min(1)
    assert np.percentile(apart, 95) < 1.2
    length = np.linalg.norm(np.diff(real[:, :3, 3], axis=0), axis=1).sum()
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(length, rel=0.05)


def describe(points):
    """Shares of the points by range, and of those near the ground: what a network sees first."""
    ranges = np.linalg.norm(points, axis=1)
    shares = np.histogram(ranges, [0, 5, 10, 20, 40, 80])[0] / len(ranges)
    return np.append(shares, (points[:, 2] < -1.35).mean())


def test_a_scan_of_the_town_has_the_statistics_of_a_real_one(town, way, real_data):
    """Within the scatter of real streets; kitti_00 and kitti_07 differ by 0.12 themselves."""
    drives = [open_lidar_sequence(real_data / "lidar_3d" / name) for name in ("kitti_00", "kitti_07")]
    real = [describe(drive.read_scan(0)) for drive in drives]
    made = []
    for index in range(0, len(way.times), 60):
        cloud = scan(town, way, index)
        made.append(describe(np.asarray(cloud.points)[np.asarray(cloud.mask)]))
    np.testing.assert_allclose(np.mean(made, axis=0), np.mean(real, axis=0), atol=0.12)


def test_passes_of_one_place_have_one_height_and_slopes_hardly_change():
    """Two laps whose heights drift by 4 m, and a jump where the car stands still."""
    angle = np.linspace(0, 4 * np.pi, 801)
    hills = 3.0 * np.sin(2 * angle)
    route = np.column_stack([80 * np.cos(angle), 80 * np.sin(angle), hills + 4.0 * angle / angle[-1]])
    found = with_equal_passes(route)
    way = np.linspace(0, 4 * np.pi, len(found))
    lap = len(found) // 2
    assert np.abs(found[lap:, 2] - np.interp(way[lap:] - 2 * np.pi, way, found[:, 2])).max() < 0.1
    climbs = np.diff(found[:, 2]) - np.diff(3.0 * np.sin(2 * way))
    assert np.abs(climbs).max() < 0.02
    jump = np.where(np.arange(801) >= 400, route[:, 2] + 7.0, route[:, 2])
    steep = with_equal_passes(np.column_stack([route[:, :2], jump]))
    assert np.abs(np.diff(steep[:, 2])).max() < 0.25


def test_a_route_that_passes_no_place_twice_keeps_its_heights():
    route = np.column_stack([np.arange(50.0), np.zeros(50), np.linspace(5, 7, 50)])
    np.testing.assert_allclose(with_equal_passes(route), route, atol=1e-9)
