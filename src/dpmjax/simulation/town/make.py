"""Towns by seed: the ground with slopes, kerbs and meadows, the objects on it, and the traffic."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dpmjax.checks import require_fields, require_one_of, require_positive_fields
from dpmjax.simulation.town import primitives
from dpmjax.simulation.town.furnish import furnish
from dpmjax.simulation.town.kinds import KINDS, Kind
from dpmjax.simulation.town.primitives import CELL_M, LANE_STEP_M, RoadUsers, TownPrimitives, padded
from dpmjax.simulation.town.streets import LANE_M, Streets, arc_lengths, make_streets, resample, streets_along
from dpmjax.simulation.town.terrain import Plots, Terrain, make_terrain, with_equal_passes

_SENSOR_HEIGHT_M = 1.73
_WALKERS_PER_KM = 15.0  # For each kilometre of lane.
_TOWN_STREAM = 8150
# Least and largest half length, half width and half height.
_CAR_M, _TRUCK_M = ((1.9, 2.5), (0.82, 0.95), (0.7, 0.9)), ((3.2, 6.5), (1.15, 1.27), (1.3, 1.8))


@dataclass(frozen=True)
class TownConfig:
    """Settings of a town.

    Attributes:
        kind: kind of place: suburb, canyon (tall houses), country, car_park, campus, wood, field, or jam (queues of
            cars).
        route: kind of the drive's route; "there_and_back" drives the same street in both directions.
        route_length_m: wanted length of the route, met within a block or two.
        block_m: side of a block.

    Raises:
        ValueError: another kind or route, a length that is not positive, or blocks of less than 50 m.
    """

    kind: str = "suburb"
    route: str = "loop"
    route_length_m: float = 1000.0
    block_m: float = 100.0

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, KINDS)
        require_one_of("route", self.route, ("loop", "there_and_back", "wander"))
        require_positive_fields(self, "route_length_m")
        require_fields(self, "block_m", low=50)


@dataclass(frozen=True)
class Town:
    """A town.

    Attributes:
        name: name with its seed, for titles.
        streets: the streets and the route, on the host.
        terrain: the ground, on the host.
        primitives: bodies and ground for the ray caster, on the device.
    """

    name: str
    streets: Streets = field(repr=False)
    terrain: Terrain = field(repr=False)
    primitives: TownPrimitives = field(repr=False)


def make_town(seed: int, config: TownConfig = TownConfig(), *, trajectory: ArrayLike | None = None) -> Town:
    """Builds the town of a seed; the same one every time.

    Args:
        seed: seed of all choices, not negative.
        config: settings of the town; with a trajectory, its route and slopes are ignored.
        trajectory: (n, 4, 4) `T_world_lidar` of a real drive, z up (of KITTI: in the lidar's frame, not the camera's).
            One street is laid along it, and the ground goes 1.73 m below it, at one height for all passes of a place.

    Returns:
        The town.

    Raises:
        ValueError: a negative seed, or a trajectory of another shape or shorter than 20 m.
    """
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    rng = np.random.default_rng([_TOWN_STREAM, seed])
    support, kind = None, KINDS[config.kind]
    if trajectory is None:
        streets = make_streets(rng, config.route, config.route_length_m, config.block_m, kind.half_width)
    else:
        poses = np.asarray(trajectory, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
            raise ValueError(f"trajectory must be finite (n, 4, 4) poses, got {poses.shape}")
        positions = poses[:, :3, 3]
        streets = streets_along(positions[:, :2], rng)
        support = with_equal_passes(positions) - [0.0, 0.0, _SENSOR_HEIGHT_M]
    terrain = make_terrain(rng, streets, support, kind)
    standing = furnish(rng, streets, Plots(terrain), kind)
    ground = primitives.Ground(*(jnp.asarray(x, jnp.float32) for x in (terrain.heights, terrain.origin, CELL_M)))
    whole = TownPrimitives(*standing.packed(), ground, _make_traffic(rng, streets, terrain, kind))
    return Town(f"{config.kind}-{seed}", streets, terrain, whole)


def _make_traffic(rng: np.random.Generator, streets: Streets, terrain: Terrain, kind: Kind) -> RoadUsers:
    lanes = [resample(lane, LANE_STEP_M) for line in streets.lanes for lane in (line, line[::-1])]
    lengths = np.array([arc_lengths(lane)[-1] for lane in lanes])
    half_width = float(np.mean(streets.half_widths))
    users = [user for index, length in enumerate(lengths) for user in _users(rng, index, length, half_width, kind)]
    table = np.array(users, np.float64).reshape(-1, 7)
    rows = padded(table, primitives.capacity_for(len(table)))
    samples = primitives.capacity_for(max(len(lane) for lane in lanes))
    # Lanes are padded to one length by repeating their end.
    points = [np.column_stack([lane, terrain.height_at(lane)]) for lane in lanes]
    points = [np.pad(lane, ((0, samples - len(lane)), (0, 0)), mode="edge") for lane in points]
    capacity = primitives.capacity_for(len(lanes), least=2)
    lane_points, lane_lengths = padded(np.stack(points), capacity), jnp.maximum(padded(lengths, capacity), 1.0)
    own_lanes, (starts, speeds, sides) = rows[:, 0].astype(jnp.int32), rows[:, 1:4].T
    mask = primitives.mask_of(len(table), len(rows))
    return RoadUsers(lane_points, lane_lengths, own_lanes, starts, speeds, sides, rows[:, 4:7], mask)


def _users(
    rng: np.random.Generator, lane: int, length: float, half_width: float, kind: Kind
) -> list[tuple[float, ...]]:
    """Draws rows of the road users of a lane: lane, path length, speed, distance to the left, half sizes."""

    def vehicle() -> tuple[float, float, float]:
        length, width, height = _TRUCK_M if rng.random() < kind.trucks else _CAR_M
        return rng.uniform(*length), rng.uniform(*width), rng.uniform(*height)

    users: list[tuple[float, ...]] = [
        (lane, rng.uniform(0, length), rng.uniform(6, 13), -LANE_M, *vehicle())
        for _ in range(rng.poisson(kind.cars_per_km * length / 1000))
    ]
    for _ in range(rng.poisson(kind.queues_per_km * length / 1000)):
        way, speed = rng.uniform(0, length), rng.uniform(0.3, 3.0)
        for _ in range(rng.integers(3, 10)):
            size = vehicle()
            way = (way + 2 * size[0] + rng.uniform(1.5, 4.0)) % length
            users.append((lane, way, speed, -LANE_M, *size))
    for _ in range(rng.poisson(_WALKERS_PER_KM * length / 1000) if kind.has_pavement else 0):
        side = -half_width - rng.uniform(0.4, 1.8)
        way, speed = rng.uniform(0, length), rng.uniform(0.8, 1.8)
        users.append((lane, way, speed, side, 0.2, 0.25, rng.uniform(0.75, 0.93)))
    return users
