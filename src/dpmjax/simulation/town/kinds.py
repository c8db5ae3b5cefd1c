"""Kinds of place: settings of streets, land, vegetation and traffic."""

from __future__ import annotations

from dataclasses import dataclass, field

# Lowest and highest value of a uniform draw.
Span = tuple[float, float]


@dataclass(frozen=True)
class Quarter:
    """Houses, gardens and trees along a street. Distances in metres.

    Attributes:
        setback: distance from the kerb to the house fronts.
        house_width: width along the street.
        house_depth: depth across the street.
        eaves: height of the houses.
        gap: distance between houses; below 1 they touch.
        house_rate: share of the plots with a house.
        border_rate: share of the plots with a hedge, wall or fence along the pavement.
        parked_rate: share of the parking places with a car.
        garden_trees: mean number of trees on a plot.
        street_tree_step: distance of trees on the pavement; 0 for none.
        garden_bushes: mean number of bushes on a plot.
        car_park_rate: share of the free plots with a car park.
    """

    setback: Span
    house_width: Span
    house_depth: Span
    eaves: Span
    gap: Span
    house_rate: float
    border_rate: float
    parked_rate: float
    garden_trees: float
    street_tree_step: float
    garden_bushes: float
    car_park_rate: float = 0.0


@dataclass(frozen=True)
class Kind:
    """Streets, land and traffic of a kind of place.

    Attributes:
        quarters: kinds of its streets.
        shares: shares of the quarters.
        half_width: half width of the streets, from the middle to the kerb, m.
        steepness: typical slope of the land, rise over run.
        roughness: roughness of the ground beside streets; 1 is a lawn.
        trees_per_ha: density of trees in woods, outside of plots.
        bushes_per_ha: density of undergrowth and tall grass there.
        woodland: share of the free land that is wooded.
        tree_height: lowest and highest tree, m.
        conifers: share of conifers among the trees.
        verge_step: mean distance of bushes along the kerb, m; 0 for none.
        cars_per_km: number of cars on a kilometre of each lane.
        trucks: share of trucks in the traffic.
        queues_per_km: number of rows of slow cars.
        bridges_per_km: number of bridges over the streets.
        has_pavement: True for pavements with people, lamps and signs.
    """

    quarters: tuple[Quarter, ...] = field(repr=False)
    shares: tuple[float, ...] = (1.0,)
    half_width: Span = (4.6, 5.6)
    steepness: Span = (0.008, 0.02)
    roughness: float = 1.0
    trees_per_ha: float = 60.0
    bushes_per_ha: float = 60.0
    woodland: float = 0.35
    tree_height: Span = (5.0, 13.0)
    conifers: float = 0.2
    verge_step: float = 0.0
    cars_per_km: float = 10.0
    trucks: float = 0.06
    queues_per_km: float = 0.5
    bridges_per_km: float = 0.0
    has_pavement: bool = True


_DETACHED = Quarter((4.0, 8.5), (8, 14), (8, 12), (4.5, 8), (2, 8), 0.92, 0.85, 0.6, 1.6, 0.0, 2.5)
_ROWS = Quarter((3.2, 5.5), (7, 14), (9, 13), (7, 14), (0, 1.6), 0.95, 0.3, 0.75, 0.2, 14.0, 0.5)
_PARK = Quarter((8.0, 20.0), (6, 12), (6, 10), (3, 6), (10, 30), 0.35, 0.6, 0.25, 4.0, 10.0, 3.5)
_WORKSHOPS = Quarter((5.0, 14.0), (18, 40), (14, 28), (5, 15), (6, 18), 0.85, 0.4, 0.3, 0.8, 0.0, 0.8, 0.7)
_TOWERS = Quarter((3.5, 8.0), (18, 40), (15, 25), (15, 55), (0, 6), 0.93, 0.05, 0.6, 0.0, 12.0, 0.2)
_OFFICES = Quarter((6.0, 16.0), (25, 60), (14, 24), (9, 24), (8, 30), 0.85, 0.2, 0.3, 2.0, 15.0, 1.5, 0.5)
_FARMS = Quarter((8.0, 25.0), (10, 22), (8, 14), (4, 8), (25, 90), 0.3, 0.45, 0.05, 2.5, 0.0, 3.5)
_MARKETS = Quarter((16.0, 40.0), (30, 60), (20, 40), (6, 12), (15, 50), 0.45, 0.25, 0.3, 0.8, 18.0, 1.0, 1.0)
_MEADOW = Quarter((20.0, 40.0), (8, 20), (8, 14), (4, 8), (90, 200), 0.12, 0.15, 0.02, 0.2, 0.0, 0.3)
_FOREST = Quarter((10.0, 20.0), (7, 12), (6, 10), (3, 6), (60, 150), 0.15, 0.1, 0.03, 2.0, 0.0, 2.0)

# Kinds of place by name.
KINDS: dict[str, Kind] = {
    "suburb": Kind(
        (_DETACHED, _ROWS, _PARK, _WORKSHOPS), (0.46, 0.26, 0.20, 0.08),
        roughness=1.5, trees_per_ha=170.0, bushes_per_ha=220.0, woodland=0.5, verge_step=11.0,
    ),
    "canyon": Kind(
        (_TOWERS, _OFFICES, _PARK), (0.65, 0.25, 0.10), half_width=(6.5, 11.0), steepness=(0.003, 0.012),
        cars_per_km=22.0, trucks=0.12, queues_per_km=3.0, bridges_per_km=0.6,
    ),
    "country": Kind(
        (_FARMS,), half_width=(3.0, 4.2), steepness=(0.02, 0.05), roughness=2.2,
        trees_per_ha=220.0, bushes_per_ha=260.0, woodland=0.4, tree_height=(5.0, 16.0), conifers=0.35, verge_step=6.0,
        cars_per_km=5.0, trucks=0.15, queues_per_km=0.0, bridges_per_km=0.4, has_pavement=False,
    ),
    "car_park": Kind((_MARKETS, _WORKSHOPS), (0.75, 0.25), half_width=(4.5, 7.0), queues_per_km=1.0, verge_step=14.0),
    "campus": Kind(
        (_OFFICES, _PARK), (0.75, 0.25), half_width=(2.6, 4.5),
        trees_per_ha=120.0, woodland=0.5, cars_per_km=4.0, verge_step=25.0,
    ),
    "wood": Kind(
        (_FOREST,), half_width=(2.6, 4.0), steepness=(0.02, 0.07), roughness=2.0,
        trees_per_ha=330.0, bushes_per_ha=330.0, woodland=0.9, tree_height=(6.0, 18.0), conifers=0.5, verge_step=4.0,
        cars_per_km=2.0, queues_per_km=0.0, has_pavement=False,
    ),
    "field": Kind(
        (_MEADOW,), half_width=(2.6, 4.0), steepness=(0.005, 0.03), roughness=2.5,
        trees_per_ha=6.0, bushes_per_ha=12.0, woodland=0.08, verge_step=30.0,
        cars_per_km=2.0, queues_per_km=0.0, has_pavement=False,
    ),
    "jam": Kind(
        (_MARKETS, _FARMS, _TOWERS), (0.4, 0.3, 0.3), half_width=(6.5, 9.0), steepness=(0.003, 0.012),
        trees_per_ha=30.0, bushes_per_ha=30.0, cars_per_km=25.0, trucks=0.2, queues_per_km=14.0, bridges_per_km=0.4,
    ),
}  # fmt: skip
