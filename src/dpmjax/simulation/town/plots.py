"""The ground that is taken, so that nothing stands in a street or in something else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpmjax.sequences import BoolArray, FloatArray
from dpmjax.simulation.town.objects import Place, Size
from dpmjax.simulation.town.primitives import CELL_M, Terrain


class Plots:
    """The ground that is taken.

    It changes while a town is made.

    Args:
        terrain: ground heights and distances from the streets.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._is_taken = np.zeros(terrain.heights.shape, bool)

    def claim(self, place: Place, size: Size, kerb_distance: float) -> bool:
        """Takes a rectangle if it is free.

        Args:
            place: its middle.
            size: along and across its heading, m.
            kerb_distance: no part may be nearer than this to a kerb, m; negative allows to stand on the street.

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
        """Finds the free places.

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
