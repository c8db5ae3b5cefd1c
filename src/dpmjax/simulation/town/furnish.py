"""Furnishes streets: both sides of each, plot by plot, in the manner of its quarter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town import objects
from dpmjax.simulation.town.objects import Collection, Place, Size
from dpmjax.simulation.town.primitives import CELL_M, Terrain
from dpmjax.simulation.town.streets import Streets, arc_lengths, at_way, tangents


@dataclass(frozen=True)
class Quarter:
    """What a street looks like. Ranges are (low, high); distances in metres.

    Attributes:
        setback: from the kerb to the house fronts.
        house_width: along the street.
        house_depth: across it.
        eaves: height of the houses.
        gap: between houses; below 1 they touch.
        house_rate: part of the plots that has a house.
        border_rate: part of the plots with a hedge, wall or fence along the pavement.
        parked_rate: part of the parking places that is taken.
        garden_trees: mean number of trees on a plot.
        street_tree_step: distance of trees on the pavement; 0 for none.
        garden_bushes: mean number of bushes on a plot.
    """

    setback: tuple[float, float]
    house_width: tuple[float, float]
    house_depth: tuple[float, float]
    eaves: tuple[float, float]
    gap: tuple[float, float]
    house_rate: float
    border_rate: float
    parked_rate: float
    garden_trees: float
    street_tree_step: float
    garden_bushes: float


QUARTERS = (
    # Detached houses behind gardens.
    Quarter((4.5, 10.0), (8, 14), (8, 12), (4.5, 8), (2, 8), 0.92, 0.75, 0.45, 0.9, 0.0, 1.5),
    # Rows of town houses.
    Quarter((3.2, 5.5), (7, 14), (9, 13), (7, 14), (0, 1.6), 0.95, 0.3, 0.75, 0.1, 14.0, 0.3),
    # A park or an allotment.
    Quarter((8.0, 20.0), (6, 12), (6, 10), (3, 6), (10, 30), 0.35, 0.6, 0.25, 3.0, 10.0, 2.5),
    # Workshops and markets.
    Quarter((5.0, 14.0), (18, 40), (14, 28), (5, 15), (6, 18), 0.9, 0.4, 0.3, 0.6, 0.0, 0.6),
)
_QUARTER_SHARES = (0.42, 0.32, 0.12, 0.14)
_PAVEMENT_M = 2.2
_BORDERS = ("hedge", "wall", "fence")


class Plots:
    """The ground that is taken, so that no house stands in a street or in another house.

    It changes while a town is made.

    Args:
        terrain: ground heights and distances from the streets.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._is_taken = np.zeros(terrain.heights.shape, bool)

    def claim(self, place: Place, size: Size, kerb_distance: float) -> bool:
        """Takes a rectangle if all of it is free.

        Args:
            place: its middle.
            size: along and across its heading, m.
            kerb_distance: no part may be nearer than this to a kerb, m; negative allows to stand on the street.

        Returns:
            Whether it was free.
        """
        cells = self._cells(place, size)
        if (cells < 0).any() or (cells >= np.array(self._is_taken.shape)[::-1]).any():
            return False
        at = (cells[:, 1], cells[:, 0])
        if self._is_taken[at].any() or (self.terrain.street_distance[at] < kerb_distance).any():
            return False
        self._is_taken[at] = True
        return True

    def _cells(self, place: Place, size: Size) -> NDArray[np.int64]:
        axes = [np.linspace(-0.5 * side, 0.5 * side, max(int(np.ceil(side / CELL_M)) + 1, 2)) for side in size]
        u, v = (grid.ravel() for grid in np.meshgrid(*axes))
        cos, sin = np.cos(place.heading), np.sin(place.heading)
        x, y = place.x + cos * u - sin * v, place.y + sin * u + cos * v
        return np.round((np.column_stack([x, y]) - self.terrain.origin) / CELL_M).astype(np.int64)


@dataclass(frozen=True)
class _Side:
    """One side of one street: its kerb-to-kerb geometry and the direction of "away from the street"."""

    path: FloatArray
    along: FloatArray
    length: float
    half_width: float
    quarter: Quarter
    plots: Plots

    def place(self, way: float, from_kerb: float) -> Place:
        """The place beside the street; the street lies to the right of its heading."""
        spot = at_way(np.column_stack([self.path, self.along]), np.array([way]))[0]
        heading = float(np.arctan2(spot[3], spot[2]))
        left = from_kerb + self.half_width
        x, y = spot[0] - np.sin(heading) * left, spot[1] + np.cos(heading) * left
        return Place(x, y, float(self.plots.terrain.height_at(np.array([[x, y]]))[0]), heading)


def furnish(rng: np.random.Generator, streets: Streets, plots: Plots) -> Collection:
    """Builds everything that stands in the town.

    Args:
        rng: source of all choices.
        streets: where the streets are.
        plots: the ground that is free; taken from as it is built upon.

    Returns:
        The rows of primitives.
    """
    into = Collection()
    sides = []
    for path, half_width in zip(streets.paths, streets.half_widths, strict=True):
        quarter = QUARTERS[rng.choice(len(QUARTERS), p=_QUARTER_SHARES)]
        for line in (path, path[::-1]):
            other = QUARTERS[rng.choice(len(QUARTERS), p=_QUARTER_SHARES)] if rng.random() < 0.25 else quarter
            sides.append(_Side(line, tangents(line), float(arc_lengths(line)[-1]), half_width, other, plots))
    for step in (_houses, _kerbside, _pavement, _second_row):
        for side in sides:
            step(into, rng, side)
    return into


def _houses(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """The first row: houses with their gardens, fronts in line but for some decimetres, unless the gardens differ."""
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
        has_house = is_built and side.plots.claim(place, (width - 0.6, depth), _PAVEMENT_M + 0.6)
        if has_house:
            height = float(rng.uniform(*quarter.eaves))
            objects.put_house(into, rng, place, (width, depth), height, is_plain=setback < 3.6)
            if gap > 4 and rng.random() < 0.5:
                garage = side.place(way + width + 0.5 * gap, setback + 4.0)
                if side.plots.claim(garage, (3.0, 5.5), _PAVEMENT_M + 0.6):
                    objects.put_box(into, garage, (3.0, 5.5), (-1.0, 2.6), window_depth=0.1)
        if setback > _PAVEMENT_M + 1.4 and rng.random() < quarter.border_rate:
            border = side.place(middle + 0.5 * gap, _PAVEMENT_M + 0.4)
            if side.plots.claim(border, (width + gap - 1.0, 0.4), _PAVEMENT_M - 0.4):
                objects.put_border(into, rng, border, width + gap - 0.4, str(rng.choice(_BORDERS)))
        _garden(into, rng, side, (way, width + gap), setback if has_house else setback + depth)
        way += width + gap


def _garden(into: Collection, rng: np.random.Generator, side: _Side, plot: Size, front: float) -> None:
    """Trees and bushes between the pavement and the house."""
    (way, width), quarter = plot, side.quarter
    if front < _PAVEMENT_M + 2.0:
        return
    for mean, put, size in (
        (quarter.garden_trees, objects.put_tree, 0.8),
        (quarter.garden_bushes, objects.put_bush, 1.4),
    ):
        for _ in range(rng.poisson(mean)):
            place = side.place(way + rng.uniform(0, width), rng.uniform(_PAVEMENT_M + 1.0, front - 0.8))
            if side.plots.claim(place, (size, size), _PAVEMENT_M + 0.4):
                put(into, rng, place)


def _kerbside(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Parked cars, half on the kerb, heading as the traffic on that side does, with gaps and drives left free."""
    way, rate = float(rng.uniform(3, 9)), side.quarter.parked_rate * rng.uniform(0.4, 1.3)
    while way < side.length - 3:
        if rng.random() < rate:
            place = side.place(way, -0.2 + float(rng.normal(0, 0.12)))
            turned = Place(place.x, place.y, place.ground - 0.06, place.heading + np.pi + float(rng.normal(0, 0.02)))
            if side.plots.claim(turned, (4.8, 1.7), -1.6):
                objects.put_car(into, rng, turned)
        way += rng.uniform(5.3, 7.5)


def _pavement(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """Lamps, signs, boxes, trees and people on the pavement."""
    step = side.quarter.street_tree_step
    trees = np.arange(rng.uniform(2, 10), side.length, step) if step else np.zeros(0)
    lamps = np.arange(rng.uniform(4, 24), side.length, rng.uniform(22, 36))
    for way in trees:
        place = side.place(float(way) + rng.normal(0, 0.4), 1.2)
        if rng.random() < 0.75 and side.plots.claim(place, (0.6, 0.6), 0.3):
            objects.put_tree(into, rng, place)
    for way in lamps:
        place = side.place(float(way), 0.6)
        if side.plots.claim(place, (0.4, 0.4), 0.0):
            objects.put_pole(into, place, float(rng.uniform(0.06, 0.12)), float(rng.uniform(4.5, 8.0)))
    for rate, put in ((40.0, objects.put_sign), (35.0, objects.put_person), (25.0, _put_cabinet)):
        for _ in range(rng.poisson(side.length / rate)):
            place = side.place(rng.uniform(0, side.length), rng.uniform(0.5, 1.9))
            if side.plots.claim(place, (0.8, 0.6), 0.0):
                put(into, rng, place)


def _put_cabinet(into: Collection, rng: np.random.Generator, place: Place) -> None:
    """A switch cabinet, a bin or a bench."""
    size = (float(rng.uniform(0.5, 1.5)), float(rng.uniform(0.35, 0.7)))
    objects.put_box(into, place, size, (-0.1, float(rng.uniform(0.7, 1.3))))


def _second_row(into: Collection, rng: np.random.Generator, side: _Side) -> None:
    """What is seen through the gaps: houses and trees behind the first row."""
    way = float(rng.uniform(0, 15))
    while way < side.length:
        width, depth = rng.uniform(8, 20), rng.uniform(7, 12)
        place = side.place(way + 0.5 * width, rng.uniform(22, 34) + 0.5 * depth)
        if rng.random() < 0.7 and side.plots.claim(place, (width, depth), 4.0):
            objects.put_house(into, rng, place, (width, depth), float(rng.uniform(3, 12)), is_plain=True)
        for _ in range(rng.poisson(1.2)):
            tree = side.place(way + rng.uniform(0, width), rng.uniform(14, 40))
            if side.plots.claim(tree, (1.5, 1.5), 3.0):
                objects.put_tree(into, rng, tree)
        way += width + rng.uniform(3, 15)
