"""Objects along streets: both sides of each street, plot by plot, by the style of its quarter, and the land behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, zoom

from dpmjax.sequences import BoolArray, FloatArray
from dpmjax.simulation.town import objects
from dpmjax.simulation.town.kinds import Kind, Quarter
from dpmjax.simulation.town.objects import Collection, Place, Size, plant_bushes, plant_trees
from dpmjax.simulation.town.primitives import CELL_M
from dpmjax.simulation.town.streets import Streets, arc_lengths, at_way, tangents
from dpmjax.simulation.town.terrain import PAVEMENT_M, Plots

_FREE_M = 4.2  # Least distance of parked cars from the middle of a street.
_BORDERS = ("hedge", "wall", "fence")
_FARTHEST_M = 65.0  # Largest distance of plants from the nearest kerb.
_PATCH_M = 14.0


@dataclass(frozen=True)
class _Side:
    """One side of one street: its kerb-to-kerb geometry and the direction of "away from the street"."""

    path: FloatArray
    along: FloatArray
    length: float
    half_width: float
    quarter: Quarter
    kind: Kind
    plots: Plots

    def place(self, way: float, from_kerb: float) -> Place:
        """Returns a place beside the street, with the street to the right of its heading."""
        spot = at_way(np.column_stack([self.path, self.along]), np.array([way]))[0]
        heading = float(np.arctan2(spot[3], spot[2]))
        left = from_kerb + self.half_width
        x, y = spot[0] - np.sin(heading) * left, spot[1] + np.cos(heading) * left
        return Place(x, y, float(self.plots.terrain.height_at(np.array([[x, y]]))[0]), heading)


def furnish(rng: np.random.Generator, streets: Streets, plots: Plots, kind: Kind) -> Collection:
    """Builds all objects of the town.

    Args:
        rng: source of all choices.
        streets: lines and widths of the streets.
        plots: free ground; each new object occupies its part of it.
        kind: densities and sizes of the kind of place.

    Returns:
        The rows of primitives.
    """
    into = Collection()
    sides = []

    def draw() -> Quarter:
        return kind.quarters[rng.choice(len(kind.quarters), p=kind.shares)]

    for path, half_width in zip(streets.paths, streets.half_widths, strict=True):
        quarter = draw()
        for line in (path, path[::-1]):
            other = draw() if rng.random() < 0.25 else quarter
            sides.append(_Side(line, tangents(line), float(arc_lengths(line)[-1]), half_width, other, kind, plots))
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
    step = side.kind.verge_step
    for _ in range(rng.poisson(side.length / step) if step else 0):
        place = side.place(rng.uniform(0, side.length), rng.uniform(1.3, 5.0))
        if side.plots.claim(place, (0.8, 0.8), 0.9):
            _put_bush(into, rng, place)


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
    for _ in range(rng.poisson(side.length / 90.0)):
        place = side.place(rng.uniform(0, side.length), rng.uniform(0.6, 1.5))
        if side.plots.claim(place, (0.8, 0.6), 0.3):
            objects.put_sign(into, rng, place)


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
                objects.put_border(into, rng, border, width + gap - 0.4, str(rng.choice(_BORDERS)))
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
            from_kerb = max(-0.2, _FREE_M - side.half_width) + float(rng.normal(0, 0.12))
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
    for rate, put in ((40.0, objects.put_sign), (35.0, objects.put_person), (25.0, _put_cabinet)):
        for _ in range(rng.poisson(side.length / rate)):
            place = side.place(rng.uniform(0, side.length), rng.uniform(0.5, 1.9))
            if side.plots.claim(place, (0.8, 0.6), 0.0):
                put(into, rng, place)


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
    """Adds plants on the free land outside of streets and plots, in patches.

    Args:
        into: collection that gets the objects.
        rng: source of all choices.
        plots: free ground.
        kind: kind of place, with densities of plants.
    """
    is_wooded = _patches(rng, plots.terrain.heights.shape, kind.woodland)
    for density, clear in ((kind.trees_per_ha, 2.5), (kind.bushes_per_ha, 1.6)):
        places = _scatter(rng, plots, density, is_wooded)
        places = places[plots.are_free(places, clear)]
        if clear == 2.5:
            plant_trees(into, rng, _on_ground(plots, places), kind.tree_height, conifers=kind.conifers)
        else:
            plant_bushes(into, rng, _on_ground(plots, places))


def _patches(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> BoolArray:
    coarse = rng.normal(size=tuple(-(-size // 8) for size in shape))
    field = gaussian_filter(coarse, _PATCH_M / (8 * CELL_M))
    return zoom(field <= np.quantile(field, share), 8, order=0)[: shape[0], : shape[1]]


def _scatter(rng: np.random.Generator, plots: Plots, per_ha: float, is_wooded: BoolArray) -> FloatArray:
    """Draws positions (n, 2) in woods near streets."""
    terrain = plots.terrain
    size = CELL_M * (np.array(terrain.heights.shape)[::-1] - 1)
    places = rng.uniform(0, 1, (rng.poisson(per_ha * size.prod() / 1e4), 2)) * size
    column, row = np.round(places / CELL_M).astype(int).T
    return terrain.origin + places[is_wooded[row, column] & (terrain.street_distance[row, column] < _FARTHEST_M)]


def _on_ground(plots: Plots, places: FloatArray) -> FloatArray:
    return np.column_stack([places, plots.terrain.height_at(places)]) if len(places) else np.zeros((0, 3))
