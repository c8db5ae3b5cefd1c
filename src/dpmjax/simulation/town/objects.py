"""Objects of a town as rows of primitives: houses, cars, trees, hedges, poles, people.

Every builder gets a place on the ground and a heading (the street's direction; the street lies to the object's right)
and appends rows to a `Collection`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_SUNK_M = 1.0  # Houses and walls reach below the ground, which may slope.
Size = tuple[float, float]


@dataclass
class Collection:
    """Rows of primitives while a town is made.

    Attributes:
        boxes: x y z, half sizes, heading, softness, window depth.
        cylinders: the same of the boxes round them.
        spheroids: the same.
    """

    boxes: list[tuple[float, ...]] = field(default_factory=list)
    cylinders: list[tuple[float, ...]] = field(default_factory=list)
    spheroids: list[tuple[float, ...]] = field(default_factory=list)


@dataclass(frozen=True)
class Place:
    """A place on the ground.

    Attributes:
        x: m.
        y: m.
        ground: height of the ground, m.
        heading: direction of the object's x, radians.
    """

    x: float
    y: float
    ground: float
    heading: float

    def move(self, along: float, left: float) -> Place:
        """The place so many metres ahead and to the left."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return Place(self.x + cos * along - sin * left, self.y + sin * along + cos * left, self.ground, self.heading)


def put_box(
    into: Collection, place: Place, size: Size, levels: Size, *, softness: float = 0.0, window_depth: float = 0.0
) -> None:
    """Adds an upright box.

    Args:
        into: where to.
        place: its middle.
        size: length along and across the heading, m.
        levels: lowest and highest point above the ground, m.
        softness: m.
        window_depth: m.
    """
    low, high = levels
    centre = (place.x, place.y, place.ground + 0.5 * (low + high))
    into.boxes.append((*centre, size[0] / 2, size[1] / 2, 0.5 * (high - low), place.heading, softness, window_depth))


def put_house(
    into: Collection, rng: np.random.Generator, place: Place, size: Size, height: float, *, is_plain: bool
) -> None:
    """A house: body with windows, stepped roof, and bays, steps and balconies towards the street.

    Args:
        into: where to.
        rng: source of all choices.
        place: middle of the body; the street lies to the right of its heading.
        size: along and across the street, m.
        height: of the eaves, m.
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
    """A parked car or van: body, cabin, a gap below.

    Args:
        into: where to.
        rng: source of its size.
        place: its middle.
    """
    if rng.random() < 0.12:
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
    """An upright cylinder that stands on the ground.

    Args:
        into: where to.
        place: its foot.
        radius: m.
        height: m.
    """
    centre = (place.x, place.y, place.ground + 0.5 * height - 0.1)
    into.cylinders.append((*centre, radius, radius, 0.5 * height + 0.1, 0.0, 0.0, 0.0))


def _put_tuft(
    into: Collection, place: Place, level: float, radius: float, half_height: float, softness: float = 0.0
) -> None:
    """A spheroid with its centre `level` above the ground, m."""
    size = (radius, radius, half_height)
    into.spheroids.append((place.x, place.y, place.ground + level, *size, 0.0, softness, 0.0))


def put_sign(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """A post with a plate across the street's direction.

    Args:
        into: where to.
        rng: source of its size.
        place: its foot.
    """
    height, plate = rng.uniform(2.2, 2.8), rng.uniform(0.5, 0.9)
    put_pole(into, place, 0.04, float(height))
    put_box(into, place, (0.04, float(plate)), (float(height - plate), float(height)))


def put_tree(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """A trunk and a crown of tufts, no two alike.

    Args:
        into: where to.
        rng: source of its shape.
        place: its foot.
    """
    trunk, radius = rng.uniform(1.6, 3.2), rng.uniform(1.0, 2.4)
    put_pole(into, place, float(rng.uniform(0.09, 0.28)), float(trunk + radius))
    for _ in range(rng.integers(4, 8)):
        along, left = rng.normal(0.0, 0.5 * radius, 2)
        at = place.move(float(along), float(left))
        size = radius * rng.uniform(0.45, 0.8)
        level = trunk + radius + rng.uniform(-0.5, 0.7) * radius
        _put_tuft(into, at, level, size, size * rng.uniform(0.7, 1.1), float(rng.uniform(0.3, 1.0)))


def put_bush(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """Two or three tufts on the ground.

    Args:
        into: where to.
        rng: source of its shape.
        place: its foot.
    """
    for _ in range(rng.integers(2, 4)):
        along, left = rng.normal(0.0, 0.5, 2)
        at, size = place.move(float(along), float(left)), rng.uniform(0.4, 1.1)
        _put_tuft(into, at, 0.6 * size, size, 0.9 * size, float(rng.uniform(0.1, 0.35)))


def put_border(into: Collection, rng: np.random.Generator, place: Place, length: float, kind: str) -> None:
    """A hedge, wall or fence along the street, in pieces, with an open gate.

    Args:
        into: where to.
        rng: source of its shape.
        place: its middle.
        length: m.
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
    """A standing person: a body and a head.

    Args:
        into: where to.
        rng: source of the height.
        place: where.
    """
    height = rng.uniform(1.5, 1.9)
    put_pole(into, place, 0.22, height - 0.25)
    _put_tuft(into, place, height - 0.12, 0.11, 0.14)
