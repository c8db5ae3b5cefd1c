"""A seed gives the same scans in every version: sums that were taken before the simulators were rewritten."""

import jax
import numpy as np
import pytest

from dpmjax.simulation import (
    DriveConfig,
    LidarSensor,
    TownConfig,
    drive,
    make_town,
    scan_town,
    simulate_depth_sequence,
    simulate_sequence,
)


def describe(points, mask):
    """Number of points, and sums that see each coordinate and the order."""
    kept = np.asarray(points, np.float64)[np.asarray(mask)]
    return [len(kept), *kept.sum(axis=0), float(kept[:, 0] @ np.arange(len(kept))) / len(kept)]


def planar():
    sequence = simulate_sequence(1, 8, num_beams=64, seed=3, range_noise_px=2.0, with_odometry=True)
    turned = np.column_stack([sequence.odometry_poses[:, :2], np.cos(sequence.odometry_poses[:, 2])])
    return [*describe(sequence.points, sequence.mask), *sequence.reference_poses.sum(axis=0), *turned.sum(axis=0)]


def depth():
    sequence = simulate_depth_sequence(2, 4, seed=1)
    return describe(sequence.points, sequence.mask)


def town():
    world = make_town(3, TownConfig(route_length_m=500))
    way = drive(world, DriveConfig(length_m=30.0), seed=2)
    sensor = LidarSensor("test", tuple(np.linspace(2.0, -24.0, 16)), 360, max_range_m=80.0)
    cloud = scan_town(world.primitives, way.T_world_lidar[3], way.times[3], key=jax.random.key(1), sensor=sensor)
    return [*describe(cloud.points, cloud.mask), *way.T_world_lidar.sum(axis=(0, 2))]


RECORDED = {
    "planar": [512.0, -17931.4, -20819.5, -10256.9, 4660.02, 1846.41, -15.2517, -8.90955, -183.132, 7.897],
    "depth": [5184.0, -946.87181, -96.95442, 6441.1694, -484.38683],
    "town": [5226.0, -118.07316, 4018.3106, -7176.6581, -463.44525, 123.09674, 586.82816, 4.6754149, 42.0],
}


@pytest.mark.parametrize("simulate", [planar, depth, town])
def test_a_seed_gives_the_recorded_scans(simulate):
    np.testing.assert_allclose(simulate(), RECORDED[simulate.__name__], rtol=2e-4)
