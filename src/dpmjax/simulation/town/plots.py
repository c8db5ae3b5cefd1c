"""Who stands where: a raster of the ground that is taken, so that no house stands in a street or in another house."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dpmjax.simulation.town.terrain import CELL_M, Terrain


class Plots:
    """The ground that is taken. A builder's scratch pad: it lives while a town is made, and changes.

    Args:
        terrain: tells where the streets are.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._is_taken = np.zeros(terrain.heights.shape, bool)

    def claim(
        self,
        centre: NDArray[np.float64],
        half_size: tuple[float, float],
        heading: float,
        *,
        kerb_distance: float = 0.5,
        is_kept: bool = True,
    ) -> bool:
        """Takes a rectangle if all of it is free.

        Args:
            centre: (2,) m.
            half_size: along its own x and y, m.
            heading: of its x, radians.
            kerb_distance: no part may be nearer than this to a kerb, m; negative allows to stand on the street.
            is_kept: False only asks.

        Returns:
            Whether it was free.
        """
        cells = self._cells(centre, half_size, heading)
        if (cells < 0).any() or (cells >= np.array(self._is_taken.shape)[::-1]).any():
            return False
        at = (cells[:, 1], cells[:, 0])
        if self._is_taken[at].any() or (self.terrain.street_distance[at] < kerb_distance).any():
            return False
        if is_kept:
            self._is_taken[at] = True
        return True

    def _cells(self, centre: NDArray[np.float64], half_size: tuple[float, float], heading: float) -> NDArray[np.int64]:
        axes = [np.linspace(-half, half, max(int(np.ceil(2 * half / CELL_M)) + 1, 2)) for half in half_size]
        u, v = (grid.ravel() for grid in np.meshgrid(*axes))
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = centre[0] + cos * u - sin * v, centre[1] + sin * u + cos * v
        return np.round((np.column_stack([x, y]) - self.terrain.origin) / CELL_M).astype(np.int64)
