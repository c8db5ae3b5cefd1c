"""A walk through a planar world with an ideal lidar, as one sequence of scans."""

from __future__ import annotations

import zlib

import numpy as np

from dpmjax.sequences import ScanSequence, World
from dpmjax.simulation.world2d.raycast import scan_world
from dpmjax.simulation.world2d.trajectory import simulate_odometry, simulate_trajectory
from dpmjax.simulation.world2d.world import make_world


def simulate_sequence(
    world: int | World = 0,
    num_scans: int = 256,
    *,
    num_beams: int = 256,
    range_noise_px: float = 0.0,
    seed: int = 0,
    with_odometry: bool = False,
) -> ScanSequence:
    """Simulates a drive through a planar world (DeepMapping section 4.1).

    Walk, noise and odometry have separate random streams: a seed gives the same walk with and without noise.

    Args:
        world: index for `make_world`, or a world.
        num_scans: number of scans; the paper has 128 and 256.
        num_beams: beams per scan over 360 degrees.
        range_noise_px: standard deviation of Gaussian noise on the ranges, px.
        seed: seed of walk and noise.
        with_odometry: whether to simulate wheel odometry too.

    Returns:
        The sequence in px, organised, with the true poses in the world's frame as reference.

    Raises:
        ValueError: an argument out of its range, or a world too narrow to move in.
    """
    if num_scans < 2:
        raise ValueError(f"num_scans must be at least 2, got {num_scans}")
    scene = world if isinstance(world, World) else make_world(world)
    # The name takes part, so that walks through two worlds are two walks and not one bent by other walls.
    streams = ([seed, zlib.crc32(scene.name.encode()), stream] for stream in range(3))
    walk_rng, noise_rng, odometry_rng = map(np.random.default_rng, streams)
    poses = simulate_trajectory(scene, num_scans, rng=walk_rng)
    points, mask = scan_world(
        scene.is_obstacle, poses, num_beams=num_beams, range_noise_px=range_noise_px, rng=noise_rng
    )
    return ScanSequence(
        name=scene.name,
        points=points,
        mask=mask,
        unit="px",
        reference_poses=poses,
        odometry_poses=simulate_odometry(poses, rng=odometry_rng) if with_odometry else None,
    )
