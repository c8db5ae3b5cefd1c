"""Heights of a driven trajectory that agree wherever it comes back: satellites leave metres between two passes."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from dpmjax.sequences import FloatArray
from dpmjax.simulation.town.streets import arc_lengths, resample

_NEAR_M = 6.0
_LEAST_WAY_M = 30.0
_NUM_NEAR = 64
_STEEPEST = 0.2
# Against the weight 1 of each step: places of two passes lie up to half a metre apart along the way.
_TIE_WEIGHT = 0.01


def with_equal_passes(positions: FloatArray) -> FloatArray:
    """Returns the trajectory with heights that are equal where it passes a place again; slopes change least.

    A sparse least-squares problem keeps the steps of height, and sets those between two passes to zero. Slopes are
    limited to 20 %, because the height of a receiver that stands still may drift by metres.

    Args:
        positions: (n, 3) m, in order, at least 1 m long.

    Returns:
        (m, 3) positions on the same way at steps of a metre.
    """
    positions = resample(positions, 1.0)
    count = len(positions)
    pairs = _passes(positions[:, :2], arc_lengths(positions))
    steps = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    ends = np.vstack([steps, pairs])
    weights = np.repeat([1.0, _TIE_WEIGHT], [len(steps), len(pairs)])
    climbs = np.clip(np.diff(positions[:, 2]), -_STEEPEST, _STEEPEST)
    wanted = np.concatenate([climbs, np.zeros(len(pairs))])
    rows = np.repeat(np.arange(len(ends)), 2)
    difference = sp.csr_array((np.tile([-1.0, 1.0], len(ends)), (rows, ends.ravel())), (len(ends), count))
    # The first height stays, so that the system has one solution.
    inner = difference[:, 1:]
    normal = (inner.T @ sp.diags_array(weights) @ inner).tocsc()
    change = spsolve(normal, inner.T @ (weights * (wanted - difference @ positions[:, 2])))
    heights = positions[:, 2] + np.concatenate([[0.0], np.atleast_1d(change)])
    return np.column_stack([positions[:, :2], heights])


def _passes(places: FloatArray, way: FloatArray) -> np.ndarray:
    """(m, 2) rows of each place and of the nearest one of another pass."""
    distances, rows = KDTree(places).query(places, min(_NUM_NEAR, len(places)), distance_upper_bound=_NEAR_M)
    is_found, rows = np.isfinite(distances), np.asarray(rows)
    is_other = is_found & (np.abs(way[np.where(is_found, rows, 0)] - way[:, None]) > _LEAST_WAY_M)
    has_other = is_other.any(axis=1)
    first = is_other.argmax(axis=1)
    return np.column_stack([np.flatnonzero(has_other), rows[has_other, first[has_other]]])
