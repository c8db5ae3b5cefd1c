"""Motion of the lidar: drives along the route of a town, walks through a building."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.checks import require_positive_fields
from dpmjax.sequences import FloatArray, homogeneous
from dpmjax.simulation.building import Building
from dpmjax.simulation.town.make import Town
from dpmjax.simulation.town.streets import arc_lengths, at_way, lane_of, on_path, smooth, tangents

_WHEELBASE_M = 2.7
_TRACK_M = 1.6
_TURN_S = 0.1
_LOOK_AHEAD_M = 0.8
_SPEED_M_S = 1.0


@dataclass(frozen=True)
class DriveConfig:
    """Settings of the drive.

    Attributes:
        speed_m_s: speed on straight streets; in corners it is at least a third of that.
        rate_hz: scans per second.
        length_m: length of the drive; None for once round (a closed route) or to the end.
        is_reversed: True to drive the route from its end to its start, in the opposite lane.
        sensor_height_m: height above the ground.
        max_turn_deg_s: the car slows down in corners until it turns no faster; cars turn at 20 to 40 degrees a second.

    Raises:
        ValueError: speed, rate, length or turn not positive.
    """

    speed_m_s: float = 8.0
    rate_hz: float = 10.0
    length_m: float | None = None
    is_reversed: bool = False
    sensor_height_m: float = 1.73
    max_turn_deg_s: float = np.inf

    def __post_init__(self) -> None:
        lengths = () if self.length_m is None else ("length_m",)
        require_positive_fields(self, "speed_m_s", "rate_hz", "max_turn_deg_s", *lengths)


class TimedPoses(NamedTuple):
    """Poses and times of a drive.

    Attributes:
        T_world_lidar: (n, 4, 4) float64, x forward, y left, z up, m.
        times: (n,) s, from 0.
    """

    T_world_lidar: FloatArray
    times: FloatArray


def turn_motions(way: TimedPoses) -> FloatArray:
    """Computes the motion of the lidar during each of its turns, at the velocity to the next pose.

    Args:
        way: poses and times.

    Returns:
        (n, 6) twists (m, radians) in the lidar's own frame; the last one is repeated.
    """
    poses = way.T_world_lidar
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    part = _TURN_S / np.maximum(np.diff(way.times), _TURN_S)[:, None]
    back = poses[:-1, :3, :3].transpose(0, 2, 1)
    moved = np.einsum("nij,nj->ni", back, np.diff(poses[:, :3, 3], axis=0))
    turned = Rotation.from_matrix(back @ poses[1:, :3, :3]).as_rotvec()
    twists = np.hstack([moved, turned]) * part
    return np.vstack([twists, twists[-1:]])


def drive(town: Town, config: DriveConfig = DriveConfig(), *, seed: int = 0) -> TimedPoses:
    """Simulates a drive along the town's route.

    Args:
        town: the town.
        config: settings of the drive.
        seed: seed of sway and shake.

    Returns:
        The drive. A drive once round a closed route ends one step before the place where it began.
    """
    rng = np.random.default_rng([8151, seed])
    lane = lane_of(town.streets, is_reversed=config.is_reversed)
    whole = arc_lengths(lane)[-1]
    is_closed = town.streets.is_closed
    length = config.length_m or whole
    way, times = _timetable(lane, length if is_closed else min(length, whole), config, is_closed)
    way = way % whole if is_closed else way
    along = _directions(lane, way)
    left = np.column_stack([-along[:, 1], along[:, 0]])
    # Of unit variance, and changing over tens of metres.
    phases, waves = rng.uniform(0, 2 * np.pi, 3), 2 * np.pi / np.array([31.0, 53.0, 97.0])
    sway = np.sqrt(2 / 3) * np.sin(way[:, None] * waves + phases).sum(1)
    # The car keeps to the middle of its lane within 0.15 m.
    places = at_way(lane, way) + (0.15 * sway)[:, None] * left
    return TimedPoses(_poses(town, places, along, left, config, rng), times)


def _timetable(lane: FloatArray, length: float, config: DriveConfig, is_closed: bool) -> tuple[FloatArray, FloatArray]:
    """Computes the path lengths along the lane and the times of the scans."""
    way = np.arange(0.0, length, 0.5)
    whole = arc_lengths(lane)[-1]
    at = way % whole if is_closed else way
    before, after = _directions(lane, at), _directions(lane, (at + 5.0) % whole if is_closed else at + 5.0)
    speed = config.speed_m_s * np.clip(1.0 - 0.9 * _angles(before, after), 1 / 3, 1.0)
    seconds = np.diff(way) / (0.5 * (speed[1:] + speed[:-1]))
    turning = _angles(before[:-1], before[1:]) / np.radians(config.max_turn_deg_s)
    clock = np.concatenate([[0.0], np.cumsum(np.maximum(seconds, turning))])
    times = np.arange(0.0, clock[-1] + 1e-9, 1.0 / config.rate_hz)
    return np.interp(times, clock, way), times


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.arccos(np.clip((a * b).sum(1), -1.0, 1.0))


def _directions(lane: FloatArray, way: FloatArray) -> FloatArray:
    found = on_path(lane, way)[:, 2:]
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)


def _poses(
    town: Town, places: FloatArray, along: FloatArray, left: FloatArray, config: DriveConfig, rng: np.random.Generator
) -> FloatArray:
    """Computes sensor poses with pitch and roll from the ground under the axles, and small vibrations."""
    height = town.terrain.height_at
    # Fast roll and pitch.
    shake = np.radians(0.25) * rng.normal(size=(2, len(places)))
    half = 0.5 * _WHEELBASE_M
    climb = (height(places + half * along) - height(places - half * along)) / _WHEELBASE_M + shake[0]
    bank = (height(places + 0.5 * _TRACK_M * left) - height(places - 0.5 * _TRACK_M * left)) / _TRACK_M + shake[1]
    forward = np.column_stack([along, climb])
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    sideways = np.column_stack([left, bank])
    up = np.cross(forward, sideways)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    turns = np.stack([forward, np.cross(up, forward), up], axis=-1)
    return homogeneous(turns, np.column_stack([places, height(places) + config.sensor_height_m]))


@dataclass(frozen=True)
class WalkConfig:
    """Motion of the lidar.

    Attributes:
        rate_hz: scans per second.
        height_m: height above the floor.
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
    rng = np.random.default_rng([8161, seed])
    # A robot looks ahead and rolls; a person looks around and bobs by the amplitude of a step.
    route, (look_deg, bob_m) = building.route, (3.0, 0.0) if config.is_robot else (25.0, 0.03)
    times = np.arange(0.0, arc_lengths(route)[-1] / _SPEED_M_S, 1.0 / config.rate_hz)
    way = times * _SPEED_M_S
    # People begin to turn before they reach a corner.
    along = smooth(tangents(route), _LOOK_AHEAD_M / 0.1, is_closed=False)
    facing = at_way(np.column_stack([route, along]), way + _LOOK_AHEAD_M)[:, 2:]
    yaw = np.arctan2(facing[:, 1], facing[:, 0]) + np.radians(look_deg) * _slow_sway(rng, times)
    tilt = np.radians(config.tilt_deg) * np.column_stack([_slow_sway(rng, times), _slow_sway(rng, times)])
    turns = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    # A person takes 1.8 steps a second, and sinks and rises slowly by 2.5 times as much.
    places, steps = at_way(route, way), np.sin(2 * np.pi * 1.8 * times) + 2.5 * _slow_sway(rng, times)
    heights = building.plan.floor_at(places[:, 0]) + config.height_m + bob_m * steps
    return TimedPoses(homogeneous(turns, np.column_stack([places, heights])), times)


def _slow_sway(rng: np.random.Generator, times: FloatArray) -> FloatArray:
    """Draws noise of unit variance that changes over seconds."""
    phases, periods = rng.uniform(0, 2 * np.pi, 4), rng.uniform(2.0, 11.0, 4)
    return np.sqrt(0.5) * np.sin(2 * np.pi * times[:, None] / periods + phases).sum(1)
