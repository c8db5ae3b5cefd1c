"""Preprocessing on the host: what `preprocess_scan` makes, faster on a CPU, by a table and a tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.checks import require_count
from dpmjax.scans.preprocess import OUTLIER_SLACK, PreprocessConfig
from dpmjax.types import PointCloud

MAX_TABLE_ENTRIES = 1 << 24
"""Voxels of a scan's bounding box that a table may hold; a scan of 60 m and 0.3 m has 6 million."""


def preprocess_scan_on_host(
    points: Float[np.ndarray, "n 3"],
    mask: Bool[np.ndarray, " n"] | None,
    config: PreprocessConfig,
    *,
    num_threads: int = 2,
) -> PointCloud:
    """What `preprocess_scan` returns, as arrays of NumPy; up to rounding of distances at the outlier threshold.

    Args:
        points: (n, 3), metres, in the frame of the lidar, float32.
        mask: False for points that are not there. All are there for None.
        config: what is kept.
        num_threads: of the neighbour search.

    Raises:
        ValueError: the shapes do not match, or `num_threads` is below 1.
    """
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape (n, 3), got {points.shape}")
    if mask is not None and (np.shape(mask) != points.shape[:1] or np.asarray(mask).dtype != bool):
        raise ValueError(f"mask: expected bool of shape {points.shape[:1]}, got {np.shape(mask)}")
    require_count("num_threads", num_threads)
    is_kept = _is_within(points, config) if mask is None else _is_within(points, config) & mask
    kept = points.take(np.flatnonzero(is_kept), axis=0)  # four times faster than by the mask
    kept = kept[_first_of_each_voxel(kept, config.voxel_size_m)]
    kept = kept[_evenly_spaced(len(kept), config.capacity)]
    if config.num_outlier_neighbours > 0 and len(kept) > 1:
        kept = kept[_is_inlier(kept, config, num_threads)]
    result = np.zeros((config.capacity, 3), np.float32)
    result[: len(kept)] = kept
    if len(kept) > 0:
        farthest = int(np.argmax(np.sum(kept.astype(np.float64) ** 2, axis=1)))
        result[[0, farthest]] = result[[farthest, 0]]
    return PointCloud(result, np.arange(config.capacity) < len(kept))


def _is_within(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Bool[np.ndarray, " n"]:
    x, y, z = points.T
    with np.errstate(invalid="ignore", over="ignore"):
        squared_range = x * x + y * y + z * z
        return (squared_range >= config.min_range_m**2) & (squared_range <= config.max_range_m**2)


def _first_of_each_voxel(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int[np.ndarray, " v"]:
    rows = np.arange(len(points))
    if len(points) == 0:
        return rows
    voxels = np.floor(points / np.float32(voxel_size)).astype(np.int64)
    columns = [column - column.min() for column in voxels.T]
    num_x, num_y, num_z = (int(column.max()) + 1 for column in columns)
    packed = (columns[0] * num_y + columns[1]) * num_z + columns[2]  # below 2^63: MAX_VOXELS bounds each
    if num_x * num_y * num_z > MAX_TABLE_ENTRIES:
        return np.sort(np.unique(packed, return_index=True)[1])
    # Only entries that are written are read. Of several rows in one entry the last written stays: the first of all.
    table = np.empty(num_x * num_y * num_z, np.int32)
    table[packed[::-1]] = rows[::-1]
    return np.flatnonzero(table[packed] == rows)


def _evenly_spaced(num_kept: int, capacity: int) -> Int[np.ndarray, " r"]:
    slots = np.arange(min(num_kept, capacity))
    return slots * num_kept // capacity if num_kept > capacity else slots


def _is_inlier(points: Float[np.ndarray, "n 3"], config: PreprocessConfig, num_threads: int) -> Bool[np.ndarray, " n"]:
    tree = cKDTree(points, leafsize=16, balanced_tree=False)
    num_asked = min(config.num_outlier_neighbours + 1, len(points))
    # Asked in the order of the tree, what a query needs is still in the cache.
    queries = tree.data[tree.indices]
    distances = np.asarray(tree.query(queries, [*range(2, num_asked + 1)], workers=num_threads)[0])
    spread = np.empty(len(points))
    spread[tree.indices] = distances.mean(axis=1)
    return spread <= (spread.mean() + config.outlier_sigmas * spread.std()) * OUTLIER_SLACK
