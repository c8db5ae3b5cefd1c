"""The point pyramid: the points that are kept from level to level, and their neighbours.

Farthest-point order and neighbourhoods depend on coordinates only, so they are built once and apart from the network,
which is a function of its parameters and of this. `build_pyramid` is for one cloud, under jit, vmap and on any device;
`build_pyramid_on_host` makes the same ten times faster on a CPU, by trees and buckets.
"""

from __future__ import annotations

from dataclasses import dataclass

import fpsample
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_mask, as_points, require_count, require_fields, require_positive, require_value
from dpmjax.geometry.neighbours import HostTree, k_nearest
from dpmjax.geometry.sampling import farthest_point_sample
from dpmjax.geometry.traced import LARGEST_COORDINATE, is_usable, typed_jit
from dpmjax.types import AnyArray, Interpolation, PointPyramid, PyramidLevel

# Relative slack of the radius: quantised points often lie exactly on it, and rounding must not decide.
RADIUS_SLACK = 1 + 1e-6

# Added to squared normalised distances before they are inverted; 1e-4 of the unit, 6 mm.
WEIGHT_EPSILON = 1e-8

BUCKET_TREE_HEIGHT = 6
MIN_BUCKETED_POINTS = 1 << (BUCKET_TREE_HEIGHT + 1)
TIED_ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class PyramidStage:
    """One step down the pyramid.

    Attributes:
        num_points: number of points that are kept, by farthest-point sampling.
        radii: radii of the neighbourhoods, normalised: the first block has neighbours in the level before, every later
            block in this level.
        num_neighbours: number of neighbours in each neighbourhood.
    """

    num_points: int
    radii: tuple[float, ...]
    num_neighbours: int

    def __post_init__(self) -> None:
        require_fields(self, "num_points", "num_neighbours", low=1)
        require_count("len(radii)", len(self.radii))
        for radius in self.radii:
            require_positive("radii", radius)


@dataclass(frozen=True)
class PyramidConfig:
    """The stages from fine to coarse (defaults: DeepPointMap's published configuration, radii in units of 60 m).

    Attributes:
        stages: the steps down.
        num_interpolations: number of steps up again, from the coarsest level.
    """

    stages: tuple[PyramidStage, ...] = (
        PyramidStage(4096, (0.05, 0.1), 32),
        PyramidStage(1024, (0.1, 0.2), 32),
        PyramidStage(256, (0.2, 0.4, 0.4), 32),
        PyramidStage(64, (0.4, 0.8), 32),
        PyramidStage(16, (0.8, 1.6), 16),
    )
    num_interpolations: int = 2

    def __post_init__(self) -> None:
        num, most = self.num_interpolations, len(self.stages) - 1
        require_value(0 <= num <= most, "num_interpolations", f"from 0 to {most}, fewer than there are stages", num)
        counts = [stage.num_points for stage in self.stages]
        is_falling = sorted(counts, reverse=True) == counts
        require_value(is_falling, "stages", "no stage to have more points than the one before", counts)


@typed_jit("config")
def build_pyramid(
    points: Float[AnyArray, "n 3"], mask: Bool[AnyArray, " n"] | None, config: PyramidConfig
) -> PointPyramid:
    """The pyramid of one cloud (DeepPointMap section 3.1; PointNeXt, Qian et al. 2022).

    Farthest-point sampling starts at the first valid point. Rows of a level beyond its points are masked, and their
    indices and weights are 0. Positions have a derivative, choices have none.

    Args:
        points: normalised coordinates, n >= 1.
        mask: False for missing points, which may hold anything. None: only points with a coordinate that is not a
            number from -1e15 to 1e15 are missing.
        config: sizes and radii; hashable, so that a second call with it compiles nothing.

    Returns:
        The levels from fine to coarse, and the interpolations from coarse to fine.

    Raises:
        ValueError: there are no points, or the shapes do not match.
    """
    points = as_points("points", points, dimensions=(3,))
    mask = as_mask("mask", mask, points.shape[:1]) & is_usable(points)
    points = jnp.where(mask[:, None], points, 0)
    levels = [PyramidLevel(points, mask, jnp.zeros(0, jnp.int32), ())]
    num_valid = jnp.sum(mask)
    for stage in config.stages:
        before = levels[-1]
        if len(levels) == 1:
            chosen = farthest_point_sample(points, stage.num_points, mask)
        else:
            # What is the farthest of all points is the farthest of the chosen ones: the order of the first stage holds.
            chosen = jnp.arange(stage.num_points, dtype=jnp.int32)
        is_there = jnp.arange(stage.num_points) < num_valid
        chosen = jnp.where(is_there, chosen, 0)
        positions = jnp.where(is_there[:, None], before.positions[chosen], 0)
        neighbours = _neighbours_of_stage(positions, is_there, before, stage)
        levels.append(PyramidLevel(positions, is_there, chosen, neighbours))
    steps = range(config.num_interpolations)
    return PointPyramid(tuple(levels), tuple(_interpolate(levels[-2 - step], levels[-1 - step]) for step in steps))


def _neighbours_of_stage(
    positions: Float[Array, "m 3"], mask: Bool[Array, " m"], before: PyramidLevel, stage: PyramidStage
) -> tuple[Int[Array, "m k"], ...]:
    searches = [k_nearest(positions, before.positions, stage.num_neighbours, before.mask)]
    if len(stage.radii) > 1:  # the later blocks all search this level
        searches.append(k_nearest(positions, positions, stage.num_neighbours, mask))
    blocks = []
    for block, radius in enumerate(stage.radii):
        near = searches[min(block, 1)]
        is_within = near.mask & (near.squared_distances <= (radius * RADIUS_SLACK) ** 2)
        indices = jnp.where(is_within, near.indices, near.indices[:, :1])
        blocks.append(jnp.where(mask[:, None], indices, 0))
    return tuple(blocks)


def interpolation_weights(squared: Float[Array, "m 3"], is_used: Bool[Array, "m 3"]) -> Float[Array, "m 3"]:
    """Computes the shares of the nearest points: their inverse squared distances, with sum one.

    Args:
        squared: squared normalised distances; anything where they are not used.
        is_used: False where there are fewer points.

    Returns:
        The shares; zero where they are not used.
    """
    inverse = jnp.where(is_used, 1 / (jnp.where(is_used, squared, 0) + WEIGHT_EPSILON), 0)
    total = jnp.sum(inverse, axis=1, keepdims=True)
    return inverse / jnp.where(total > 0, total, 1)


def _interpolate(fine: PyramidLevel, coarse: PyramidLevel) -> Interpolation:
    near = k_nearest(fine.positions, coarse.positions, 3, coarse.mask)
    is_used = near.mask & fine.mask[:, None]
    return Interpolation(jnp.where(is_used, near.indices, 0), interpolation_weights(near.squared_distances, is_used))


def build_pyramid_on_host(
    points: Float[np.ndarray, "n 3"],
    mask: Bool[np.ndarray, " n"] | None,
    config: PyramidConfig,
    *,
    num_threads: int = 2,
) -> PointPyramid:
    """Builds the pyramid of `build_pyramid` as arrays of NumPy; the two are the same up to rounding.

    Neighbours are measured in float64. So two points that are equally near up to the rounding of float32 may be
    swapped; points that coincide keep the order of the array in both builders.

    Args:
        points: normalised coordinates, n >= 1, float32.
        mask: False for missing points, which may hold anything. None: only points with a coordinate that is not a
            number from -1e15 to 1e15 are missing.
        config: sizes and radii.
        num_threads: number of threads of the neighbour search.

    Returns:
        The pyramid.

    Raises:
        ValueError: there are no points, the shapes do not match, or `num_threads` is below 1.
    """
    points = np.asarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"points: expected shape (n, 3) with n >= 1, got {points.shape}")
    require_count("num_threads", num_threads)
    mask = as_mask("mask", mask, points.shape[:1], np) & (np.abs(points) <= LARGEST_COORDINATE).all(axis=1)
    points = np.where(mask[:, None], points, np.float32(0))
    order = farthest_points_on_host(points, mask, config.stages[0].num_points).astype(np.int32)
    # Valid points stand in front on every level but the first, where `rows` says which they are.
    searched = [_Searchable(points[mask], np.flatnonzero(mask).astype(np.int32), num_threads)]
    levels = [PyramidLevel(points, mask, np.zeros(0, np.int32), ())]
    for stage in config.stages:
        sampled = points[order[: stage.num_points]]
        below, here = searched[-1], _Searchable(sampled, np.arange(len(sampled), dtype=np.int32), num_threads)
        found = [below.nearest(here.tree.points, stage.num_neighbours)]
        if len(stage.radii) > 1:
            found += [here.nearest(here.tree.points, stage.num_neighbours)] * (len(stage.radii) - 1)
        chosen = order[: stage.num_points] if len(levels) == 1 else here.rows
        levels.append(_level(sampled, chosen, found, stage))
        searched.append(here)
    steps = range(config.num_interpolations)
    up = [_interpolate_on_host(levels[-2 - step], searched[-2 - step], searched[-1 - step]) for step in steps]
    return PointPyramid(tuple(levels), tuple(up))


def farthest_points_on_host(
    points: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, " n"], num_samples: int
) -> Int[np.ndarray, " s"]:
    """The first min(num_samples, number of valid points) of `farthest_point_sample`.

    `preprocess_scan_on_host` puts the point farthest from the origin first. Then points are kept in buckets of a tree
    (QuickFPS, Han et al. 2023): four times faster, with the same result.

    Args:
        points: candidates.
        mask: False for points that are not there.
        num_samples: number of points to choose.

    Returns:
        Rows of the points.
    """
    rows = np.flatnonzero(mask)
    num_samples = min(num_samples, len(rows))
    chosen = _sample_by_buckets(points[rows], num_samples)
    if chosen is not None:
        return rows[chosen]
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        chosen = np.asarray(farthest_point_sample(points, max(num_samples, 1), mask))
    return chosen[:num_samples]


def _sample_by_buckets(points: Float[np.ndarray, "n 3"], num_samples: int) -> Int[np.ndarray, " s"] | None:
    """Returns the samples, starting at point 0; None where buckets cannot give them."""
    if len(points) < MIN_BUCKETED_POINTS or num_samples < 2:
        return None
    ranges = np.sqrt(np.sum(points.astype(np.float64) ** 2, axis=1))
    if ranges[0] < ranges.max() or ranges[0] == 0:
        return None
    # The package counts its start in the order of its own tree, where the outermost point of the negative side comes
    # first. So a far point is put opposite to point 0 (mirrored to the positive side: distances stay), sampling starts
    # there, and the next, the farthest from it, is point 0; the far point itself is then too far to matter.
    mirrored = points * np.where(points[0] < 0, np.float32(-1), np.float32(1))
    far = -8 * mirrored[:1]
    chosen = fpsample.bucket_fps_kdline_sampling(
        np.concatenate([far, mirrored]), num_samples + 1, h=BUCKET_TREE_HEIGHT, start_idx=0
    )
    chosen = np.asarray(chosen).astype(np.int64)
    is_right = chosen[0] == 0 and chosen[1] == 1 and np.bincount(chosen).max() == 1  # points that coincide may repeat
    return chosen[1:] - 1 if is_right else None


# Rows of the nearest points of each query, and their distances.
_Found = tuple[Int[np.ndarray, "m k"], Float[np.ndarray, "m k"]]


class _Searchable:
    """A tree of the valid points of a level, and the row of each in the padded level."""

    def __init__(self, points: Float[np.ndarray, "n 3"], rows: Int[np.ndarray, " n"], num_threads: int) -> None:
        self.tree = HostTree(points, num_threads=num_threads)
        self.rows = rows

    def nearest(self, queries: Float[np.ndarray, "m 3"], k: int) -> _Found:
        """Returns the min(k, n) nearest of each query, nearest first; of equally near ones the lower index first."""
        points = self.tree.points
        num_found = min(k, len(points))
        # One more neighbour shows whether the last one is tied with an excluded one.
        indices, distances = self.tree.nearest(queries, min(num_found + 1, len(points)) if num_found > 0 else 0)
        tied = np.flatnonzero(np.any(distances[:, 1:] == distances[:, :-1], axis=1))
        for start in range(0, len(tied), TIED_ROWS_AT_ONCE):
            rows = tied[start : start + TIED_ROWS_AT_ONCE]
            exact = np.sqrt(np.sum((queries[rows, None] - points) ** 2, axis=-1))
            indices[rows] = np.argsort(exact, axis=1, kind="stable")[:, : indices.shape[1]]
            distances[rows] = np.take_along_axis(exact, indices[rows], axis=1)
        return self.rows[indices[:, :num_found]], distances[:, :num_found]


def _level(
    points: Float[np.ndarray, "v 3"], chosen: Int[np.ndarray, " v"], searches: list[_Found], stage: PyramidStage
) -> PyramidLevel:
    num_rows, num_valid = stage.num_points, len(chosen)
    positions = _padded(points, num_rows)
    neighbours = [np.zeros((num_rows, stage.num_neighbours), np.int32) for _ in stage.radii]
    if num_valid > 0:
        for block, radius, (rows, distances) in zip(neighbours, stage.radii, searches, strict=True):
            block[:num_valid] = rows[:, :1]
            block[:num_valid, : rows.shape[1]] = np.where(distances <= radius * RADIUS_SLACK, rows, rows[:, :1])
    mask = np.arange(num_rows) < num_valid
    return PyramidLevel(positions, mask, _padded(chosen, num_rows), tuple(neighbours))


def _interpolate_on_host(fine_level: PyramidLevel, fine: _Searchable, coarse: _Searchable) -> Interpolation:
    num_rows = len(fine_level.mask)
    indices, weights = np.zeros((num_rows, 3), np.int32), np.zeros((num_rows, 3), np.float32)
    if len(coarse.rows) > 0:
        rows, distances = coarse.nearest(fine.tree.points, 3)
        inverse = 1 / (distances**2 + WEIGHT_EPSILON)
        indices[fine.rows, : rows.shape[1]] = rows
        weights[fine.rows, : rows.shape[1]] = inverse / inverse.sum(axis=1, keepdims=True)
    return Interpolation(indices, weights)


def _padded(rows: np.ndarray, num_rows: int) -> np.ndarray:
    result = np.zeros((num_rows, *rows.shape[1:]), rows.dtype)
    result[: len(rows)] = rows
    return result
