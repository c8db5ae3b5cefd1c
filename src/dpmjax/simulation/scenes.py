"""Scenes for training: a kind of place, a lidar and a route, drawn by seed from a mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import require_one_of, require_positive_fields, require_value, runs_on_host
from dpmjax.sequences import SimulatedDrive
from dpmjax.simulation.building import KINDS as INDOOR_KINDS
from dpmjax.simulation.building import Building, BuildingConfig, make_building
from dpmjax.simulation.motion import DriveConfig, WalkConfig, drive, turn_motions, walk
from dpmjax.simulation.town import scan
from dpmjax.simulation.town.kinds import KINDS as OUTDOOR_KINDS
from dpmjax.simulation.town.make import Town, TownConfig, make_town
from dpmjax.simulation.town.scan import HDL32E, HDL64E, OS1_64, OS1_128, PANDAR64, SOLID_STATE, VLP16, LidarSensor

_Entry = TypeVar("_Entry")
_ROUTES = ("loop", "there_and_back", "wander")


@dataclass(frozen=True)
class SceneMixture:
    """Distribution from which scenes are drawn.

    Attributes:
        kinds: kinds of place, outdoors and indoors, with their weights.
        sensors: lidars, with their weights.
        length_m: length of the route outdoors; indoors a quarter of it.
        spacing_m: mean distance between scans outdoors; indoors a quarter of it.
        indoor_scale: lowest and highest scale of an indoor scene and its poses, drawn log-uniformly, because networks
            for ranges of tens of metres resolve more of an enlarged scene.
        moving_rate: share of the drives whose lidar moves during its turn.
        other_lidar_rate: share of the drives in which every other scan is of a second lidar.

    Raises:
        ValueError: an unknown kind, weights that are negative or all zero, or lengths or scales that are not positive.
    """

    kinds: tuple[tuple[str, float], ...] = (
        ("suburb", 0.3), ("canyon", 0.14), ("country", 0.12), ("car_park", 0.08), ("campus", 0.12), ("wood", 0.08),
        ("office", 0.05), ("hall", 0.08), ("flat", 0.03),
    )  # fmt: skip
    sensors: tuple[tuple[LidarSensor, float], ...] = (
        (HDL64E, 0.4), (OS1_64, 0.16), (OS1_128, 0.08), (PANDAR64, 0.1), (HDL32E, 0.16), (VLP16, 0.1),
    )  # fmt: skip
    length_m: float = 600.0
    spacing_m: float = 2.0
    indoor_scale: tuple[float, float] = (1.0, 4.0)
    moving_rate: float = 0.4
    other_lidar_rate: float = 0.0

    def __post_init__(self) -> None:
        for name, entries in (("kinds", self.kinds), ("sensors", self.sensors)):
            weights = [weight for _, weight in entries]
            is_right = weights and min(weights) >= 0 and sum(weights) > 0
            require_value(is_right, name, "weights from 0 up, not all 0", weights)
        for kind, _ in self.kinds:
            require_one_of("kinds", kind, (*OUTDOOR_KINDS, *INDOOR_KINDS))
        require_positive_fields(self, "length_m", "spacing_m")
        low, high = self.indoor_scale
        require_value(0 < low <= high, "indoor_scale", "two positive, ascending numbers", f"{low}, {high}")


@dataclass(frozen=True)
class Scene:
    """A place, a lidar, and the motion of the lidar.

    Attributes:
        seed: seed of all random choices.
        place: configuration of the town or the building.
        motion: settings of the motion, `DriveConfig` in a town, `WalkConfig` in a building.
        sensor: the lidar.
        scale: factor of points and poses.
        is_moving: True where the lidar moves during its turn, and the scans are not corrected for it.
        other_sensor: lidar of every other scan; None: all scans are of one lidar.

    Raises:
        ValueError: a motion that does not belong to the place.
    """

    seed: int
    place: TownConfig | BuildingConfig
    motion: DriveConfig | WalkConfig = field(repr=False)
    sensor: LidarSensor = field(repr=False)
    scale: float = 1.0
    is_moving: bool = False
    other_sensor: LidarSensor | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        is_right = isinstance(self.place, BuildingConfig) == isinstance(self.motion, WalkConfig)
        require_value(is_right, "motion", "a WalkConfig in a building and a DriveConfig in a town", self.motion)


# Mixture for training: a third of the scenes are indoors, and some drives alternate between two lidars.
TRAINING_MIXTURE = SceneMixture(
    kinds=(
        ("suburb", 0.19), ("canyon", 0.09), ("country", 0.08), ("car_park", 0.07), ("campus", 0.09), ("wood", 0.06),
        ("field", 0.05), ("jam", 0.04), ("office", 0.08), ("hall", 0.06), ("flat", 0.04), ("corridor", 0.05),
        ("tunnel", 0.03), ("garage", 0.04), ("stairs", 0.03),
    ),
    sensors=(
        (HDL64E, 0.22), (OS1_64, 0.14), (OS1_128, 0.1), (PANDAR64, 0.1), (HDL32E, 0.18), (VLP16, 0.2),
        (SOLID_STATE, 0.06),
    ),
    other_lidar_rate=0.7,
)  # fmt: skip


def draw_scene(seed: int, mixture: SceneMixture = SceneMixture()) -> Scene:
    """Draws the scene of a seed, the same one every time; nothing is built yet.

    Args:
        seed: seed of all choices, not negative.
        mixture: distribution of scenes.

    Returns:
        The scene.

    Raises:
        ValueError: a negative seed.
    """
    require_value(seed >= 0, "seed", "zero or more", seed)
    rng = np.random.default_rng([8170, seed])
    kind, sensor = _choice(rng, mixture.kinds), _choice(rng, mixture.sensors)
    # Also drawn outdoors, where the scale is 1, so that later draws of a seed are the same.
    scale = float(np.exp(rng.uniform(*np.log(mixture.indoor_scale if kind in INDOOR_KINDS else (1.0, 1.0)))))
    is_moving = bool(rng.random() < mixture.moving_rate)
    if kind in INDOOR_KINDS:
        is_robot = rng.random() < 0.3
        height, tilt = (rng.uniform(0.3, 0.9), 1.0) if is_robot else (rng.uniform(0.9, 1.7), rng.uniform(3, 10))
        rate = 4.0 / mixture.spacing_m
        walking = WalkConfig(rate, float(height), float(tilt), is_robot=bool(is_robot))
        place = BuildingConfig(kind, 0.25 * mixture.length_m)
        return Scene(seed, place, walking, sensor, scale, is_moving, _other_sensor(rng, mixture, sensor))
    town = TownConfig(kind, str(rng.choice(_ROUTES)), mixture.length_m, float(rng.uniform(75, 130)))
    # Most cars carry their lidar on the roof; small robots carry it low.
    height = sensor.height_m + rng.normal(0, 0.12) if rng.random() < 0.7 else rng.uniform(0.5, 2.5)
    driving = DriveConfig(8.0, 8.0 / mixture.spacing_m, mixture.length_m, bool(rng.random() < 0.3), float(height))
    return Scene(seed, town, driving, sensor, scale, is_moving, _other_sensor(rng, mixture, sensor))


def _other_sensor(rng: np.random.Generator, mixture: SceneMixture, sensor: LidarSensor) -> LidarSensor | None:
    is_drawn, other = rng.random() < mixture.other_lidar_rate, _choice(rng, mixture.sensors)
    return other if is_drawn and other != sensor else None


def _choice(rng: np.random.Generator, entries: tuple[tuple[_Entry, float], ...]) -> _Entry:
    weights = np.array([weight for _, weight in entries])
    return entries[rng.choice(len(entries), p=weights / weights.sum())][0]


@runs_on_host("call it outside, and pass its arrays in")
def simulate_scene(scene: Scene, *, trajectory: ArrayLike | None = None) -> SimulatedDrive:
    """Builds a scene; a scan is simulated when it is read.

    Args:
        scene: scene from `draw_scene`, or made by hand.
        trajectory: (n, 4, 4) `T_world_lidar` of a real drive to lay the street of a town along, see `make_town`.

    Returns:
        The sequence, with exact poses and times. The world is that of the place.
    """
    place: Building | Town
    if isinstance(scene.place, BuildingConfig):
        place = make_building(scene.seed, scene.place)
        way = walk(place, cast(WalkConfig, scene.motion), seed=scene.seed)
    else:
        place = make_town(scene.seed, scene.place, trajectory=trajectory)
        way = drive(place, cast(DriveConfig, scene.motion), seed=scene.seed)
    sensors = [sensor for sensor in (scene.sensor, scene.other_sensor) if sensor is not None]
    name = f"{place.name}-{'+'.join(sensor.name for sensor in sensors)}"
    motions = turn_motions(way) if scene.is_moving else np.zeros((len(way.times), 6))

    def read_scan(index: int) -> NDArray[np.float32]:
        key, pose = jax.random.fold_in(jax.random.key(scene.seed), index), way.T_world_lidar[index]
        sensor, motion = sensors[index % len(sensors)], motions[index]
        cloud = scan.scan_town(place.primitives, pose, way.times[index], key=key, sensor=sensor, motion=motion)
        return np.float32(scene.scale) * np.asarray(cloud.points)[np.asarray(cloud.mask)]

    poses = way.T_world_lidar.copy()
    poses[:, :3, 3] *= scene.scale
    sources = tuple(f"{name}, scan {index}" for index in range(len(poses)))
    return SimulatedDrive(name, sources, read_scan, poses, way.times)


def simulate_scenes(seeds: Sequence[int], mixture: SceneMixture = SceneMixture()) -> list[SimulatedDrive]:
    """Draws and builds scenes.

    Args:
        seeds: one for each scene.
        mixture: distribution of scenes.

    Returns:
        One sequence a seed.
    """
    return [simulate_scene(draw_scene(seed, mixture)) for seed in seeds]


def simulate_drive(
    seed: int,
    *,
    length_m: float = 600.0,
    kind: str | None = None,
    sensor: LidarSensor | None = None,
    mixture: SceneMixture = SceneMixture(),
) -> SimulatedDrive:
    """Draws and builds one scene of the mixture, of a given kind of place or with a given lidar.

    Args:
        seed: seed of all random choices, not negative.
        length_m: length of the route outdoors; indoors a quarter of it.
        kind: kind of place; None draws one.
        sensor: the lidar; None draws one.
        mixture: distribution of scenes; `length_m` replaces that of the mixture.

    Returns:
        The sequence, with exact poses and times; a scan is simulated when it is read.

    Raises:
        ValueError: a negative seed, an unknown kind, or a length that is not positive.
    """
    mixture = replace(mixture, length_m=length_m)
    if kind is not None:
        mixture = replace(mixture, kinds=((kind, 1.0),))
    if sensor is not None:
        mixture = replace(mixture, sensors=((sensor, 1.0),))
    return simulate_scene(draw_scene(seed, mixture))
