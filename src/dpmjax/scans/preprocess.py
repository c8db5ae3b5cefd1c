"""A raw scan made into a cloud of fixed capacity: near and far points, crowded ones and outliers left out.

Training and use share this one function (the authors' programs differ there). `preprocess_scan` is for one scan, under
jit, vmap and on any device; `preprocess_host.preprocess_scan_on_host` makes the same faster on a CPU.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_mask, as_points, require_count, require_positive
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.sampling import voxel_sample
from dpmjax.types import AnyArray, PointCloud

MAX_CAPACITY = 1 << 15
MAX_VOXELS = 1 << 20
OUTLIER_SLACK = 1 + 1e-5
"""Relative: where all points are equally far from their neighbours, rounding must not drop them."""


@dataclass(frozen=True)
class PreprocessConfig:
    """What is kept of a scan (the numbers of DeepPointMap's published configuration).

    Attributes:
        min_range_m: nearer points belong to the vehicle.
        max_range_m: farther points are too sparse.
        voxel_size_m: one point of each voxel is kept, the first.
        num_outlier_neighbours: how many neighbours a point is compared with; 0 keeps outliers.
        outlier_sigmas: a point whose mean distance to them exceeds the mean over all points by so many standard
            deviations is an outlier.
        capacity: of the result; of more points, evenly spaced ones are kept before outliers are looked for.
    """

    min_range_m: float = 1.0
    max_range_m: float = 60.0
    voxel_size_m: float = 0.3
    num_outlier_neighbours: int = 10
    outlier_sigmas: float = 3.0
    capacity: int = 16384

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m: expected from 0 to below {self.max_range_m}, got {self.min_range_m}")
        require_positive("voxel_size_m", self.voxel_size_m)
        require_positive("outlier_sigmas", self.outlier_sigmas)
        require_count("capacity", self.capacity)
        if self.num_outlier_neighbours < 0:
            raise ValueError(f"num_outlier_neighbours: expected at least 0, got {self.num_outlier_neighbours}")
        if self.capacity > MAX_CAPACITY:
            raise ValueError(f"capacity: expected at most {MAX_CAPACITY}, got {self.capacity}")
        if self.max_range_m / self.voxel_size_m >= MAX_VOXELS:
            raise ValueError(f"voxel_size_m: expected fewer than {MAX_VOXELS} voxels in max_range_m")


def preprocess_scan(
    points: Float[AnyArray, "n 3"], mask: Bool[AnyArray, " n"] | None, config: PreprocessConfig
) -> PointCloud:
    """Range, voxel and outlier filter (DeepPointMap, supplement), in this order.

    Range comes first, so that a voxel at the border keeps its first point inside. Points that are not finite are left
    out. The kept ones stand in front in their order, but for the one farthest from the sensor, which changes place with
    the first: so farthest-point sampling starts at the rim, whatever the order of the scan.

    Args:
        points: (n, 3), metres, in the frame of the lidar.
        mask: False for points that are not there. All are there for None.
        config: what is kept; hashable, so that a second call with it compiles nothing.

    Returns:
        Cloud (capacity, 3), metres, same frame; points that are not there are 0.

    Raises:
        ValueError: the shapes do not match.
    """
    points = as_points("points", points, dimensions=(3,))
    return _preprocess_scan(points, as_mask("mask", mask, points.shape[:1]), config=config)


@functools.partial(jax.jit, static_argnames="config")
def _preprocess_scan(points: jax.Array, mask: jax.Array, *, config: PreprocessConfig) -> PointCloud:
    squared_range = jnp.sum(lax.stop_gradient(points) ** 2, axis=1)
    is_within = (squared_range >= config.min_range_m**2) & (squared_range <= config.max_range_m**2)
    mask = mask & is_within  # False for what is not finite
    points = jnp.where(mask[:, None], points, 0)
    points, mask = _gather(points, voxel_sample(points, config.voxel_size_m, mask), config.capacity)
    if config.num_outlier_neighbours > 0:
        points, mask = _gather(points, _is_inlier(points, mask, config), config.capacity)
    return farthest_first(PointCloud(points, mask))


def farthest_first(cloud: PointCloud) -> PointCloud:
    """The same cloud, its first row exchanged with the valid point farthest from the origin."""
    points, mask = jnp.asarray(cloud.points), jnp.asarray(cloud.mask)
    squared_range = jnp.sum(jnp.where(mask[:, None], lax.stop_gradient(points), 0) ** 2, axis=1)
    farthest = jnp.argmax(jnp.where(mask, squared_range, -1))
    rows = jnp.arange(len(points)).at[0].set(farthest).at[farthest].set(0)
    return PointCloud(points[rows], mask[rows])


def _gather(points: Float[Array, "n 3"], is_kept: Bool[Array, " n"], capacity: int) -> tuple[Array, Array]:
    """The kept points in front, in their order; evenly spaced ones where there are too many; and a mask."""
    num_kept = jnp.sum(is_kept)
    rows = jnp.nonzero(is_kept, size=len(points), fill_value=0)[0]
    slots = jnp.arange(capacity)
    # floor(slot * num_kept / capacity) in two parts, so that no product overflows
    spaced = slots * (num_kept // capacity) + slots * (num_kept % capacity) // capacity
    ranks = jnp.where(num_kept > capacity, spaced, slots)
    mask = slots < num_kept
    chosen = rows[jnp.where(mask, ranks, 0)] if len(points) > 0 else jnp.zeros(capacity, int)
    gathered = points[chosen] if len(points) > 0 else jnp.zeros((capacity, 3), points.dtype)
    return jnp.where(mask[:, None], gathered, 0), mask


def _is_inlier(points: Float[Array, "n 3"], mask: Bool[Array, " n"], config: PreprocessConfig) -> Bool[Array, " n"]:
    points = lax.stop_gradient(points)
    # One more than asked for: each point is its own nearest neighbour.
    near = k_nearest(points, points, config.num_outlier_neighbours + 1, mask)
    others = near.mask[:, 1:]
    distances = jnp.sqrt(jnp.where(others, near.squared_distances[:, 1:], 0))
    spread = jnp.sum(distances, axis=1) / jnp.maximum(jnp.sum(others, axis=1), 1)
    spread = jnp.where(mask, spread, 0)
    num_points = jnp.maximum(jnp.sum(mask), 1)
    mean = jnp.sum(spread) / num_points
    variance = jnp.sum(jnp.where(mask, (spread - mean) ** 2, 0)) / num_points
    return mask & (spread <= (mean + config.outlier_sigmas * jnp.sqrt(variance)) * OUTLIER_SLACK)
