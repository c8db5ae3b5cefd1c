"""The ground of a town: heights, equal at revisits of a trajectory, distances from streets, and occupied plots."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from dpmjax.sequences import BoolArray, FloatArray
from dpmjax.simulation.town.kinds import Kind
from dpmjax.simulation.town.objects import Place, Size
from dpmjax.simulation.town.primitives import CELL_M
from dpmjax.simulation.town.streets import Streets, arc_lengths, resample

PAVEMENT_M = 2.2
_MARGIN_M = 70.0
_TILE = 256
# Largest distance of two passes of a place, least path length between them, and number of neighbours searched.
_STEEPEST = 0.2


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
        """Interpolates ground heights (m,) at (m, 2) positions, bilinearly."""
        at = (np.atleast_2d(positions)[:, :2] - self.origin) / CELL_M
        return map_coordinates(self.heights, at[:, ::-1].T, order=1, mode="nearest")


def make_terrain(rng: np.random.Generator, streets: Streets, support: FloatArray | None, kind: Kind) -> Terrain:
    """Makes the ground.

    Args:
        rng: source of all choices.
        streets: streets of the town.
        support: (n, 3) points that the streets must go through, m; None: random hills.
        kind: kind of place, with steepness and roughness of the land.

    Returns:
        The terrain; its grid is a whole number of tiles of 128 m, so that kernels see few shapes.
    """
    lines = np.vstack(streets.paths)
    low = lines.min(0) - _MARGIN_M
    cells = np.ceil((lines.max(0) + _MARGIN_M - low) / CELL_M).astype(int)
    columns, rows = (int(-(-count // _TILE) * _TILE) for count in cells)
    distance = _street_distance(streets, low, (rows, columns))
    x, y = np.meshgrid(low[0] + CELL_M * np.arange(columns), low[1] + CELL_M * np.arange(rows))
    if support is None:
        land = _rolling(rng, x, y, rng.uniform(*kind.steepness))
    else:
        land = _through(support, low, (rows, columns))
    return Terrain(low, land + _cross_section(distance) + kind.roughness * _roughness(rng, distance), distance)


def _street_distance(streets: Streets, origin: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Computes the distance from the nearest kerb, with the width of each street."""
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
    """Interpolates land through given points by inverse distances on a coarse grid, smoothed and resampled."""
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
    """Computes the profile of a cambered street, a kerb, a pavement, and gardens a little higher."""
    camber = 0.02 * np.clip(-distance, 0, 5)
    kerb = 0.12 * np.clip((distance + 0.25) / 0.5, 0, 1)
    return camber + kerb + 0.15 * np.clip((distance - PAVEMENT_M) / 2.0, 0, 1)


def _roughness(rng: np.random.Generator, distance: FloatArray) -> FloatArray:
    """Draws roughness: a centimetre on streets, several centimetres and gentle mounds beside them."""
    fine = rng.normal(size=distance.shape)
    mounds = gaussian_filter(rng.normal(size=distance.shape), 8.0) * 28.0
    is_garden = np.clip((distance - PAVEMENT_M) / 2.0, 0, 1)
    return (0.01 + 0.05 * is_garden) * fine + 0.12 * is_garden * mounds


class Plots:
    """The occupied ground.

    It changes while a town is made.

    Args:
        terrain: ground heights and distances from the streets.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._is_taken = np.zeros(terrain.heights.shape, bool)

    def claim(self, place: Place, size: Size, kerb_distance: float) -> bool:
        """Occupies a rectangle if it is free.

        Args:
            place: its middle.
            size: length along and across its heading, m.
            kerb_distance: least distance of all parts from a kerb, m; negative: the object may stand on the street.

        Returns:
            True if it was free.
        """
        cells = self._cells(place, size)
        if (cells < 0).any() or (cells >= np.array(self._is_taken.shape)[::-1]).any():
            return False
        at = (cells[:, 1], cells[:, 0])
        if self._is_taken[at].any() or (self.terrain.street_distance[at] < kerb_distance).any():
            return False
        self._is_taken[at] = True
        return True

    def are_free(self, positions: FloatArray, kerb_distance: float) -> BoolArray:
        """Finds the free positions.

        Args:
            positions: (n, 2) x and y, m, on the terrain.
            kerb_distance: least distance from a kerb, m.

        Returns:
            (n,) True where free.
        """
        cells = np.round((positions - self.terrain.origin) / CELL_M).astype(np.int64)
        cells = np.clip(cells, 0, np.array(self._is_taken.shape)[::-1] - 1)
        at = (cells[:, 1], cells[:, 0])
        return ~self._is_taken[at] & (self.terrain.street_distance[at] >= kerb_distance)

    def _cells(self, place: Place, size: Size) -> NDArray[np.int64]:
        axes = [np.linspace(-0.5 * side, 0.5 * side, max(int(np.ceil(side / CELL_M)) + 1, 2)) for side in size]
        u, v = (grid.ravel() for grid in np.meshgrid(*axes))
        cos, sin = np.cos(place.heading), np.sin(place.heading)
        x, y = place.x + cos * u - sin * v, place.y + sin * u + cos * v
        return np.round((np.column_stack([x, y]) - self.terrain.origin) / CELL_M).astype(np.int64)


def with_equal_passes(positions: FloatArray) -> FloatArray:
    """Returns the trajectory with equal heights at revisits of a place, at the least change of slopes.

    A sparse least-squares problem keeps the steps of height, and sets those between two passes to zero. Slopes are
    limited to 20 %, because the height of a stationary receiver may drift by metres.

    Args:
        positions: (n, 3) m, in order, at least 1 m long.

    Returns:
        (m, 3) positions on the same path at steps of a metre.
    """
    positions = resample(positions, 1.0)
    count = len(positions)
    pairs = _passes(positions[:, :2], arc_lengths(positions))
    steps = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    ends = np.vstack([steps, pairs])
    # Two passes lie up to half a metre apart along the path, so their ties are weak.
    weights = np.repeat([1.0, 0.01], [len(steps), len(pairs)])
    climbs = np.clip(np.diff(positions[:, 2]), -_STEEPEST, _STEEPEST)
    wanted = np.concatenate([climbs, np.zeros(len(pairs))])
    rows = np.repeat(np.arange(len(ends)), 2)
    difference = sp.csr_array((np.tile([-1.0, 1.0], len(ends)), (rows, ends.ravel())), (len(ends), count))
    # The first height is fixed, so that the system has one solution.
    inner = difference[:, 1:]
    normal = (inner.T @ sp.diags_array(weights) @ inner).tocsc()
    change = spsolve(normal, inner.T @ (weights * (wanted - difference @ positions[:, 2])))
    heights = positions[:, 2] + np.concatenate([[0.0], np.atleast_1d(change)])
    return np.column_stack([positions[:, :2], heights])


def _passes(places: FloatArray, way: FloatArray) -> np.ndarray:
    """Returns rows (m, 2) of each revisited position and of the nearest position of another pass."""
    distances, rows = KDTree(places).query(places, min(64, len(places)), distance_upper_bound=6.0)
    is_found, rows = np.isfinite(distances), np.asarray(rows)
    is_other = is_found & (np.abs(way[np.where(is_found, rows, 0)] - way[:, None]) > 30.0)
    has_other = is_other.any(axis=1)
    first = is_other.argmax(axis=1)
    return np.column_stack([np.flatnonzero(has_other), rows[has_other, first[has_other]]])
