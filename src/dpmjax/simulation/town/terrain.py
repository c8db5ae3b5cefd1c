"""The ground of a town: slopes, cambered streets with kerbs, rough meadows; and which of it is built upon."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town.streets import Streets

CELL_M = 0.5
_MARGIN_M = 50.0
_TILE = 256
_KERB_M = 0.12
_PAVEMENT_M = 2.2


@dataclass(frozen=True)
class Terrain:
    """Ground heights and distances from the streets on one grid.

    Attributes:
        origin: (2,) x and y of entry [0, 0], m.
        heights: (h, w) z, m; the column follows x.
        street_distance: (h, w) from the nearest kerb, m; negative on a street.
    """

    origin: FloatArray
    heights: FloatArray = field(repr=False)
    street_distance: FloatArray = field(repr=False)

    def height_at(self, positions: FloatArray) -> FloatArray:
        """Ground heights (m,) at (m, 2) places, bilinear."""
        from scipy.ndimage import map_coordinates

        at = (np.atleast_2d(positions)[:, :2] - self.origin) / CELL_M
        return map_coordinates(self.heights, at[:, ::-1].T, order=1, mode="nearest")


def make_terrain(
    rng: np.random.Generator, streets: Streets, *, steepness: float, support: FloatArray | None = None
) -> Terrain:
    """Shapes the ground.

    Args:
        rng: source of all choices.
        streets: where the streets are.
        steepness: typical slope of the land, rise over run.
        support: (n, 3) points that the streets must go through, m; None lets the land roll at random.

    Returns:
        The terrain; its grid is a whole number of tiles of 128 m, so that kernels see few shapes.
    """
    lines = np.vstack(streets.paths)
    low = lines.min(0) - _MARGIN_M
    cells = np.ceil((lines.max(0) + _MARGIN_M - low) / CELL_M).astype(int)
    columns, rows = (int(-(-count // _TILE) * _TILE) for count in cells)
    distance = _street_distance(streets, low, (rows, columns))
    x, y = np.meshgrid(low[0] + CELL_M * np.arange(columns), low[1] + CELL_M * np.arange(rows))
    land = _rolling(rng, x, y, steepness) if support is None else _through(support, low, (rows, columns))
    return Terrain(low, land + _cross_section(distance) + _roughness(rng, distance), distance)


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
    """Millimetres on streets, centimetres and gentle mounds in gardens."""
    from scipy.ndimage import gaussian_filter

    fine = rng.normal(size=distance.shape)
    mounds = gaussian_filter(rng.normal(size=distance.shape), 8.0) * 28.0
    is_garden = np.clip((distance - _PAVEMENT_M) / 2.0, 0, 1)
    return (0.004 + 0.03 * is_garden) * fine + 0.12 * is_garden * mounds


class Plots:
    """The ground that is taken, so that no house stands in a street or in another house.

    It changes while a town is made.

    Args:
        terrain: ground heights and distances from the streets.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._is_taken = np.zeros(terrain.heights.shape, bool)

    def claim(
        self, centre: FloatArray, half_size: tuple[float, float], heading: float, *, kerb_distance: float = 0.5
    ) -> bool:
        """Takes a rectangle if all of it is free.

        Args:
            centre: (2,) m.
            half_size: along its own x and y, m.
            heading: of its x, radians.
            kerb_distance: no part may be nearer than this to a kerb, m; negative allows to stand on the street.

        Returns:
            Whether it was free.
        """
        cells = self._cells(centre, half_size, heading)
        if (cells < 0).any() or (cells >= np.array(self._is_taken.shape)[::-1]).any():
            return False
        at = (cells[:, 1], cells[:, 0])
        if self._is_taken[at].any() or (self.terrain.street_distance[at] < kerb_distance).any():
            return False
        self._is_taken[at] = True
        return True

    def _cells(self, centre: FloatArray, half_size: tuple[float, float], heading: float) -> NDArray[np.int64]:
        axes = [np.linspace(-half, half, max(int(np.ceil(2 * half / CELL_M)) + 1, 2)) for half in half_size]
        u, v = (grid.ravel() for grid in np.meshgrid(*axes))
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = centre[0] + cos * u - sin * v, centre[1] + sin * u + cos * v
        return np.round((np.column_stack([x, y]) - self.terrain.origin) / CELL_M).astype(np.int64)
