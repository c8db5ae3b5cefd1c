"""People who walk about in a planar world while it is scanned: discs that move from scan to scan."""

from __future__ import annotations

import numpy as np

from dpmjax.sequences import FloatArray, World
from dpmjax.simulation.trajectory2d import simulate_trajectory

_RADIUS_PX = 11.0
# People who would stand nearer to the sensor than this have stepped out of the way, and are not in that scan.
_LEAST_DISTANCE_PX = 2.0 * _RADIUS_PX


def simulate_people(world: World, num_scans: int, *, rng: np.random.Generator) -> FloatArray:
    """Lets the people of a world walk, at the pace of the robot and by its rules.

    Args:
        world: where to walk, and how many people do.
        num_scans: moments at which they are wanted.
        rng: source of all choices.

    Returns:
        (num_people, num_scans, 2) x, y in px in the frame of the world.
    """
    walks = [simulate_trajectory(world, num_scans, rng=stream)[:, :2] for stream in rng.spawn(world.num_people)]
    return np.array(walks, np.float64).reshape(world.num_people, num_scans, 2)


def stop_at_people(ranges: FloatArray, poses: FloatArray, angles: FloatArray, people: FloatArray) -> FloatArray:
    """Shortens the beams that meet a person before they meet the world.

    Args:
        ranges: (n, b) of the world without people, px.
        poses: (n, 3) x, y, heading of the sensor.
        angles: (b,) of the beams in the sensor frame, radians.
        people: (p, n, 2) centres of the people, px.

    Returns:
        (n, b) px.
    """
    heading = poses[:, 2:] + angles
    beams = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    for centres in people:
        to_person = centres - poses[:, :2]
        along = np.einsum("nbk,nk->nb", beams, to_person)
        distance = np.linalg.norm(to_person, axis=-1)[:, None]
        # Half of the chord that the beam cuts out of the disc, squared; negative where it passes by.
        half_chord = _RADIUS_PX**2 - (distance**2 - along**2)
        is_met = (half_chord > 0) & (along > 0) & (distance > _LEAST_DISTANCE_PX)
        ranges = np.where(is_met, np.minimum(ranges, along - np.sqrt(np.maximum(half_chord, 0.0))), ranges)
    return ranges
