"""Objects of a town as rows of primitives: houses, cars, hedges, poles, people, car parks, bridges, trees, bushes.

Each builder takes a place on the ground with a heading (the street's direction; the street lies to the object's right)
and appends rows to a `Collection`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town.kinds import Span
from dpmjax.simulation.town.primitives import POLE, SOFT, SOLID, Bodies, pack_bodies

_SUNK_M = 1.0  # Houses and walls reach below the ground, which may slope.
_NUM_TUFTS = 5
Size = tuple[float, float]


@dataclass
class Collection:
    """Rows of primitives while a town is made.

    Attributes:
        boxes: x y z, half sizes, heading, softness, window depth.
        cylinders: the same numbers of their bounding boxes.
        spheroids: the same numbers of their bounding boxes.
    """

    boxes: list[tuple[float, ...]] = field(default_factory=list)
    cylinders: list[tuple[float, ...]] = field(default_factory=list)
    spheroids: list[tuple[float, ...]] = field(default_factory=list)

    def packed(self) -> tuple[Bodies, Bodies, Bodies]:
        """Returns boxes, cylinders and spheroids on the device."""
        kinds = ((self.boxes, SOLID), (self.cylinders, POLE), (self.spheroids, SOFT))
        boxes, cylinders, spheroids = (pack_bodies(np.array(rows, np.float64), surface) for rows, surface in kinds)
        return boxes, cylinders, spheroids


@dataclass(frozen=True)
class Place:
    """A place on the ground.

    Attributes:
        x: x in the world, m.
        y: y in the world, m.
        ground: height of the ground, m.
        heading: direction of the object's x, radians.
    """

    x: float
    y: float
    ground: float
    heading: float

    def move(self, along: float, left: float) -> Place:
        """Returns the place at these distances ahead and to the left, m."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return Place(self.x + cos * along - sin * left, self.y + sin * along + cos * left, self.ground, self.heading)


def put_box(
    into: Collection, place: Place, size: Size, levels: Size, *, softness: float = 0.0, window_depth: float = 0.0
) -> None:
    """Adds an upright box.

    Args:
        into: collection that gets the objects.
        place: its middle.
        size: length along and across the heading, m.
        levels: lowest and highest point above the ground, m.
        softness: mean depth of a beam before it is reflected, m; 0 if solid.
        window_depth: distance of windows behind the faces, m; 0 without windows.
    """
    low, high = levels
    centre = (place.x, place.y, place.ground + 0.5 * (low + high))
    into.boxes.append((*centre, size[0] / 2, size[1] / 2, 0.5 * (high - low), place.heading, softness, window_depth))


def put_house(
    into: Collection, rng: np.random.Generator, place: Place, size: Size, height: float, *, is_plain: bool
) -> None:
    """Adds a house to the objects: body with windows, stepped roof, and bays, steps and balconies towards the street.

    Args:
        into: collection that gets the objects.
        rng: source of all choices.
        place: middle of the body; the street lies to the right of its heading.
        size: length along and across the street, m.
        height: height of the eaves, m.
        is_plain: no bays, steps or balconies.
    """
    width, depth = size
    put_box(into, place, size, (-_SUNK_M, height), window_depth=float(rng.uniform(0.1, 0.4)))
    if rng.random() < 0.75:
        rise = rng.uniform(0.8, 1.6)
        put_box(into, place, (width, 0.7 * depth), (height, height + rise))
        put_box(into, place, (width, 0.35 * depth), (height + rise, height + 2 * rise))
    if is_plain:
        return
    front = -0.5 * depth
    if rng.random() < 0.5 and width > 7:
        bay, out, top = rng.uniform(2, 0.45 * width), rng.uniform(0.5, 1.6), rng.uniform(2.6, height)
        at = place.move(float(rng.uniform(-0.5, 0.5) * (width - bay)), front - 0.5 * out)
        put_box(into, at, (bay, out), (-_SUNK_M, top), window_depth=float(rng.uniform(0.05, 0.25)))
    if rng.random() < 0.5:
        steps = place.move(float(rng.uniform(-0.4, 0.4) * width), front - 0.6)
        put_box(into, steps, (float(rng.uniform(1.4, 2.4)), 1.2), (-_SUNK_M, float(rng.uniform(0.2, 0.7))))
    if rng.random() < 0.3 and height > 6:
        balcony = place.move(float(rng.uniform(-0.3, 0.3) * width), front - 0.6)
        put_box(into, balcony, (float(rng.uniform(2, 4)), 1.2), (2.8, 3.9))
    if rng.random() < 0.4:
        pipe = place.move(float(rng.choice([-0.5, 0.5])) * (width - 0.3), front - 0.08)
        put_pole(into, pipe, 0.06, height)


def put_car(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Adds a parked car, van or lorry to the objects: body, cabin, a gap below.

    Args:
        into: collection that gets the objects.
        rng: source of its size.
        place: its middle.
    """
    draw = rng.random()
    if draw < 0.04:
        length, width, top = rng.uniform(7.0, 12.0), rng.uniform(2.3, 2.5), rng.uniform(2.8, 3.8)
        put_box(into, place.move(-1.2, 0.0), (length - 2.4, width), (0.9, top))
        put_box(into, place.move(0.5 * length - 1.0, 0.0), (2.0, 0.95 * width), (0.5, 0.8 * top))
    elif draw < 0.14:
        length, width, top = rng.uniform(4.8, 6.2), rng.uniform(1.9, 2.1), rng.uniform(2.0, 2.7)
        put_box(into, place, (length, width), (0.35, top))
        put_box(into, place.move(0.5 * length + 0.25, 0.0), (0.5, width), (0.35, 0.5 * top))
    else:
        length, width, top = rng.uniform(3.6, 4.9), rng.uniform(1.65, 1.85), rng.uniform(1.4, 1.75)
        belt = rng.uniform(0.55, 0.62) * top
        put_box(into, place, (length, width), (0.22, belt))
        cabin = place.move(float(rng.uniform(-0.12, 0.0) * length), 0.0)
        put_box(into, cabin, (rng.uniform(0.5, 0.62) * length, 0.86 * width), (belt, top))
    for along in (-0.32, 0.32):
        put_box(into, place.move(along * length, 0.0), (0.6, 0.98 * width), (0.0, 0.4))


def put_pole(into: Collection, place: Place, radius: float, height: float) -> None:
    """Adds a pole to the objects: an upright cylinder on the ground.

    Args:
        into: collection that gets the objects.
        place: its foot.
        radius: radius, m.
        height: height, m.
    """
    centre = (place.x, place.y, place.ground + 0.5 * height - 0.1)
    into.cylinders.append((*centre, radius, radius, 0.5 * height + 0.1, 0.0, 0.0, 0.0))


def put_sign(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Adds a sign to the objects: a post with a plate across the street's direction.

    Args:
        into: collection that gets the objects.
        rng: source of its size.
        place: its foot.
    """
    height, plate = rng.uniform(2.2, 2.8), rng.uniform(0.5, 0.9)
    put_pole(into, place, 0.04, float(height))
    put_box(into, place, (0.04, float(plate)), (float(height - plate), float(height)))


def put_border(into: Collection, rng: np.random.Generator, place: Place, length: float, kind: str) -> None:
    """Adds a hedge, wall or fence along the street to the objects, in pieces, with an open gate.

    Args:
        into: collection that gets the objects.
        rng: source of its shape.
        place: its middle.
        length: length, m.
        kind: "hedge", "wall" or "fence".
    """
    height, gate = rng.uniform(0.8, 2.0), rng.uniform(-0.4, 0.4) * length
    count = max(round(length / 3.0), 1)
    for index in range(count):
        along = (index + 0.5) / count * length - 0.5 * length
        if abs(along - gate) < 0.5 * length / count + 0.3 and count > 1:
            continue
        at, piece = place.move(along, 0.0), length / count
        if kind == "hedge":
            top = height + rng.normal(0.0, 0.06)
            beside = at.move(0.0, float(rng.normal(0.0, 0.06)))
            put_box(into, beside, (piece, rng.uniform(0.5, 1.0)), (-0.2, top), softness=0.12)
        elif kind == "wall":
            put_box(into, at, (piece, 0.3), (-_SUNK_M, 0.7 * height))
        else:
            put_box(into, at, (piece, 0.06), (0.1, 0.8 * height), softness=0.07)
            put_pole(into, at.move(0.5 * piece, 0.0), 0.04, 0.85 * height)


def put_person(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Adds a standing person to the objects: a body and a head.

    Args:
        into: collection that gets the objects.
        rng: source of the height.
        place: its foot.
    """
    height = rng.uniform(1.5, 1.9)
    put_pole(into, place, 0.22, height - 0.25)
    into.spheroids.append((place.x, place.y, place.ground + (height - 0.12), 0.11, 0.11, 0.14, 0.0, 0.0, 0.0))


def put_car_park(into: Collection, rng: np.random.Generator, place: Place, size: Size) -> None:
    """Adds a car park to the objects: rows of parked cars, lamps and a few trolleys or bollards between them.

    Args:
        into: collection that gets the objects.
        rng: source of all choices.
        place: middle of the car park.
        size: length along and across the heading, m.
    """
    taken = rng.uniform(0.25, 0.9)
    for across in np.arange(-0.5 * size[1] + 3.0, 0.5 * size[1] - 2.5, 8.5):
        for along in np.arange(-0.5 * size[0] + 2.0, 0.5 * size[0] - 1.5, 2.6):
            at = place.move(float(along), float(across + rng.normal(0, 0.2)))
            if rng.random() < taken:
                turn = 0.5 * np.pi * float(rng.choice([-1, 1])) + float(rng.normal(0, 0.03))
                put_car(into, rng, Place(at.x, at.y, at.ground, at.heading + turn))
            elif rng.random() < 0.05:
                put_box(into, at, (0.6, 1.0), (-0.1, float(rng.uniform(0.8, 1.1))), softness=0.1)
        lamp = place.move(float(rng.uniform(-0.4, 0.4) * size[0]), float(across) + 3.6)
        put_pole(into, lamp, 0.1, float(rng.uniform(6, 10)))


def put_bridge(into: Collection, rng: np.random.Generator, place: Place, half_width: float) -> None:
    """Adds a bridge over the street to the objects: a deck with parapets on piers, above the traffic.

    Args:
        into: collection that gets the objects.
        rng: source of its size.
        place: on the middle of the street, heading along it.
        half_width: half width of the street, m.
    """
    wide, clear, thick = rng.uniform(4, 14), rng.uniform(4.8, 6.5), rng.uniform(0.6, 1.4)
    span = 2 * half_width + rng.uniform(6, 30)
    put_box(into, place, (wide, span), (clear, clear + thick))
    for side in (-1, 1):
        edge = place.move(side * (0.5 * wide - 0.15), 0.0)
        put_box(into, edge, (0.3, span), (clear + thick, clear + thick + 1.1), softness=0.1)
        put_box(into, place.move(0.0, side * (half_width + 1.8)), (0.8 * wide, 1.0), (-_SUNK_M, clear))
        bank = place.move(0.0, side * (0.5 * span + 1.5))
        put_box(into, bank, (wide, 3.0), (-_SUNK_M, clear + thick))


def plant_trees(
    into: Collection, rng: np.random.Generator, feet: FloatArray, height: Span, *, conifers: float = 0.0
) -> None:
    """Adds trees of random shape: a trunk, and a crown of tufts.

    Args:
        into: collection that gets the objects.
        rng: source of their shapes.
        feet: (n, 3) positions on the ground.
        height: lowest and highest of the trees, m.
        conifers: share of trees with a narrow crown from near the ground.
    """
    count = len(feet)
    tall, is_conifer = rng.uniform(*height, count), rng.random(count) < conifers
    radius = np.where(is_conifer, 0.13, rng.uniform(0.16, 0.3, count)) * tall
    base = np.where(is_conifer, 0.15, rng.uniform(0.15, 0.4, count)) * tall
    thick = rng.uniform(0.012, 0.022, count) * tall
    zero = np.zeros(count)
    trunk = 0.5 * (base + tall)
    middle = feet + np.column_stack([zero, zero, 0.5 * trunk - 0.2])
    into.cylinders.extend(map(tuple, np.column_stack([middle, thick, thick, 0.5 * trunk + 0.2, zero, zero, zero])))
    for index in range(_NUM_TUFTS):
        part = (index + rng.uniform(0.2, 0.8, count)) / _NUM_TUFTS
        level = base + part * (tall - base)
        # A conifer narrows upwards; another crown is widest in its middle.
        wide = np.where(is_conifer, 1.1 - part, 0.35 + 0.65 * np.sin(np.pi * part)) * radius
        angle, out = rng.uniform(0, 2 * np.pi, count), np.where(is_conifer, 0.1, rng.uniform(0.2, 0.9, count)) * wide
        at = feet + np.column_stack([out * np.cos(angle), out * np.sin(angle), level])
        size, high = wide * rng.uniform(0.5, 0.9, count), (tall - base) / _NUM_TUFTS * rng.uniform(0.6, 1.1, count)
        softness = rng.uniform(0.7, 2.2, count)
        into.spheroids.extend(map(tuple, np.column_stack([at, size, size, high, zero, softness, zero])))


def plant_bushes(into: Collection, rng: np.random.Generator, feet: FloatArray) -> None:
    """Adds bushes, undergrowth and tall grass: one tuft each.

    Args:
        into: collection that gets the objects.
        rng: source of their shapes.
        feet: (n, 3) positions on the ground.
    """
    count = len(feet)
    radius, zero = rng.uniform(0.4, 1.7, count), np.zeros(count)
    high = rng.uniform(0.25, 0.9, count) * radius
    at = feet + np.column_stack([zero, zero, 0.6 * high])
    softness = rng.uniform(0.15, 0.7, count)
    into.spheroids.extend(map(tuple, np.column_stack([at, radius, radius, high, zero, softness, zero])))
