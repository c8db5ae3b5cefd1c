"""Preprocessing turns a raw scan into a masked cloud: it filters by range, by voxel and by outlier distance.

Training and inference share it. An outlier is a point whose neighbours are far, compared with those of others. The
limit rests on all points, but neighbours are searched only for lonely points and for a sample. This takes a fifth of
the time; the result is the same up to a percent of the limit.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from dpmjax.checks import as_host_points, as_mask, require_count, require_fields, require_positive_fields
from dpmjax.geometry.neighbours import HostTree
from dpmjax.types import PointCloud

MAX_CAPACITY = 1 << 15
MAX_VOXELS = 1 << 20
# At least two slots a point, in a table of 2 MB at most: a fortieth of the voxels of a large scan share a slot. The
# factor spreads them (Knuth).
HASH_FACTOR, TABLE_BITS = np.uint64(0x9E3779B97F4A7C15), 18

MIN_COUNT_TO_WARN, MIN_SHARE_IN_RANGE = 20, 0.01

# A point is an outlier if its mean distance to its neighbours exceeds the mean over all points by more than this number
# of standard deviations.
OUTLIER_SIGMAS = 3.0

# Number of points whose neighbours are searched first, to estimate the limit: all points of a smaller scan. With fewer,
# more points must be searched again.
NUM_SPACED = 1024


@dataclass(frozen=True)
class PreprocessConfig:
    """Settings of the filters (the values are those of DeepPointMap's published configuration).

    Attributes:
        min_range_m: smallest range; nearer points belong to the vehicle.
        max_range_m: largest range; farther points are too sparse.
        voxel_size_m: side of a voxel, of which the first point is kept.
        num_outlier_neighbours: number of neighbours in the outlier test; 0 switches the test off.
        capacity: capacity of the resulting cloud. Where more points are left, evenly spaced ones are kept before the
            outlier test.
    """

    min_range_m: float = 1.0
    max_range_m: float = 60.0
    voxel_size_m: float = 0.3
    num_outlier_neighbours: int = 10
    capacity: int = 16384

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m: expected from 0 to below {self.max_range_m}, got {self.min_range_m}")
        require_positive_fields(self, "voxel_size_m")
        require_fields(self, "capacity", low=1, high=MAX_CAPACITY)
        require_fields(self, "num_outlier_neighbours", low=0)
        if self.max_range_m / self.voxel_size_m >= MAX_VOXELS:
            raise ValueError(f"voxel_size_m: expected fewer than {MAX_VOXELS} voxels in max_range_m")


def farthest_first(cloud: PointCloud) -> PointCloud:
    """Exchanges the first row with the valid point farthest from the origin.

    Args:
        cloud: any masked cloud.

    Returns:
        The same points in the new order.
    """
    points, mask = jnp.asarray(cloud.points), jnp.asarray(cloud.mask)
    squared_range = jnp.sum(jnp.where(mask[:, None], lax.stop_gradient(points), 0) ** 2, axis=1)
    farthest = jnp.argmax(jnp.where(mask, squared_range, -1))
    rows = jnp.arange(len(points)).at[0].set(farthest).at[farthest].set(0)
    return PointCloud(points[rows], mask[rows])


def preprocess_scan_on_host(
    points: Float[np.ndarray, "n 3"],
    mask: Bool[np.ndarray, " n"] | None,
    config: PreprocessConfig,
    *,
    num_threads: int = 2,
) -> PointCloud:
    """Applies the range, voxel and outlier filters, in this order (DeepPointMap, supplement).

    Points that are not finite are dropped. The kept points stand in front, in their order, except that the point
    farthest from the sensor is exchanged with the first. Farthest-point sampling then starts at the rim for any order
    of the scan. Warns where hardly any point is in range: the points are then probably not in metres.

    Args:
        points: (n, 3), metres, in the frame of the lidar, float32.
        mask: False for points that are not there; None if all are.
        config: settings of the filters.
        num_threads: threads of the neighbour search, at least 1.

    Returns:
        A cloud (capacity, 3) of NumPy arrays, metres, same frame; 0 where the mask is False.

    Raises:
        ValueError: if the shapes do not match.
    """
    return cloud_without_outliers(thin_points(points, mask, config, num_threads=num_threads), config)


def thin_points(
    points: Float[np.ndarray, "n 3"],
    mask: Bool[np.ndarray, " n"] | None,
    config: PreprocessConfig,
    *,
    num_threads: int = 2,
) -> HostTree:
    """Applies the range and voxel filters of `preprocess_scan_on_host`.

    Args:
        points: see `preprocess_scan_on_host`.
        mask: see `preprocess_scan_on_host`.
        config: settings of the filters.
        num_threads: threads of the neighbour search, at least 1.

    Returns:
        A tree of up to `config.capacity` remaining points, in their order.

    Raises:
        ValueError: if the shapes do not match.
    """
    points = as_host_points("points", points).astype(np.float32, copy=False)
    mask = as_mask("mask", mask, points.shape[:1], np)
    require_count("num_threads", num_threads)
    is_kept = _is_within(points, config) & mask
    _warn_if_out_of_range(points, mask, int(is_kept.sum()), config)
    kept = points.take(np.flatnonzero(is_kept), axis=0)  # four times faster than by the mask
    kept = kept[first_of_each_voxel(kept, config.voxel_size_m)]
    return HostTree(kept[evenly_spaced(len(kept), config.capacity)], num_threads=num_threads)


def cloud_without_outliers(tree: HostTree, config: PreprocessConfig) -> PointCloud:
    """Applies the outlier filter of `preprocess_scan_on_host`.

    Args:
        tree: points from `thin_points`.
        config: number of neighbours, capacity.

    Returns:
        A cloud (capacity, 3), arrays of NumPy; the farthest point is exchanged with the first.
    """
    rows = np.arange(len(tree.points))
    if config.num_outlier_neighbours > 0 and len(rows) > 1:
        rows = np.flatnonzero(find_inliers(tree, config.num_outlier_neighbours))
    if len(rows):
        farthest = int(np.argmax(np.square(tree.points.take(rows, axis=0)).sum(axis=1)))
        rows[[0, farthest]] = rows[[farthest, 0]]
    result = np.zeros((config.capacity, 3), np.float32)
    result[: len(rows)] = tree.points.take(rows, axis=0)
    return PointCloud(result, np.arange(config.capacity) < len(rows))


def _is_within(points: Float[np.ndarray, "n 3"], config: PreprocessConfig) -> Bool[np.ndarray, " n"]:
    x, y, z = points.T
    with np.errstate(invalid="ignore", over="ignore"):
        squared_range = x * x + y * y + z * z
        return (squared_range >= config.min_range_m**2) & (squared_range <= config.max_range_m**2)


def _warn_if_out_of_range(
    points: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, " n"], num_in_range: int, config: PreprocessConfig
) -> None:
    if num_in_range >= max(1, MIN_SHARE_IN_RANGE * len(points)):
        return
    is_there = np.isfinite(points).all(axis=1) & mask
    if is_there.sum() >= MIN_COUNT_TO_WARN and num_in_range < MIN_SHARE_IN_RANGE * is_there.sum():
        # The same text each time, so that Python shows it once.
        limits = f"{config.min_range_m:g} to {config.max_range_m:g} m"
        warnings.warn(f"hardly any point of the scan is {limits} from the lidar: is it in metres?", stacklevel=3)


def first_of_each_voxel(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int[np.ndarray, " v"]:
    """Selects the first point of each voxel, on the host.

    Args:
        points: finite, metres.
        voxel_size: side of a voxel, metres.

    Returns:
        Rows of the points, in order.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    voxels = _numbered_voxels(points, voxel_size)
    # Each slot of a table keeps its first row: several times faster than sorting. A few voxels share their slot.
    num_bits = min(TABLE_BITS, 1 + len(points).bit_length())
    slots = (voxels.astype(np.uint64) * HASH_FACTOR >> np.uint64(64 - num_bits)).astype(np.intp)
    rows = np.arange(len(points))
    table = np.full(1 << num_bits, len(points))
    np.minimum.at(table, slots, rows)
    in_slot = table[slots]
    is_first = in_slot == rows
    others = np.flatnonzero(voxels[in_slot] != voxels)
    is_first[others[np.unique(voxels[others], return_index=True)[1]]] = True
    return np.flatnonzero(is_first)


def _numbered_voxels(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int[np.ndarray, " n"]:
    """Returns a number for the voxel of each point, ascending by x, then y, then z."""
    x, y, z = (np.floor(column / np.float32(voxel_size)).astype(np.int64) for column in points.T)
    x, y, z = x - x.min(), y - y.min(), z - z.min()
    return (x * (y.max() + 1) + y) * (z.max() + 1) + z  # below 2^63, because MAX_VOXELS bounds each factor


def evenly_spaced(num_kept: int, capacity: int) -> Int[np.ndarray, " r"]:
    """Returns rows of up to `capacity` of this many points.

    Args:
        num_kept: number of points.
        capacity: largest number of rows.

    Returns:
        The rows, in order.
    """
    slots = np.arange(min(num_kept, capacity))
    return slots * num_kept // capacity if num_kept > capacity else slots


def find_inliers(tree: HostTree, num_neighbours: int) -> Bool[np.ndarray, " k"]:
    """Finds the points whose mean distance to their neighbours is not above the limit.

    Args:
        tree: the points, two or more.
        num_neighbours: number of neighbours.

    Returns:
        True for inliers.
    """
    points, rows = tree.points, evenly_spaced(len(tree.points), NUM_SPACED)
    # One more neighbour, because each point is its own nearest one.
    num_nearest = min(num_neighbours + 1, len(points))

    def measure(rows: Int[np.ndarray, " r"]) -> None:
        spread[rows] = tree.nearest(points.take(rows, axis=0), num_nearest)[1][:, 1:].mean(axis=1)

    spread, weights = np.zeros(len(points)), np.zeros(len(points))
    measure(rows)
    weights[rows] = 1
    if len(rows) < len(points):
        is_lonely = _is_lonely(points, (spread[rows].mean() + OUTLIER_SIGMAS * spread[rows].std()) / 2, num_neighbours)
        measure(np.flatnonzero(is_lonely & (weights == 0)))
        # The points that are not lonely are counted as often as there are such: no spread of theirs is large.
        weights = np.where(is_lonely, 1, weights * (~is_lonely).sum() / max(weights[~is_lonely].sum(), 1))
    return spread <= largest_spread(spread, weights)


def largest_spread(spread: Float[np.ndarray, " k"], weights: Float[np.ndarray, " k"]) -> float:
    """Computes the largest mean distance of an inlier to its neighbours.

    Args:
        spread: mean distances of some points to their neighbours.
        weights: number of points of the scan that each of them stands for.

    Returns:
        The limit, in the unit of the distances.
    """
    mean = np.average(spread, weights=weights)
    # Relative tolerance: rounding must not drop points that are all equally far from their neighbours.
    return float(mean + OUTLIER_SIGMAS * np.sqrt(np.average((spread - mean) ** 2, weights=weights))) * (1 + 1e-5)


def _is_lonely(points: Float[np.ndarray, "n 3"], cell_m: float, num_neighbours: int) -> Bool[np.ndarray, " n"]:
    """Returns True for points with at most this many others in the 27 cells around; all, where there are many cells."""
    columns = np.ascontiguousarray(points.T)
    columns -= columns.min(axis=1, keepdims=True)
    columns /= max(cell_m, 1e-9)
    shape = columns.max(axis=1) + 3
    # Cells of half the limit; where more would be needed, the neighbours of all points are searched.
    if shape.prod() > (1 << 22):
        return np.ones(len(points), bool)
    x, y, z = columns.astype(np.int64) + 1  # the border is empty
    across = int(shape[1]), int(shape[2])
    rows = (x * across[0] + y) * across[1] + z
    counts = np.bincount(rows, minlength=int(shape[0]) * across[0] * across[1])
    occupied, near = np.flatnonzero(counts), (-1, 0, 1)
    steps = [(i * across[0] + j) * across[1] + k for i in near for j in near for k in near]
    counts[occupied] = sum(counts.take(occupied + step) for step in steps)
    return counts.take(rows) <= num_neighbours
