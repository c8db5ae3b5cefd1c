"""Plans of buildings: rooms, the doors between them, and a route through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town.streets import resample, smooth

_STEP_M = 0.1


@dataclass(frozen=True)
class Room:
    """A rectangular room.

    Attributes:
        low: x and y of one corner, m.
        high: x and y of the opposite corner, m.
        height: height of the ceiling, m.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    height: float

    @property
    def size(self) -> tuple[float, float]:
        """Sides along x and y, m."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]


@dataclass(frozen=True)
class Door:
    """An opening between two rooms.

    Attributes:
        rooms: numbers of the rooms.
        place: x and y of the middle of the opening, m.
        axis: direction of passage, 0 along x, 1 along y.
        width: width of the opening, m.
    """

    rooms: tuple[int, int]
    place: tuple[float, float]
    axis: int
    width: float


@dataclass(frozen=True)
class Plan:
    """A storey.

    Attributes:
        rooms: all rooms.
        doors: all doors; every room can be reached.
        floor: x and height of the floor at its bends, m; it is level across x.
    """

    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    floor: tuple[tuple[float, float], ...] = ((0.0, 0.0),)

    def floor_at(self, x: FloatArray) -> FloatArray:
        """Computes the heights of the floor, m.

        Args:
            x: places, m.

        Returns:
            One height for each; stairs count as slopes.
        """
        bends, heights = np.array(self.floor).T
        return np.interp(x, bends, heights)


def make_plan(rng: np.random.Generator, kind: str) -> Plan:
    """Draws a plan.

    Args:
        rng: source of all choices.
        kind: kind of building. An "office" has rooms on both sides of a corridor, a "flat" small rooms on both sides of
            a short one. A "hall" is a row of one to three halls with side rooms, a "garage" one low and wide room. A
            "corridor" is one long corridor or tunnel with up to three side rooms, a "tunnel" a longer tunnel. "stairs"
            are flights of stairs and landings in a row.

    Returns:
        The plan.
    """
    if kind == "hall":
        return _row_of_halls(rng)
    if kind in ("corridor", "tunnel"):
        return _long_corridor(rng, is_tunnel=kind == "tunnel" or rng.random() < 0.3, stretch=1 + (kind == "tunnel"))
    if kind == "garage":
        half = 0.5 * rng.uniform(16, 40)
        return Plan((Room((0.0, -half), (rng.uniform(30, 70), half), rng.uniform(2.2, 3.2)),), ())
    if kind == "stairs":
        return _flights(rng)
    small = kind == "flat"
    width, height = rng.uniform(1.2, 2.0) if small else rng.uniform(1.8, 3.5), rng.uniform(2.4, 3.4)
    length = rng.uniform(7, 12) if small else rng.uniform(22, 50)
    rooms, doors = [Room((0.0, -0.5 * width), (length, 0.5 * width), height)], []
    for side in (-1, 1):
        depth, x = rng.uniform(3, 5) if small else rng.uniform(3.5, 9), 0.0
        while length - x > 2.5:
            wide = rng.uniform(2.5, 5) if small else rng.uniform(3, 10)
            end = length if length - x - wide < 2.5 else x + wide
            near, far = 0.5 * width * side, (0.5 * width + depth) * side
            room = Room((x, min(near, far)), (end, max(near, far)), height + float(rng.choice([0.0, 0.0, 0.4])))
            place = float(rng.uniform(x + 0.8, end - 0.8)), near
            doors.append(Door((0, len(rooms)), place, 1, rng.uniform(0.85, 1.4)))
            rooms.append(room)
            x = end
    return Plan(tuple(rooms), tuple(doors))


def _row_of_halls(rng: np.random.Generator) -> Plan:
    height, x = rng.uniform(3.5, 10.0), 0.0
    rooms: list[Room] = []
    doors: list[Door] = []
    for index in range(rng.integers(1, 4)):
        end, half = x + rng.uniform(10, 35), 0.5 * rng.uniform(9, 26)
        rooms.append(Room((x, -half), (end, half), height * float(rng.uniform(0.8, 1.0))))
        if index:
            doors.append(Door((index - 1, index), (x, 0.0), 0, rng.uniform(2.0, 4.0)))
        x = end
    for number, hall in enumerate(tuple(rooms)):
        low, wide, top = hall.low[0] + rng.uniform(0, 3), rng.uniform(4, 8), hall.high[1]
        room = Room((low, top), (low + wide, top + rng.uniform(3, 8)), rng.uniform(2.5, 3.5))
        doors.append(Door((number, len(rooms)), (low + 0.5 * wide, top), 1, rng.uniform(0.9, 1.8)))
        rooms.append(room)
    return Plan(tuple(rooms), tuple(doors))


def _flights(rng: np.random.Generator) -> Plan:
    half, x, z = 0.5 * rng.uniform(2.2, 7), rng.uniform(3, 8), 0.0
    floor = [(0.0, z), (x, z)]
    for _ in range(rng.integers(1, 4)):
        run = rng.uniform(2.5, 6)
        x, z = x + run, z + rng.uniform(0.5, 0.65) * run
        floor.append((x, z))
        x += rng.uniform(2, 8)
        floor.append((x, z))
    return Plan((Room((0.0, -half), (x, half), z + rng.uniform(2.4, 4)),), (), tuple(floor))


def _long_corridor(rng: np.random.Generator, *, is_tunnel: bool, stretch: float) -> Plan:
    width, height = (rng.uniform(*span) for span in (((4, 8), (3.5, 6)) if is_tunnel else ((1.8, 4), (2.4, 3.4))))
    length = stretch * rng.uniform(40, 120)
    rooms, doors = [Room((0.0, -0.5 * width), (length, 0.5 * width), height)], []
    for x in np.arange(4, length - 10, length / 3)[: rng.integers(4)] + rng.uniform(0, 6):
        side, wide = int(rng.choice([-1, 1])), rng.uniform(3, 6)
        near, far = 0.5 * width * side, (0.5 * width + rng.uniform(3, 6)) * side
        doors.append(Door((0, len(rooms)), (float(x + 0.5 * wide), near), 1, rng.uniform(0.85, 1.4)))
        rooms.append(Room((x, min(near, far)), (x + wide, max(near, far)), height))
    return Plan(tuple(rooms), tuple(doors))


def make_route(rng: np.random.Generator, plan: Plan, length: float) -> FloatArray:
    """Draws a random route from room to room and through positions of each room, with revisits in both directions.

    Args:
        rng: source of all choices.
        plan: the rooms.
        length: least length of the walk, m.

    Returns:
        (k, 2) points at steps of a decimetre.
    """
    here, points = int(rng.integers(len(plan.rooms))), []
    points += _round(rng, plan.rooms[here])
    last = -1
    while len(points) < 2 or np.linalg.norm(np.diff(points, axis=0), axis=1).sum() < length:
        exits = [(n, door) for n, door in enumerate(plan.doors) if here in door.rooms]
        if not exits:
            points += _round(rng, plan.rooms[here])
            continue
        others = [(n, door) for n, door in exits if n != last] or exits
        number, door = others[rng.integers(len(others))]
        last, there = number, door.rooms[0] if door.rooms[1] == here else door.rooms[1]
        towards = np.sign(np.mean([plan.rooms[there].low, plan.rooms[there].high], axis=0) - door.place)
        step = 0.8 * towards * (np.arange(2) == door.axis)
        points += [np.array(door.place) - step, np.array(door.place) + step, *_round(rng, plan.rooms[there])]
        here = there
    path = resample(np.array(points), _STEP_M)
    return resample(smooth(path, 0.25 / _STEP_M, is_closed=False), _STEP_M)


def _round(rng: np.random.Generator, room: Room) -> list[FloatArray]:
    """Draws positions in a room."""
    count = int(np.clip(round(min(room.size) / 4), 1, 4))
    margin = 0.3 * np.minimum(room.size, 4.0)
    return [rng.uniform(room.low + margin, room.high - margin) for _ in range(count)]
