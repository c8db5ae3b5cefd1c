"""The built-in world of the demo: worlds, a walk and an ideal lidar put together into one sequence of scans."""

from __future__ import annotations

import zlib

import numpy as np

from dpmjax.io.scans2d.sequence import ScanSequence
from dpmjax.simulation.world2d.raycast import scan_world
from dpmjax.simulation.world2d.trajectory import TrajectoryConfig, simulate_odometry, simulate_trajectory
from dpmjax.simulation.world2d.world import World, make_world


def simulate_sequence(
    world: int | World = 0,
    num_scans: int = 256,
    *,
    num_beams: int = 256,
    max_range: float | None = None,
    range_noise_px: float = 0.0,
    seed: int = 0,
    trajectory: TrajectoryConfig | None = None,
    with_odometry: bool = False,
) -> ScanSequence:
    """Simulates a drive through a planar world (DeepMapping section 4.1).

    Walk, noise and odometry have random streams of their own: a seed gives one walk, with and without noise.

    Args:
        world: index for `make_world`, or a world.
        num_scans: number of scans; the paper has 128 and 256.
        num_beams: beams per scan over 360 degrees.
        max_range: beams longer than this (px) are masked; None for the paper's unlimited sensor.
        range_noise_px: standard deviation of Gaussian noise on the ranges, px.
        seed: seed of walk and noise.
        trajectory: step statistics; the paper's where None.
        with_odometry: whether to simulate wheel odometry too.

    Returns:
        The sequence in px, organised, with the true poses in the world's frame as reference.

    Raises:
        ValueError: an argument out of its range, or a world too narrow to move in.
    """
    if num_scans < 2:
        raise ValueError(f"num_scans must be at least 2, got {num_scans}")
    place = world if isinstance(world, World) else make_world(world)
    # The name takes part, so that walks through two worlds are two walks and not one bent by other walls.
    streams = ([seed, zlib.crc32(place.name.encode()), stream] for stream in range(3))
    walk_rng, noise_rng, odometry_rng = map(np.random.default_rng, streams)
    poses = simulate_trajectory(place, num_scans, rng=walk_rng, config=trajectory)
    points, mask = scan_world(
        place.is_obstacle, poses, num_beams=num_beams, max_range=max_range, range_noise_px=range_noise_px, rng=noise_rng
    )
    return ScanSequence(
        name=place.name,
        points=points,
        mask=mask,
        unit="px",
        reference_poses=poses,
        odometry_poses=simulate_odometry(poses, rng=odometry_rng) if with_odometry else None,
    )
