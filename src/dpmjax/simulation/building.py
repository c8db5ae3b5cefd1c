"""Buildings for the ray caster: walls with doors, ceilings, furniture and stairs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from dpmjax.checks import require_one_of, require_positive_fields, require_value
from dpmjax.sequences import FloatArray
from dpmjax.simulation.floor_plan import Door, Plan, Room, make_plan, make_route
from dpmjax.simulation.town.objects import Collection, Place, plant_bushes, put_box, put_car, put_person, put_pole
from dpmjax.simulation.town.primitives import CELL_M, Ground, RoadUsers, TownPrimitives

_Put = Callable[[Collection, np.random.Generator, Place], None]
KINDS = ("office", "hall", "flat", "corridor", "tunnel", "garage", "stairs")
_THICKNESS_M = 0.12


@dataclass(frozen=True)
class BuildingConfig:
    """Properties of a building.

    Attributes:
        kind: office, hall, flat, corridor, tunnel, garage (with parked cars) or stairs.
        route_length_m: least length of the walk.

    Raises:
        ValueError: another kind, or a length that is not positive.
    """

    kind: str = "office"
    route_length_m: float = 100.0

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, KINDS)
        require_positive_fields(self, "route_length_m")


@dataclass(frozen=True)
class Building:
    """A storey of a building.

    Attributes:
        name: name with its seed, for titles.
        plan: rooms and doors.
        route: (k, 2) points of the walk at steps of a decimetre, m, without obstacles.
        primitives: bodies and floor for the ray caster, on the device; the floor begins at z = 0.
    """

    name: str
    plan: Plan = field(repr=False)
    route: FloatArray = field(repr=False)
    primitives: TownPrimitives = field(repr=False)


def make_building(seed: int, config: BuildingConfig = BuildingConfig()) -> Building:
    """Builds the building of a seed; the same one every time.

    Args:
        seed: seed of all choices, not negative.
        config: properties of the building.

    Returns:
        The building.

    Raises:
        ValueError: a negative seed.
    """
    require_value(seed >= 0, "seed", "zero or more", seed)
    rng = np.random.default_rng([8160, seed])
    plan = make_plan(rng, config.kind)
    route = make_route(rng, plan, config.route_length_m)
    into = Collection()
    for number, room in enumerate(plan.rooms):
        _walls(into, rng, room, [door for door in plan.doors if number in door.rooms])
        _ceiling(into, rng, room)
        if config.kind in ("corridor", "tunnel") and number == 0:
            _fittings(into, rng, room, route)
        elif config.kind == "garage":
            _parking(into, rng, room, route)
        elif config.kind == "stairs":
            _steps(into, rng, room, plan)
        else:
            _furniture(into, rng, room, route, is_hall=config.kind == "hall")
    none, lanes = jnp.zeros(64), jnp.zeros(64, jnp.int32)
    nobody = RoadUsers(jnp.zeros((2, 64, 3)), jnp.ones(2), lanes, none, none, none, jnp.zeros((64, 3)), none > 0)
    low = np.min([room.low for room in plan.rooms], axis=0) - 20.0
    heights = np.tile(plan.floor_at(low[0] + CELL_M * np.arange(256)), (256, 1))
    floor = Ground(jnp.asarray(heights, jnp.float32), jnp.asarray(low, jnp.float32), jnp.float32(CELL_M))
    whole = TownPrimitives(*into.packed(), floor, nobody)
    return Building(f"{config.kind}-{seed}", plan, route, whole)


def _place(x: float, y: float, heading: float = 0.0) -> Place:
    return Place(float(x), float(y), 0.0, heading)


def _walls(into: Collection, rng: np.random.Generator, room: Room, doors: list[Door]) -> None:
    """Adds four walls inside of the room's border, with openings for doors; outer walls may have windows."""
    for axis in (0, 1):
        for at, inwards in ((room.low[axis], 1), (room.high[axis], -1)):
            here = [door for door in doors if door.axis == axis and abs(door.place[axis] - at) < 0.01]
            cuts = sorted((door.place[1 - axis], door.width) for door in here)
            depth = 0.08 if not cuts and rng.random() < 0.5 else 0.0
            start, across = room.low[1 - axis], at + 0.5 * inwards * _THICKNESS_M
            for middle, width in cuts:
                _wall(into, axis, across, (start, middle - 0.5 * width), (-0.5, room.height), depth)
                # Doors are 2.1 m high.
                _wall(into, axis, across, (middle - 0.5 * width, middle + 0.5 * width), (2.1, room.height), 0.0)
                start = middle + 0.5 * width
            _wall(into, axis, across, (start, room.high[1 - axis]), (-0.5, room.height), depth)


def _wall(
    into: Collection, axis: int, across: float, ends: tuple[float, float], levels: tuple[float, float], depth: float
) -> None:
    length, middle = ends[1] - ends[0], 0.5 * (ends[0] + ends[1])
    place = _place(across, middle, 0.5 * np.pi) if axis == 0 else _place(middle, across)
    if length > 0.02 and levels[1] > levels[0]:
        put_box(into, place, (length, _THICKNESS_M), levels, window_depth=depth)


def _ceiling(into: Collection, rng: np.random.Generator, room: Room) -> None:
    """Adds a ceiling with beams, ducts or lamps."""
    middle = 0.5 * (np.array(room.low) + room.high)
    put_box(into, _place(*middle), room.size, (room.height, room.height + 0.3))
    deep, step = rng.uniform(0.06, 0.12) * room.height, rng.uniform(2.0, 6.0)
    if rng.random() < 0.7:
        for x in np.arange(room.low[0] + rng.uniform(0.5, step), room.high[0] - 0.3, step):
            size = (rng.uniform(0.1, 0.4), 0.98 * room.size[1])
            put_box(into, _place(x, middle[1]), size, (room.height - deep, room.height))
    if rng.random() < 0.5:
        at = _place(middle[0], rng.uniform(room.low[1] + 0.5, room.high[1] - 0.5))
        put_box(into, at, (0.97 * room.size[0], 0.4), (room.height - 2.2 * deep, room.height - 1.2 * deep))


def _fittings(into: Collection, rng: np.random.Generator, room: Room, route: FloatArray) -> None:
    """Adds pillars or door frames along the walls of a corridor, often at equal steps, and few objects between."""
    step, deep, wide = rng.uniform(2.5, 8.0), rng.uniform(0.04, 0.4), rng.uniform(0.15, 1.2)
    high = room.height if rng.random() < 0.5 else 2.2
    jitter = float(rng.choice([0.0, 0.25])) * step
    for y in (room.low[1] + 0.5 * deep + _THICKNESS_M, room.high[1] - 0.5 * deep - _THICKNESS_M):
        for x in np.arange(room.low[0] + rng.uniform(0.5, step), room.high[0] - 1, step):
            if rng.random() >= 0.85:
                continue
            place = _place(x + rng.normal(0, jitter), y)
            beside = np.abs(route - [place.x, place.y]) - [0.5 * wide, 0.5 * deep]
            if np.max(beside, axis=1).min() > 0.2:
                put_box(into, place, (wide, deep), (0.0, high))
    for _ in range(rng.poisson(0.04 * room.size[0])):
        y = float(rng.choice([room.low[1] + 0.45, room.high[1] - 0.45]))
        spot = np.array([rng.uniform(room.low[0], room.high[0]), y])
        _put_if_free(into, rng, (spot, 0.0), route, [_put_cabinet, _put_plant, put_person])


def _parking(into: Collection, rng: np.random.Generator, room: Room, route: FloatArray) -> None:
    """Adds rows of parked cars between columns at equal steps."""
    step, taken, row_m = rng.uniform(4.8, 8.0), rng.uniform(0.2, 0.9), rng.uniform(8.0, 11.0)
    y_rows = np.arange(room.low[1] + 3.0, room.high[1] - 2.5, row_m)
    for y in y_rows:
        for x in np.arange(room.low[0] + rng.uniform(0.5, 2.0), room.high[0] - 0.5, step):
            _put_if_free(into, rng, (np.array([x, y + 2.8]), 0.0), route, [_put_column])
        for x in np.arange(room.low[0] + 2.0, room.high[0] - 1.5, 2.6):
            if rng.random() < taken:
                heading = 0.5 * np.pi * float(rng.choice([-1.0, 1.0])) + rng.normal(0, 0.04)
                spot = np.array([x, y]) + rng.normal(0, 0.15, 2)
                _put_if_free(into, rng, (spot, heading), route, [put_car])


def _steps(into: Collection, rng: np.random.Generator, room: Room, plan: Plan) -> None:
    """Adds steps, a ceiling that rises with them, and pilasters along the walls, often at equal steps."""
    deep, wide = rng.uniform(0.26, 0.34), 0.98 * room.size[1]
    for (start, low), (end, high) in itertools.pairwise(plan.floor):
        steps = np.arange(start, end, deep) if high > low else np.zeros(0)
        for x, top in zip(steps, plan.floor_at(steps + deep), strict=True):
            put_box(into, _place(x + 0.5 * deep, 0.0), (deep, wide), (top - 0.5, top))
    clear = room.height - plan.floor[-1][1]
    parts = np.arange(room.low[0], room.high[0], 1.5)
    for x, under in zip(parts, plan.floor_at(parts + 1.5) + clear, strict=True):
        if under < room.height - 0.1:
            put_box(into, _place(x + 0.75, 0.0), (1.5, wide), (under, room.height))
    step, out = rng.uniform(2.0, 6.0), rng.uniform(0.05, 0.3)
    for y in (room.low[1] + 0.5 * out + _THICKNESS_M, room.high[1] - 0.5 * out - _THICKNESS_M):
        for x in np.arange(room.low[0] + rng.uniform(0.5, step), room.high[0] - 0.5, step):
            if rng.random() < 0.85:
                put_box(into, _place(x, y), (rng.uniform(0.15, 1.0), out), (-0.5, room.height))


def _furniture(into: Collection, rng: np.random.Generator, room: Room, route: FloatArray, *, is_hall: bool) -> None:
    """Adds furniture along the walls and in the room, off the route."""
    area, inside = room.size[0] * room.size[1], np.minimum(1.0, 0.4 * np.array(room.size))
    beside: list[_Put] = [_put_cabinet, _put_cabinet, _put_desk, _put_plant]
    within: list[_Put] = [_put_desk, _put_machine]
    if is_hall:
        within = [_put_rack, _put_machine, _put_column, _put_plant, _put_stairs]
    for _ in range(rng.poisson(0.7 * sum(room.size))):
        axis, end = int(rng.integers(2)), int(rng.integers(2))
        spot = rng.uniform(room.low, room.high)
        spot[axis] = room.low[axis] + 0.45 if end == 0 else room.high[axis] - 0.45
        _put_if_free(into, rng, (spot, 0.5 * np.pi * (axis == 0)), route, beside)
    for _ in range(rng.poisson(0.05 * area)):
        spot = rng.uniform(room.low + inside, room.high - inside)
        turn = float(rng.choice([0.0, 0.5 * np.pi])) + (rng.normal(0, 0.3) if rng.random() < 0.3 else 0.0)
        _put_if_free(into, rng, (spot, turn), route, within)
    for _ in range(rng.poisson(0.006 * area)):
        spot = rng.uniform(room.low + inside, room.high - inside)
        _put_if_free(into, rng, (spot, 0.0), route, [put_person])


def _put_if_free(
    into: Collection, rng: np.random.Generator, spot: tuple[FloatArray, float], route: FloatArray, puts: Sequence[_Put]
) -> None:
    """Adds one of several objects at `spot` (position and heading), unless it would block the route."""
    part = Collection()
    puts[int(rng.integers(len(puts)))](part, rng, _place(spot[0][0], spot[0][1], spot[1]))
    rows = np.array([*part.boxes, *part.cylinders, *part.spheroids])
    # Nothing stands nearer than 0.45 m to the route.
    reach = np.hypot(rows[:, 3], rows[:, 4]) + 0.45
    apart = np.linalg.norm(rows[:, None, :2] - route[None, ::3], axis=-1).min(1)
    if (apart > reach).all():
        into.boxes += part.boxes
        into.cylinders += part.cylinders
        into.spheroids += part.spheroids


def _put_cabinet(into: Collection, rng: np.random.Generator, place: Place) -> None:
    high, wide = rng.uniform(0.7, 2.3), rng.uniform(0.6, 2.2)
    put_box(into, place, (wide, rng.uniform(0.35, 0.7)), (0.0, high), window_depth=0.0)
    if rng.random() < 0.4:
        put_box(into, place.move(rng.uniform(-0.2, 0.2), 0.0), (0.4, 0.3), (high, high + rng.uniform(0.2, 0.5)))


def _put_desk(into: Collection, rng: np.random.Generator, place: Place) -> None:
    wide = rng.uniform(1.0, 1.9)
    put_box(into, place, (wide, 0.8), (0.68, 0.74))
    for side in (-0.47, 0.47):
        put_box(into, place.move(side * wide, 0.0), (0.06, 0.7), (0.0, 0.68))
    put_box(into, place.move(rng.uniform(-0.3, 0.3), 0.2), (0.5, 0.1), (0.74, 1.2))
    chair = place.move(rng.uniform(-0.2, 0.2), -0.7)
    put_box(into, chair, (0.5, 0.5), (0.38, 0.5))
    put_box(into, chair.move(0.0, -0.22), (0.5, 0.08), (0.5, 1.0))
    put_pole(into, chair, 0.05, 0.4)


def _put_machine(into: Collection, rng: np.random.Generator, place: Place) -> None:
    size, high = rng.uniform(0.5, 2.0, 2), rng.uniform(0.5, 2.0)
    put_box(into, place, (size[0], size[1]), (0.0, high))
    put_box(into, place.move(0.2 * size[0], 0.0), (0.5 * size[0], 0.6 * size[1]), (high, high + rng.uniform(0.1, 0.8)))


def _put_rack(into: Collection, rng: np.random.Generator, place: Place) -> None:
    length, high = rng.uniform(2.5, 8.0), rng.uniform(1.8, 4.5)
    for level in np.arange(0.2, high, rng.uniform(0.8, 1.4)):
        put_box(into, place, (length, 1.0), (level - 0.05, level))
        full = rng.uniform(0.1, 0.9) * length
        at = place.move(rng.uniform(-0.5, 0.5) * (length - full), 0.0)
        put_box(into, at, (full, 0.8), (level, level + rng.uniform(0.3, 0.7)))
    for end in (-0.5, 0.5):
        put_box(into, place.move(end * length, 0.0), (0.08, 1.0), (0.0, high), softness=0.1)


def _put_column(into: Collection, rng: np.random.Generator, place: Place) -> None:
    if rng.random() < 0.5:
        put_pole(into, place, rng.uniform(0.15, 0.4), 11.0)
    else:
        side = rng.uniform(0.3, 0.7)
        put_box(into, place, (side, side), (-0.2, 11.0))


def _put_plant(into: Collection, rng: np.random.Generator, place: Place) -> None:
    put_box(into, place, (0.45, 0.45), (0.0, 0.45))
    plant_bushes(into, rng, np.array([[place.x, place.y, 0.6]]))


def _put_stairs(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Adds a flight of stairs with a rail."""
    wide, count = rng.uniform(1.0, 2.0), int(rng.integers(6, 16))
    for step in range(count):
        put_box(into, place.move(0.28 * step, 0.0), (0.28, wide), (0.0, 0.18 * (step + 1)))
        if step % 4 == 0:
            rail = place.move(0.28 * step, 0.5 * wide)
            put_box(into, rail, (1.1, 0.05), (0.18 * step, 0.18 * step + 1.0), softness=0.2)
