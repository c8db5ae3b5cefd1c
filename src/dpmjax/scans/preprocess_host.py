"""Preprocessing on the host: what `preprocess_scan` makes, faster on a CPU, by a sort and a tree."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.checks import require_count
from dpmjax.scans.preprocess import MAX_VOXELS, OUTLIER_SLACK, PreprocessConfig
from dpmjax.types import PointCloud


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
    kept = points[_is_within(points, config) if mask is None else _is_within(points, config) & mask]
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
    voxels = np.floor(points / np.float32(voxel_size)).astype(np.int64) + MAX_VOXELS
    bits = (2 * MAX_VOXELS - 1).bit_length()
    packed = (voxels[:, 0] << (2 * bits)) | (voxels[:, 1] << bits) | voxels[:, 2]
    return np.sort(np.unique(packed, return_index=True)[1])


def _evenly_spaced(num_kept: int, capacity: int) -> Int[np.ndarray, " r"]:
    slots = np.arange(min(num_kept, capacity))
    return slots * num_kept // capacity if num_kept > capacity else slots


def _is_inlier(points: Float[np.ndarray, "n 3"], config: PreprocessConfig, num_threads: int) -> Bool[np.ndarray, " n"]:
    tree = cKDTree(points, leafsize=16)
    num_asked = min(config.num_outlier_neighbours + 1, len(points))
    distances = np.asarray(tree.query(points, [*range(2, num_asked + 1)], workers=num_threads)[0])
    spread = distances.mean(axis=1)
    return spread <= (spread.mean() + config.outlier_sigmas * spread.std()) * OUTLIER_SLACK
