"""Walks through a building: poses of a lidar that a person carries or a robot drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.sequences import FloatArray
from dpmjax.simulation.indoors.building import Building
from dpmjax.simulation.town.driving import Drive
from dpmjax.simulation.town.streets import arc_lengths, at_way, smooth, tangents

_WALK_STREAM = 8161
_LOOK_AHEAD_M = 0.8
_STEPS_PER_S = 1.8
_SINK = 2.5  # Slow changes of the height, over those of a step.


@dataclass(frozen=True)
class WalkConfig:
    """Motion of the lidar.

    Attributes:
        speed_m_s: of the walk.
        rate_hz: scans per second.
        height_m: above the floor.
        tilt_deg: standard deviation of roll and pitch, which change over seconds; about 1 for a robot.
        look_deg: standard deviation of the angle between the sensor's x and the way.
        bob_m: rise and fall of a step.

    Raises:
        ValueError: speed, rate or height not positive.
    """

    speed_m_s: float = 1.0
    rate_hz: float = 2.0
    height_m: float = 1.3
    tilt_deg: float = 6.0
    look_deg: float = 25.0
    bob_m: float = 0.03

    def __post_init__(self) -> None:
        if not min(self.speed_m_s, self.rate_hz, self.height_m) > 0:
            raise ValueError("speed_m_s, rate_hz and height_m must be positive")


def walk(building: Building, config: WalkConfig = WalkConfig(), *, seed: int = 0) -> Drive:
    """Walks along the building's route.

    Args:
        building: the building.
        config: how.
        seed: seed of the sway.

    Returns:
        Poses and times; z is up, and the floor begins at z = 0.
    """
    rng = np.random.default_rng([_WALK_STREAM, seed])
    route = building.route
    times = np.arange(0.0, arc_lengths(route)[-1] / config.speed_m_s, 1.0 / config.rate_hz)
    way = times * config.speed_m_s
    # People turn before they walk round a corner, and not at once.
    along = smooth(tangents(route), _LOOK_AHEAD_M / 0.1, is_closed=False)
    facing = at_way(np.column_stack([route, along]), way + _LOOK_AHEAD_M)[:, 2:]
    yaw = np.arctan2(facing[:, 1], facing[:, 0]) + np.radians(config.look_deg) * _slow(rng, times)
    tilt = np.radians(config.tilt_deg) * np.column_stack([_slow(rng, times), _slow(rng, times)])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    poses[:, :2, 3] = at_way(route, way)
    steps = np.sin(2 * np.pi * _STEPS_PER_S * times) + _SINK * _slow(rng, times)
    poses[:, 2, 3] = building.plan.floor_at(poses[:, 0, 3]) + config.height_m + config.bob_m * steps
    return Drive(poses, times)


def _slow(rng: np.random.Generator, times: FloatArray) -> FloatArray:
    """Unit noise that changes over seconds."""
    phases, periods = rng.uniform(0, 2 * np.pi, 4), rng.uniform(2.0, 11.0, 4)
    return np.sqrt(0.5) * np.sin(2 * np.pi * times[:, None] / periods + phases).sum(1)
