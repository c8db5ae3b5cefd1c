"""How good is a map, without knowing the truth? By how few nats all its beams can be written down.

The world is cut into cells. Each beam says of the cells that it passes "free" and of the one where it ends "occupied".
A cell that has heard the same from everybody costs next to nothing; one that has heard both, or that nobody else has
seen, costs nats (a Krichevsky-Trofimov code for each cell). Doubled walls cost twice: they contradict beams that pass
through them, and they open new cells. It is the occupancy loss of DeepMapping with the best possible M-Net.
"""

from __future__ import annotations

import numpy as np
import scipy.special
from numpy.typing import NDArray

from dpmjax.geometry import se2

# Hits and passages that are counted at most; more would only take longer.
_MAX_BEAMS = 40_000
_SAMPLES_A_BEAM = 32
_GRID_TURNS = (0.2, 0.5, 0.9, 1.3)
# Side of a cell in length scales: some thicknesses of a wall. Finer agreement is the business of `surface_misfit`.
_CELL = 0.1


def map_code_length(
    points: NDArray[np.floating], mask: NDArray[np.bool_], poses: NDArray[np.float64], *, scale: float
) -> float:
    """Nats a beam that the map of all scans needs at these poses; lower is better.

    Comparable among poses of one set of scans. How the walls lie in the cells must not decide, so the mean over turned
    grids is taken.

    Args:
        points: (n, b, 2) in the sensor frames.
        mask: (n, b).
        poses: (n, 3) x, y, heading.
        scale: `registration.length_scale` of the scans, unit of the points; the cells are parts of it.

    Returns:
        Code length divided by the number of beams.
    """
    world = se2.transform_points(poses, points)
    sensors = np.broadcast_to(poses[:, None, :2], world.shape)
    stride = max(1, int(np.ceil(mask.sum() / _MAX_BEAMS)))
    hits, sensors = world[mask][::stride], sensors[mask][::stride]
    return float(np.mean([_code_length(hits @ _turn(a), sensors @ _turn(a), _CELL * scale) for a in _GRID_TURNS]))


def _turn(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _code_length(hits: NDArray[np.float64], sensors: NDArray[np.float64], cell: float) -> float:
    """The same in one grid; hits and the sensors that made them, (m, 2) in the frame of the grid."""
    reach = np.linalg.norm(hits - sensors, axis=-1)
    # Passages stop two cells short of the hit, where a slanted wall may still be touched.
    share = (np.arange(_SAMPLES_A_BEAM) + 0.5) / _SAMPLES_A_BEAM
    passed = share * np.maximum(1.0 - 2.0 * cell / np.maximum(reach, 1e-9), 0.0)[:, None]
    free = (sensors[:, None] + passed[..., None] * (hits - sensors)[:, None]).reshape(-1, 2)
    # All samples lie between the sensors and the hits.
    low = np.minimum(hits.min(axis=0), sensors.min(axis=0))
    columns = int((max(hits[:, 1].max(), sensors[:, 1].max()) - low[1]) / cell) + 2

    def count(places: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        index = np.floor((places - low) / cell).astype(np.int64)
        return np.unique(index[:, 0] * columns + index[:, 1], return_counts=True)

    hit_cells, num_hits = count(hits)
    free_cells, num_free = count(free)
    place = np.minimum(np.searchsorted(free_cells, hit_cells), len(free_cells) - 1)
    passages = np.where(free_cells[place] == hit_cells, num_free[place], 0)
    # Only cells that were hit are coded: how much is seen free depends on the room, not on the poses.
    nats = np.log(np.pi) - scipy.special.betaln(num_hits + 0.5, passages + 0.5)
    return float(nats.sum() / len(hits))
