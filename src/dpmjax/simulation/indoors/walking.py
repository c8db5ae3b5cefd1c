"""Walks through a building: poses of a lidar that a person carries or a robot drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.checks import require_positive_fields
from dpmjax.sequences import FloatArray
from dpmjax.simulation.indoors.building import Building
from dpmjax.simulation.town.driving import TimedPoses
from dpmjax.simulation.town.streets import arc_lengths, at_way, smooth, tangents

_WALK_STREAM = 8161
_LOOK_AHEAD_M = 0.8
_STEPS_PER_S = 1.8
_SINK = 2.5  # Ratio of slow changes of the height to those of a step.
_SPEED_M_S = 1.0
# For a person and for a robot: standard deviation of the angle between the sensor's x and the direction of motion,
# degrees, and vertical amplitude of a step, m.
_PERSON, _ROBOT = (25.0, 0.03), (3.0, 0.0)


@dataclass(frozen=True)
class WalkConfig:
    """Motion of the lidar.

    Attributes:
        rate_hz: scans per second.
        height_m: above the floor.
        tilt_deg: standard deviation of roll and pitch, which change over seconds; about 1 for a robot.
        is_robot: True for a robot, which looks ahead and takes no steps; False for a person.

    Raises:
        ValueError: rate or height not positive.
    """

    rate_hz: float = 2.0
    height_m: float = 1.3
    tilt_deg: float = 6.0
    is_robot: bool = False

    def __post_init__(self) -> None:
        require_positive_fields(self, "rate_hz", "height_m")


def walk(building: Building, config: WalkConfig = WalkConfig(), *, seed: int = 0) -> TimedPoses:
    """Simulates a walk along the building's route.

    Args:
        building: the building.
        config: settings of the motion.
        seed: seed of the sway.

    Returns:
        Poses and times; z is up, and the floor begins at z = 0.
    """
    rng = np.random.default_rng([_WALK_STREAM, seed])
    route, (look_deg, bob_m) = building.route, _ROBOT if config.is_robot else _PERSON
    times = np.arange(0.0, arc_lengths(route)[-1] / _SPEED_M_S, 1.0 / config.rate_hz)
    way = times * _SPEED_M_S
    # People turn before they walk round a corner, and not at once.
    along = smooth(tangents(route), _LOOK_AHEAD_M / 0.1, is_closed=False)
    facing = at_way(np.column_stack([route, along]), way + _LOOK_AHEAD_M)[:, 2:]
    yaw = np.arctan2(facing[:, 1], facing[:, 0]) + np.radians(look_deg) * _slow(rng, times)
    tilt = np.radians(config.tilt_deg) * np.column_stack([_slow(rng, times), _slow(rng, times)])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    poses[:, :2, 3] = at_way(route, way)
    steps = np.sin(2 * np.pi * _STEPS_PER_S * times) + _SINK * _slow(rng, times)
    poses[:, 2, 3] = building.plan.floor_at(poses[:, 0, 3]) + config.height_m + bob_m * steps
    return TimedPoses(poses, times)


def _slow(rng: np.random.Generator, times: FloatArray) -> FloatArray:
    """Draws noise of unit variance that changes over seconds."""
    phases, periods = rng.uniform(0, 2 * np.pi, 4), rng.uniform(2.0, 11.0, 4)
    return np.sqrt(0.5) * np.sin(2 * np.pi * times[:, None] / periods + phases).sum(1)
