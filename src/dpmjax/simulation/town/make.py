"""Towns by seed: the ground, the objects along both sides of each street and on the land behind, and the traffic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, zoom

from dpmjax.checks import require_fields, require_one_of, require_positive_fields, require_value
from dpmjax.sequences import FloatArray
from dpmjax.simulation.town import objects, primitives
from dpmjax.simulation.town.kinds import KINDS, Kind, Quarter
from dpmjax.simulation.town.objects import Collection, Place, Size, plant_bushes, plant_trees
from dpmjax.simulation.town.primitives import CELL_M, LANE_STEP_M, RoadUsers, TownPrimitives, padded
from dpmjax.simulation.town.streets import LANE_M, Streets, arc_lengths, make_streets, on_path, resample, streets_along
from dpmjax.simulation.town.terrain import PAVEMENT_M, Plots, Terrain, make_terrain, with_equal_passes

_MAX_COORDINATE_M = 1e5  # Beyond, float32 holds no centimetres.
# Least and largest half length, half width and half height.
_CAR_M, _TRUCK_M = ((1.9, 2.5), (0.82, 0.95), (0.7, 0.9)), ((3.2, 6.5), (1.15, 1.27), (1.3, 1.8))


# Adds an object at a place; and nearest and farthest distance from the kerb, size, and clearance of its kind.
Put = Callable[[Collection, np.random.Generator, Place], None]
Spot = tuple[Size, Size, float]


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
        ValueError: a negative seed, or a trajectory of another shape, shorter than 20 m or far from the origin.
    """
    require_value(seed >= 0, "seed", "zero or more", seed)
    rng = np.random.default_rng([8150, seed])
    support, kind = None, KINDS[config.kind]
    if trajectory is None:
        streets = make_streets(rng, config.route, config.route_length_m, config.block_m, kind.half_width)
    else:
        poses = np.asarray(trajectory, np.float64)
        is_right = poses.ndim == 3 and poses.shape[1:] == (4, 4) and np.isfinite(poses).all()
        require_value(is_right, "trajectory", "finite (n, 4, 4) poses", poses.shape)
        positions, farthest = poses[:, :3, 3], float(np.abs(poses[:, :3, 3]).max())
        within = f"positions within {_MAX_COORDINATE_M:g} m of the origin (subtract the first one)"
        require_value(farthest <= _MAX_COORDINATE_M, "trajectory", within, f"{farthest:g} m")
        streets = streets_along(positions[:, :2], rng)
        support = with_equal_passes(positions) - [0.0, 0.0, 1.73]
    terrain = make_terrain(rng, streets, support, kind)
    standing = _furnish(rng, streets, Plots(terrain), kind)
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
    mask = jnp.arange(len(rows)) < len(table)
    return RoadUsers(lane_points, lane_lengths, own_lanes, starts, speeds, sides, rows[:, 4:7], mask)


def _users(
    rng: np.random.Generator, lane: int, length: float, half_width: float, kind: Kind
) -> list[tuple[float, ...]]:
    """Draws rows of the road users of a lane: lane, path length, speed, distance to the left, half sizes."""

    def vehicle() -> list[float]:
        return [rng.uniform(*span) for span in (_TRUCK_M if rng.random() < kind.trucks else _CAR_M)]

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
    # Fifteen people walk on a kilometre.
    for _ in range(rng.poisson(15.0 * length / 1000) if kind.has_pavement else 0):
        side = -half_width - rng.uniform(0.4, 1.8)
        way, speed = rng.uniform(0, length), rng.uniform(0.8, 1.8)
        users.append((lane, way, speed, side, 0.2, 0.25, rng.uniform(0.75, 0.93)))
    return users


@dataclass(frozen=True)
class _Side:
    """One side of one street: its kerb-to-kerb geometry and the direction of "away from the street"."""

    path: FloatArray
    length: float
    half_width: float
    quarter: Quarter
    kind: Kind
    plots: Plots

    def place(self, way: float, from_kerb: float) -> Place:
        """Returns a place beside the street, with the street to the right of its heading."""
        spot = on_path(self.path, np.array([way]))[0]
        heading = float(np.arctan2(spot[3], spot[2]))
        left = from_kerb + self.half_width
        x, y = spot[0] - np.sin(heading) * left, spot[1] + np.cos(heading) * left
        return Place(x, y, float(self.plots.terrain.height_at(np.array([[x, y]]))[0]), heading)

    def scatter(self, into: Collection, rng: np.random.Generator, mean: float, spot: Spot, put: Put) -> None:
        """Adds objects at random places beside the street where the ground is free."""
        (nearest, farthest), size, clear = spot
        for _ in range(rng.poisson(mean)):
            place = self.place(rng.uniform(0, self.length), rng.uniform(nearest, farthest))
            if self.plots.claim(place, size, clear):
                put(into, rng, place)


def _furnish(rng: np.random.Generator, streets: Streets, plots: Plots, kind: Kind) -> Collection:
    """Builds all objects of the town; each new one occupies its part of the free ground."""
    into, sides = Collection(), []

    def draw() -> Quarter:
        return kind.quarters[rng.choice(len(kind.quarters), p=kind.shares)]

    for path, half_width in zip(streets.paths, streets.half_widths, strict=True):
        quarter = draw()
        for line in (path, path[::-1]):
            other = draw() if rng.random() < 0.25 else quarter
            sides.append(_Side(line, float(arc_lengths(line)[-1]), half_width, other, kind, plots))
    steps = (_bridges, _houses, _kerbside, _pavement if kind.has_pavement else _roadside, _verge, _second_row)
    for step in steps:
        for side in sides:
            step(into, rng, side)
    _plant_land(into, rng, plots, kind)
    return into


def _put_tree(into: Collection, rng: np.random.Generator, place: Place, side: _Side, scale: float = 1.0) -> None:
    low, high = side.kind.tree_height
    feet = np.array([[place.x, place.y, place.ground]])
    plant_trees(into, rng, feet, (scale * low, scale * high), conifers=0.5 * side.kind.conifers)


def _put_bush(into: Collection, rng: np.random.Generator, place: Place) -> None:
    near = [place.move(*rng.normal(0.0, 0.5, 2)) for _ in range(rng.integers(1, 4))]
    plant_bushes(into, rng, np.array([[at.x, at.y, at.ground] for at in near]))


def _bridges(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    for _ in range(rng.poisson(0.5 * side.kind.bridges_per_km * side.length / 1000)):
        place = side.place(rng.uniform(0.25, 0.75) * side.length, -side.half_width)
        objects.put_bridge(into, rng, place, side.half_width)


def _verge(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds bushes and tall grass along the kerb, and posts of a rail."""
    if side.kind.verge_step:
        side.scatter(into, rng, side.length / side.kind.verge_step, ((1.3, 5.0), (0.8, 0.8), 0.9), _put_bush)


def _roadside(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds the objects beside a road without pavement: delineators, signs, poles of a line."""
    lines = [(float(rng.uniform(25, 50)), 0.06, 1.0, 0.7)]
    if rng.random() < 0.5:
        lines.append((float(rng.uniform(30, 50)), 0.12, 7.5, 2.5))
    for step, radius, height, from_kerb in lines:
        for way in np.arange(rng.uniform(2, step), side.length, step):
            place = side.place(float(way), from_kerb)
            if side.plots.claim(place, (0.4, 0.4), 0.2):
                objects.put_pole(into, place, radius, height)
    side.scatter(into, rng, side.length / 90.0, ((0.6, 1.5), (0.8, 0.6), 0.3), objects.put_sign)


def _houses(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds the first row: houses with gardens, fronts in line within some decimetres unless the gardens differ."""
    quarter, way = side.quarter, float(rng.uniform(0, 6))
    line = rng.uniform(*quarter.setback)
    while way < side.length:
        width, depth = rng.uniform(*quarter.house_width), rng.uniform(*quarter.house_depth)
        gap = max(rng.uniform(*quarter.gap), 0.0)
        gap = 0.0 if gap < 1.0 else gap
        if quarter.gap[1] > 2 and rng.random() < 0.3:
            line = rng.uniform(*quarter.setback)
        setback = line + rng.normal(0.0, 0.25)
        middle = way + 0.5 * width
        place = side.place(middle, setback + 0.5 * depth)
        is_built = rng.random() < quarter.house_rate
        has_house = is_built and side.plots.claim(place, (width - 0.6, depth), PAVEMENT_M + 0.6)
        if has_house:
            height = float(rng.uniform(*quarter.eaves))
            objects.put_house(into, rng, place, (width, depth), height, is_plain=setback < 3.6)
            if gap > 4 and rng.random() < 0.5:
                garage = side.place(way + width + 0.5 * gap, setback + 4.0)
                if side.plots.claim(garage, (3.0, 5.5), PAVEMENT_M + 0.6):
                    objects.put_box(into, garage, (3.0, 5.5), (-1.0, 2.6), window_depth=0.1)
        elif rng.random() < quarter.car_park_rate:
            _car_park(into, rng, side, (middle, width + gap))
        if setback > PAVEMENT_M + 1.4 and rng.random() < quarter.border_rate:
            border = side.place(middle + 0.5 * gap, PAVEMENT_M + 0.4)
            if side.plots.claim(border, (width + gap - 1.0, 0.4), PAVEMENT_M - 0.4):
                objects.put_border(into, rng, border, width + gap - 0.4, str(rng.choice(("hedge", "wall", "fence"))))
        _garden(into, rng, side, (way, width + gap), setback if has_house else setback + depth)
        way += width + gap


def _garden(into: Collection, rng: np.random.Generator, side: _Side, plot: Size, front: float) -> None:
    """Adds trees and bushes between the pavement and the house."""
    (way, width), quarter = plot, side.quarter
    if front < PAVEMENT_M + 2.0:
        return

    def places(mean: float, size: float) -> list[Place]:
        drawn = [
            side.place(way + rng.uniform(0, width), rng.uniform(PAVEMENT_M + 1.0, front - 0.8))
            for _ in range(rng.poisson(mean))
        ]
        return [place for place in drawn if side.plots.claim(place, (size, size), PAVEMENT_M + 0.4)]

    for place in places(quarter.garden_trees, 0.8):
        _put_tree(into, rng, place, side, 0.8)
    for place in places(quarter.garden_bushes, 1.4):
        _put_bush(into, rng, place)


def _car_park(into: Collection, rng: np.random.Generator, side: _Side, plot: Size) -> None:
    middle, width = plot
    size = (max(width - 2.0, 14.0), float(rng.uniform(16, 34)))
    place = side.place(middle, PAVEMENT_M + 1.0 + 0.5 * size[1])
    if side.plots.claim(place, size, PAVEMENT_M):
        objects.put_car_park(into, rng, place, size)


def _kerbside(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds parked cars, half on the kerb, in the direction of the traffic of that side, with gaps."""
    way, rate = float(rng.uniform(3, 9)), side.quarter.parked_rate * rng.uniform(0.4, 1.3)
    while way < side.length - 3:
        if rng.random() < rate:
            # Parked cars leave 4.2 m from the middle of the street.
            from_kerb = max(-0.2, 4.2 - side.half_width) + float(rng.normal(0, 0.12))
            place = side.place(way, from_kerb)
            turned = Place(place.x, place.y, place.ground - 0.06, place.heading + np.pi + float(rng.normal(0, 0.02)))
            if side.plots.claim(turned, (4.8, 1.7), -1.6):
                objects.put_car(into, rng, turned)
        way += rng.uniform(5.3, 7.5)


def _pavement(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds lamps, signs, boxes, trees and people on the pavement."""
    step = side.quarter.street_tree_step
    trees = np.arange(rng.uniform(2, 10), side.length, step) if step else np.zeros(0)
    lamps = np.arange(rng.uniform(4, 24), side.length, rng.uniform(22, 36))
    for way in trees:
        place = side.place(float(way) + rng.normal(0, 0.4), 1.2)
        if rng.random() < 0.75 and side.plots.claim(place, (0.6, 0.6), 0.3):
            _put_tree(into, rng, place, side, 0.75)
    for way in lamps:
        place = side.place(float(way), 0.6)
        if side.plots.claim(place, (0.4, 0.4), 0.0):
            objects.put_pole(into, place, float(rng.uniform(0.06, 0.12)), float(rng.uniform(4.5, 8.0)))
    for step, put in ((40.0, objects.put_sign), (35.0, objects.put_person), (25.0, _put_cabinet)):
        side.scatter(into, rng, side.length / step, ((0.5, 1.9), (0.8, 0.6), 0.0), put)


def _put_cabinet(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Adds a switch cabinet, a bin or a bench."""
    size = (float(rng.uniform(0.5, 1.5)), float(rng.uniform(0.35, 0.7)))
    objects.put_box(into, place, size, (-0.1, float(rng.uniform(0.7, 1.3))))


def _second_row(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Adds the second row: houses and trees that are visible through the gaps of the first."""
    way = float(rng.uniform(0, 15))
    while way < side.length:
        width, depth = rng.uniform(8, 20), rng.uniform(7, 12)
        place = side.place(way + 0.5 * width, rng.uniform(22, 34) + 0.5 * depth)
        is_built = rng.random() < 0.75 * side.quarter.house_rate
        if is_built and side.plots.claim(place, (width, depth), 4.0):
            height = float(rng.uniform(0.6, 1.3) * rng.uniform(*side.quarter.eaves))
            objects.put_house(into, rng, place, (width, depth), height, is_plain=True)
        elif rng.random() < 0.5 * side.quarter.car_park_rate:
            _car_park(into, rng, side, (way + 0.5 * width, width))
        for _ in range(rng.poisson(1.2)):
            tree = side.place(way + rng.uniform(0, width), rng.uniform(14, 40))
            if side.plots.claim(tree, (1.5, 1.5), 3.0):
                _put_tree(into, rng, tree, side)
        way += width + rng.uniform(3, 15)


def _plant_land(into: Collection, rng: np.random.Generator, plots: Plots, kind: Kind) -> None:
    """Adds plants on the free land outside of streets and plots, in patches, up to 65 m from a kerb."""
    terrain = plots.terrain
    shape = terrain.heights.shape
    patches = gaussian_filter(rng.normal(size=tuple(-(-size // 8) for size in shape)), 14.0 / (8 * CELL_M))
    is_wooded = zoom(patches <= np.quantile(patches, kind.woodland), 8, order=0)[: shape[0], : shape[1]]
    size = CELL_M * (np.array(shape)[::-1] - 1)
    for per_ha, clear in ((kind.trees_per_ha, 2.5), (kind.bushes_per_ha, 1.6)):
        places = rng.uniform(0, 1, (rng.poisson(per_ha * size.prod() / 1e4), 2)) * size
        column, row = np.round(places / CELL_M).astype(int).T
        places = terrain.origin + places[is_wooded[row, column] & (terrain.street_distance[row, column] < 65.0)]
        places = places[plots.are_free(places, clear)]
        feet = np.column_stack([places, terrain.height_at(places)]) if len(places) else np.zeros((0, 3))
        if clear == 2.5:
            plant_trees(into, rng, feet, kind.tree_height, conifers=kind.conifers)
        else:
            plant_bushes(into, rng, feet)
