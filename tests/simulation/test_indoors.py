"""Buildings and walks through them: what a person could walk through, and what a lidar sees there."""

import jax
import numpy as np
import pytest

from dpmjax.simulation import BuildingConfig, LidarSensor, WalkConfig, make_building, scan_town, walk

SENSOR = LidarSensor("test", tuple(np.linspace(20.0, -20.0, 16)), 360, min_range_m=0.2, drop_rate=0.0, mixed_rate=0.0)
KINDS = ("office", "hall", "flat", "corridor", "tunnel", "garage", "stairs")


@pytest.fixture(scope="module", params=KINDS)
def building(request):
    return make_building(2, BuildingConfig(request.param, 60.0))


def inside_of_rooms(plan, points, margin=0.0):
    """Returns True for each point in a room or in a doorway, the slow way."""
    found = np.zeros(len(points), bool)
    for room in plan.rooms:
        found |= ((points[:, :2] > np.array(room.low) + margin) & (points[:, :2] < np.array(room.high) - margin)).all(1)
    for door in plan.doors:
        found |= np.linalg.norm(points[:, :2] - door.place, axis=1) < 0.5 * door.width
    return found


def test_a_seed_makes_one_building():
    first, again, other = (make_building(seed, BuildingConfig("flat", 30.0)) for seed in (1, 1, 2))
    jax.tree.map(np.testing.assert_array_equal, first.primitives, again.primitives)
    np.testing.assert_array_equal(first.route, again.route)
    assert not np.array_equal(first.primitives.boxes.centres, other.primitives.boxes.centres)


def test_every_room_is_reached(building):
    plan, seen = building.plan, {0}
    for _ in plan.rooms:
        seen |= {room for door in plan.doors if seen & set(door.rooms) for room in door.rooms}
    assert seen == set(range(len(plan.rooms)))


def test_the_walk_goes_through_doors_and_not_through_walls(building):
    assert inside_of_rooms(building.plan, building.route, margin=0.15).mean() > 0.999


def test_nothing_stands_on_the_walk(building):
    for bodies in building.primitives[:3]:
        mask = np.asarray(bodies.mask)
        centres, half, turn = (np.asarray(x, np.float64)[mask] for x in bodies[:3])
        floor = building.plan.floor_at(centres[:, 0])
        low = (centres[:, 2] - half[:, 2] < floor + 1.9) & (centres[:, 2] + half[:, 2] > floor + 0.35)
        offset = building.route[::5, None] - centres[None, low, :2]
        along = np.abs(offset[..., 0] * turn[low, 0] + offset[..., 1] * turn[low, 1]) - half[low, 0]
        across = np.abs(offset[..., 1] * turn[low, 0] - offset[..., 0] * turn[low, 1]) - half[low, 1]
        assert not low.any() or np.maximum(along, across).min() > 0.1


def test_a_lidar_sees_the_rooms_and_nothing_outside_of_the_walls(building):
    way = walk(building)
    number = len(way.times) // 2
    pose = way.T_world_lidar[number]
    cloud = scan_town(building.primitives, pose, 0.0, key=jax.random.key(0), sensor=SENSOR)
    points = np.asarray(cloud.points)[np.asarray(cloud.mask)]
    world = points @ pose[:3, :3].T + pose[:3, 3]
    assert len(points) > 0.9 * SENSOR.num_rays
    assert world[:, 2].min() > -0.15
    assert world[:, 2].max() < max(room.height for room in building.plan.rooms) + 0.15
    assert inside_of_rooms(building.plan, world, margin=-0.15).mean() > 0.995


def test_stairs_are_climbed_with_the_lidar_above_their_steps() -> None:
    building = make_building(2, BuildingConfig("stairs", 60.0))
    poses = walk(building, WalkConfig(tilt_deg=0.0, is_robot=True)).T_world_lidar
    assert np.ptp(poses[:, 2, 3]) > 1.0
    cloud = scan_town(building.primitives, poses[5], 0.0, key=jax.random.key(0), sensor=SENSOR)
    points = np.asarray(cloud.points)[np.asarray(cloud.mask)] @ poses[5, :3, :3].T + poses[5, :3, 3]
    above = points[:, 2] - building.plan.floor_at(points[:, 0])
    assert (above > -0.15).all()
    assert (above < 0.25).mean() > 0.03


def test_a_carried_lidar_tilts_and_a_robot_does_not(building):
    person, robot = walk(building), walk(building, WalkConfig(tilt_deg=0.5, is_robot=True))
    np.testing.assert_allclose(np.linalg.det(person.T_world_lidar[:, :3, :3]), 1.0, atol=1e-9)
    assert np.degrees(np.arccos(person.T_world_lidar[:, 2, 2])).max() > 5
    assert np.degrees(np.arccos(robot.T_world_lidar[:, 2, 2])).max() < 3
    positions = robot.T_world_lidar[:, :3, 3]
    np.testing.assert_allclose(positions[:, 2] - building.plan.floor_at(positions[:, 0]), 1.3)
    assert np.linalg.norm(np.diff(person.T_world_lidar[:, :2, 3], axis=0), axis=1).max() < 0.55
