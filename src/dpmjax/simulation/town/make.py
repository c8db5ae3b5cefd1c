"""Makes towns by seed: the ground with its slopes, kerbs and meadows, what stands on it, and the traffic."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town import primitives
from dpmjax.simulation.town.furnish import furnish
from dpmjax.simulation.town.heights import with_equal_passes
from dpmjax.simulation.town.kinds import KINDS, Kind
from dpmjax.simulation.town.plots import Plots
from dpmjax.simulation.town.primitives import CELL_M, LANE_STEP_M, Terrain, TownPrimitives, Traffic, pack_bodies, padded
from dpmjax.simulation.town.streets import LANE_M, Streets, arc_lengths, make_streets, resample, streets_along

_MARGIN_M = 70.0
_TILE = 256
_KERB_M = 0.12
_PAVEMENT_M = 2.2
_SENSOR_HEIGHT_M = 1.73
_WALKERS_PER_KM = 15.0  # For each kilometre of lane.
_TOWN_STREAM = 8150


@dataclass(frozen=True)
class TownConfig:
    """Settings of a town.

    Attributes:
        kind: of the place: suburb, canyon (tall houses), country, car_park, campus, wood, field, or jam (queues of
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
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}")
        if self.route not in ("loop", "there_and_back", "wander"):
            raise ValueError(f"route must be loop, there_and_back or wander, got {self.route!r}")
        if not (self.route_length_m > 0 and self.block_m >= 50):
            sizes = f"{self.route_length_m} and {self.block_m}"
            raise ValueError(f"route_length_m must be positive and block_m at least 50, got {sizes}")


@dataclass(frozen=True)
class Town:
    """A town.

    Attributes:
        name: with its seed, for titles.
        streets: the streets and the route, on the host.
        terrain: the ground, on the host.
        primitives: bodies and ground that a beam meets, on the device.
    """

    name: str
    streets: Streets = field(repr=False)
    terrain: Terrain = field(repr=False)
    primitives: TownPrimitives = field(repr=False)


def make_town(seed: int, config: TownConfig = TownConfig(), *, trajectory: ArrayLike | None = None) -> Town:
    """Builds the town of a seed; the same one every time.

    Args:
        seed: of all choices, not negative.
        config: settings of the town; with a trajectory, its route and slopes do not count.
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
        positions = _positions(trajectory)
        streets = streets_along(positions[:, :2], rng)
        support = with_equal_passes(positions) - [0.0, 0.0, _SENSOR_HEIGHT_M]
    terrain = make_terrain(rng, streets, support, kind)
    standing = furnish(rng, streets, Plots(terrain), kind)
    tables = (np.array(rows, np.float64) for rows in (standing.boxes, standing.cylinders, standing.spheroids))
    kinds = (primitives.SOLID, primitives.POLE, primitives.SOFT)
    boxes, cylinders, spheroids = map(pack_bodies, tables, kinds)
    ground = primitives.Ground(*(jnp.asarray(x, jnp.float32) for x in (terrain.heights, terrain.origin, CELL_M)))
    whole = TownPrimitives(boxes, cylinders, spheroids, ground, _make_traffic(rng, streets, terrain, kind))
    return Town(f"{config.kind}-{seed}", streets, terrain, whole)


def _positions(trajectory: ArrayLike) -> FloatArray:
    poses = np.asarray(trajectory, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
        raise ValueError(f"trajectory must be finite (n, 4, 4) poses, got {poses.shape}")
    return poses[:, :3, 3]


def _make_traffic(rng: np.random.Generator, streets: Streets, terrain: Terrain, kind: Kind) -> Traffic:
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
    return Traffic(lane_points, lane_lengths, own_lanes, starts, speeds, sides, rows[:, 4:7], mask)


def _users(
    rng: np.random.Generator, lane: int, length: float, half_width: float, kind: Kind
) -> list[tuple[float, ...]]:
    """Rows of the road users of a lane: lane, way, speed, distance to the left, half sizes."""

    def vehicle() -> tuple[float, float, float]:
        if rng.random() < kind.trucks:
            return (rng.uniform(3.2, 6.5), rng.uniform(1.15, 1.27), rng.uniform(1.3, 1.8))
        return (rng.uniform(1.9, 2.5), rng.uniform(0.82, 0.95), rng.uniform(0.7, 0.9))

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


def make_terrain(
    rng: np.random.Generator, streets: Streets, support: FloatArray | None, kind: Kind = KINDS["suburb"]
) -> Terrain:
    """Shapes the ground.

    Args:
        rng: source of all choices.
        streets: where the streets are.
        support: (n, 3) points that the streets must go through, m; None lets the land roll at random.
        kind: how steep and rough the land is.

    Returns:
        The terrain; its grid is a whole number of tiles of 128 m, so that kernels see few shapes.
    """
    lines = np.vstack(streets.paths)
    low = lines.min(0) - _MARGIN_M
    cells = np.ceil((lines.max(0) + _MARGIN_M - low) / CELL_M).astype(int)
    columns, rows = (int(-(-count // _TILE) * _TILE) for count in cells)
    distance = _street_distance(streets, low, (rows, columns))
    x, y = np.meshgrid(low[0] + CELL_M * np.arange(columns), low[1] + CELL_M * np.arange(rows))
    land = (
        _rolling(rng, x, y, rng.uniform(*kind.steepness))
        if support is None
        else _through(support, low, (rows, columns))
    )
    return Terrain(low, land + _cross_section(distance) + kind.roughness * _roughness(rng, distance), distance)


def _street_distance(streets: Streets, origin: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Distance from the nearest kerb; streets of different width count by their own."""
    from scipy.ndimage import distance_transform_edt

    widths = np.round(np.array(streets.half_widths), 1)
    nearest = np.full(shape, np.inf)
    for width in np.unique(np.round(widths * 2) / 2):
        is_far = np.ones(shape, bool)
        for path, own in zip(streets.paths, widths, strict=True):
            if round(own * 2) / 2 == width:
                cell = np.round((path - origin) / CELL_M).astype(int)
                is_far[cell[:, 1], cell[:, 0]] = False
        nearest = np.minimum(nearest, distance_transform_edt(is_far) * CELL_M - width)
    return nearest


def _rolling(rng: np.random.Generator, x: FloatArray, y: FloatArray, steepness: float) -> FloatArray:
    land = np.zeros_like(x)
    for wavelength in (900.0, 600.0, 400.0, 250.0):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        wave = 2 * np.pi / wavelength
        land += steepness * 0.7 / wave * np.sin(wave * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return land


def _through(support: FloatArray, origin: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Land through given points: inverse distances on a coarse grid, smoothed, then brought to the fine one."""
    from scipy.ndimage import gaussian_filter, map_coordinates
    from scipy.spatial import KDTree

    coarse = 8
    rows, columns = (count // coarse + 2 for count in shape)
    step = CELL_M * coarse
    x, y = np.meshgrid(origin[0] + step * np.arange(columns), origin[1] + step * np.arange(rows))
    places = np.stack([x, y], axis=-1)
    distance, index = KDTree(support[:, :2]).query(places, k=list(range(1, min(8, len(support)) + 1)))
    weight = 1.0 / np.maximum(distance, 1.0) ** 2
    values = support[:, 2][index]
    land = gaussian_filter((weight * values).sum(-1) / weight.sum(-1), 2.0)
    at = np.stack(np.meshgrid(np.arange(shape[0]) / coarse, np.arange(shape[1]) / coarse, indexing="ij"))
    return map_coordinates(land, at, order=1, mode="nearest")


def _cross_section(distance: FloatArray) -> FloatArray:
    """A cambered street, a kerb, a pavement, and gardens a little higher."""
    camber = 0.02 * np.clip(-distance, 0, 5)
    kerb = _KERB_M * np.clip((distance + 0.25) / 0.5, 0, 1)
    return camber + kerb + 0.15 * np.clip((distance - _PAVEMENT_M) / 2.0, 0, 1)


def _roughness(rng: np.random.Generator, distance: FloatArray) -> FloatArray:
    """A centimetre on streets, several and gentle mounds beside them."""
    from scipy.ndimage import gaussian_filter

    fine = rng.normal(size=distance.shape)
    mounds = gaussian_filter(rng.normal(size=distance.shape), 8.0) * 28.0
    is_garden = np.clip((distance - _PAVEMENT_M) / 2.0, 0, 1)
    return (0.01 + 0.05 * is_garden) * fine + 0.12 * is_garden * mounds
