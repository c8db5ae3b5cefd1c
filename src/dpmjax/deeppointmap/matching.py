"""Matching estimates the motion between two descriptor clouds: best pairs, their offsets, alignment of the inliers.

A map is the union of descriptor clouds (`merge_clouds`), so scans and maps are matched alike.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.checks import as_float, require_fields, require_positive_fields, require_shape
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import weighted_svd
from dpmjax.geometry.bearing import directions_of, turned_directions
from dpmjax.geometry.consensus import INLIER_M, ConsensusConfig, find_consensus, motion_support
from dpmjax.geometry.rigid import safe_sqrt
from dpmjax.geometry.traced import typed_jit
from dpmjax.types import AnyArray, DescriptorCloud, Registration

# Pairs with longer offsets are dropped.
MAX_OFFSET_M = 2.0

# The confidence is the mean score of this many first inliers.
NUM_CONFIDENT = 30

# An inlier's error is at most the mean plus this many standard deviations of the inliers before.
INLIER_SIGMAS = 3.0

# Least number of first inliers; if fewer pairs have high enough scores, this number of the best pairs is taken.
MIN_NUM_FIRST = 64

# Pairs with higher scores are the first inliers.
MIN_INLIER_SCORE = 0.5

# A choice of fewer inliers is rejected (published configuration).
MIN_NUM_INLIERS = 30

# Largest number of pairs per direction for a consensus. More pairs do not make a motion more exact, and its cost is
# cubic.
MAX_NUM_PAIRS = 512

# Maps rows of the source and of the target to the offsets of eq. 1 (source frame) and eq. 2 (target frame), metres.
PredictOffsets = Callable[[Int[Array, " k"], Int[Array, " k"]], tuple[Float[Array, "k 3"], Float[Array, "k 3"]]]


# Relative tolerance: rounding must not drop pairs whose errors are all equal.
ERROR_SLACK = 1 + 1e-5

# Temperature of the softmaxes over descriptors, in matching and in training (DeepPointMap's published configuration).
TEMPERATURE = 0.1

# A rigid motion needs three distinct points on both sides.
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class MatchConfig:
    """Choice of pairs and of inliers (defaults: DeepPointMap's published configuration).

    Attributes:
        pair_ratio: number of pairs per direction, as a share of the mean size of the two clouds.
        num_rounds: number of times that the inliers are chosen again.
        consensus: if given, the first inliers are the pairs that support one common motion. This tolerates many wrong
            pairs, as from networks with little training or in repetitive places.
    """

    pair_ratio: float = 0.5
    num_rounds: int = 3
    consensus: ConsensusConfig | None = None

    def __post_init__(self) -> None:
        require_positive_fields(self, "pair_ratio")
        require_fields(self, "num_rounds", low=1)
        require_fields(self, "pair_ratio", low=0, high=4)


def match_hypotheses(
    source: DescriptorCloud,
    target: DescriptorCloud,
    similarity: Float[AnyArray, "m n"],
    predict_offsets: PredictOffsets,
    *,
    config: MatchConfig,
) -> Registration:
    """Estimates the best distinct motions between two descriptor clouds (DeepPointMap section 3.2, eq. 1 to 3).

    The pairs with the highest products of both softmaxes of the similarity count twice: as T (p + offset) = q and as
    T p = q + offset. A weighted SVD over both sets solves eq. 3 with the scores as weights; then the
    inliers are chosen again by their errors, in rounds. The number of pairs depends on the number of valid descriptors,
    so padded clouds give the same result as unpadded ones.

    Use `vmap` for several pairs of clouds.

    Args:
        source: descriptors in the source frame, metres; positions and mask are read; masked ones may be anything.
        target: the same in the target frame.
        similarity: cosine of each pair of descriptors, in [-1, 1].
        predict_offsets: the offset head on pairs of rows; it is called once, with static shapes.
        config: thresholds; without `consensus` there is one motion.

    Returns:
        The motions, their scores and pairs, with a leading axis h, best support first. Where there are fewer motions,
        `support` is 0.
    """
    best = best_pairs(jnp.asarray(similarity), source.mask, target.mask, config=config)
    points = source.positions[best.source_indices], target.positions[best.target_indices]
    return _align(*points, predict_offsets(best.source_indices, best.target_indices), best, config=config)


class BestPairs(NamedTuple):
    """The best pairs of two clouds, best first.

    Attributes:
        source_indices: row of each pair in the source.
        target_indices: row of each pair in the target.
        scores: product of both softmaxes, in [0, 1]; 0 where `mask` is False.
        mask: False where there are fewer pairs.
    """

    source_indices: Int[Array, " k"]
    target_indices: Int[Array, " k"]
    scores: Float[Array, " k"]
    mask: Bool[Array, " k"]


def dual_softmax(similarity: Float[Array, "m n"], is_pair: Bool[Array, "m n"]) -> Float[Array, "m n"]:
    """Computes the product of the softmaxes over rows and over columns.

    Published program of DeepPointMap; section 3.2 ranks by the cosine itself.

    Args:
        similarity: cosine of each pair of descriptors.
        is_pair: False for pairs that are not there.

    Returns:
        In [0, 1]; 0 for pairs that are not there.
    """
    logits = jnp.where(is_pair, similarity / TEMPERATURE, jnp.finfo(similarity.dtype).min)
    return jnp.where(is_pair, jax.nn.softmax(logits, axis=1) * jax.nn.softmax(logits, axis=0), 0)


@functools.partial(jax.jit, static_argnames="config")
def best_pairs(
    similarity: Float[Array, "m n"],
    source_mask: Bool[Array, " m"],
    target_mask: Bool[Array, " n"],
    *,
    config: MatchConfig,
) -> BestPairs:
    """Selects the pairs with the highest dual softmax; a descriptor may be in several pairs.

    Args:
        similarity: cosine of each pair of descriptors.
        source_mask: False for descriptors that are not there.
        target_mask: the same.
        config: number of pairs.

    Returns:
        The pairs, best first.
    """
    num_source, num_target = similarity.shape
    # floor(floor(ratio * (m + n)) / 2): the count of the published configuration.
    # In float32, as the number of valid pairs below: padding must not change it.
    wanted = int(np.float32(config.pair_ratio) * np.float32(num_source + num_target)) // 2
    capacity = min(wanted, num_source * num_target)
    if config.consensus is not None:
        capacity = min(capacity, MAX_NUM_PAIRS)
    is_pair = source_mask[:, None] & target_mask[None, :]
    scores = dual_softmax(similarity, is_pair)
    scores, flat = lax.top_k(jnp.where(is_pair, scores, -1).ravel(), capacity)
    num_valid = jnp.sum(source_mask) + jnp.sum(target_mask)
    num_pairs = jnp.floor(config.pair_ratio * num_valid).astype(int) // 2
    mask = (jnp.arange(capacity) < num_pairs) & (scores >= 0)
    rows, columns = flat // max(num_target, 1), flat % max(num_target, 1)
    return BestPairs(jnp.where(mask, rows, 0), jnp.where(mask, columns, 0), jnp.where(mask, scores, 0), mask)


@functools.partial(jax.jit, static_argnames="config")
def _align(
    source_points: Float[Array, "k 3"],
    target_points: Float[Array, "k 3"],
    both_offsets: tuple[Float[Array, "k 3"], Float[Array, "k 3"]],
    pairs: BestPairs,
    *,
    config: MatchConfig,
) -> Registration:
    # Weighted SVD with rounds of inliers over both directions of the pairs (DeepPointMap eq. 3).
    is_used = jnp.tile(pairs.mask, 2) & (jnp.sum(jnp.concatenate(both_offsets) ** 2, axis=1) <= MAX_OFFSET_M**2)
    # Metres keep the type of the points, whatever type the heads compute in.
    of_source, of_target = (offsets.astype(source_points.dtype) for offsets in both_offsets)
    source = jnp.concatenate([source_points + of_source, source_points])
    target = jnp.concatenate([target_points, target_points + of_target])
    source, target = (jnp.where(is_used[:, None], points, 0) for points in (source, target))
    scores = jnp.tile(pairs.scores, 2)
    both = _PointPairs(source, target, scores, is_used)
    rows = jnp.tile(pairs.source_indices, 2), jnp.tile(pairs.target_indices, 2)

    def solve(first: Bool[Array, " p"]) -> Registration:
        is_inlier = _choose_inliers(both, first, config)
        T_target_source, errors = _solve(both, is_inlier)
        num_inliers = jnp.sum(is_inlier)
        squared = jnp.sum(jnp.where(is_inlier, errors**2, 0)) / jnp.maximum(num_inliers, 1)
        is_determined = jnp.minimum(*(_num_distinct(some, is_inlier) for some in rows)) >= MIN_NUM_POINTS
        is_scored = is_inlier & (jnp.cumsum(is_inlier) <= NUM_CONFIDENT)
        mean_score = jnp.sum(jnp.where(is_scored, scores, 0)) / jnp.maximum(jnp.sum(is_scored), 1)
        half = slice(len(source_points))
        support = motion_support(T_target_source, source[half], target[half], is_inlier[half])
        return Registration(
            T_target_source=T_target_source,
            confidence=mean_score,
            mean_score=mean_score,
            rmse=jnp.where(is_determined, safe_sqrt(squared), jnp.inf),
            support=support,
            num_inliers=num_inliers,
            source_indices=rows[0],
            target_indices=rows[1],
            scores=jnp.where(is_used, scores, 0),
            is_inlier=is_inlier,
        )

    return jax.vmap(solve)(_first_inliers(both, config))


def _num_distinct(rows: Int[Array, " p"], mask: Bool[Array, " p"]) -> Int[Array, ""]:
    ordered = jnp.sort(jnp.where(mask, rows, -1))
    return jnp.sum(jnp.diff(ordered, prepend=-1) > 0)


class _PointPairs(NamedTuple):
    # Pairs of points of both directions, offsets added.
    source: Float[Array, "p 3"]
    target: Float[Array, "p 3"]
    scores: Float[Array, " p"]
    is_used: Bool[Array, " p"]


def _first_inliers(pairs: _PointPairs, config: MatchConfig) -> Bool[Array, "h p"]:
    """Returns the first inliers of each hypothesis: pairs of the best scores, or those that support its motion."""
    source, target, scores, is_used = lax.stop_gradient(pairs)
    if config.consensus is None:
        ranks = jnp.argsort(jnp.argsort(jnp.where(is_used, -scores, jnp.inf)))
        return (is_used & ((scores > MIN_INLIER_SCORE) | (ranks < MIN_NUM_FIRST)))[None]
    # The consensus is found in the first direction alone, at a quarter of the work, and then applied to both.
    half = len(source) // 2
    consensus = find_consensus(source[:half], target[:half], is_used[:half], config=config.consensus)
    moved = jax.vmap(lambda T: rigid.transform_points(T, source))(consensus.T_target_source)
    is_near = jnp.sum((moved - target) ** 2, axis=2) < INLIER_M**2
    is_motion = (consensus.support > 0).at[0].set(True)
    return is_used & is_near & is_motion[:, None]


def _choose_inliers(pairs: _PointPairs, first: Bool[Array, " p"], config: MatchConfig) -> Bool[Array, " p"]:
    # The choice has no derivative.
    pairs = lax.stop_gradient(pairs)

    def choose(_: Int[Array, ""], is_inlier: Bool[Array, " p"]) -> Bool[Array, " p"]:
        _, errors = _solve(pairs, is_inlier)
        spread = jnp.std(errors, where=is_inlier)
        limit = (jnp.mean(errors, where=is_inlier) + INLIER_SIGMAS * spread) * ERROR_SLACK
        chosen = pairs.is_used & (errors <= limit)  # none without an inlier, where the limit is NaN
        return jnp.where(jnp.sum(chosen) >= MIN_NUM_INLIERS, chosen, is_inlier)

    return lax.fori_loop(0, config.num_rounds, choose, first)


def _solve(pairs: _PointPairs, is_inlier: Bool[Array, " p"]) -> tuple[Float[Array, "4 4"], Float[Array, " p"]]:
    T_target_source = weighted_svd(pairs.source, pairs.target, jnp.where(is_inlier, pairs.scores, 0))
    squared = jnp.sum((rigid.transform_points(T_target_source, pairs.source) - pairs.target) ** 2, axis=1)
    return T_target_source, safe_sqrt(squared)


@typed_jit()
def merge_clouds(clouds: DescriptorCloud, T_map_cloud: Float[AnyArray, "s 4 4"]) -> DescriptorCloud:
    """Merges several descriptor clouds into one frame: a map, without new extraction (DeepPointMap section 3.1).

    Args:
        clouds: s clouds of equal capacity, stacked: positions (s, n, 3), features (s, m, c), mask (s, n).
        T_map_cloud: pose of each cloud in the frame of the map, metres. The pose of a cloud without a valid descriptor
            may be anything.

    Returns:
        One cloud of capacity s * n, the s * m points with features in front. It has the directions of the rays of all
        clouds, and their normals if they have some. Positions are 0 where the mask is False.

    Raises:
        ValueError: if the shapes do not match.
    """
    if clouds.positions.ndim != 3:
        raise ValueError(f"clouds: expected stacked clouds, positions (s, n, 3), got {clouds.positions.shape}")
    T_map_cloud = as_float("T_map_cloud", T_map_cloud)
    require_shape("T_map_cloud", T_map_cloud, (len(clouds.positions), 4, 4))
    num_described = clouds.features.shape[1]
    positions_cloud = jnp.where(clouds.mask[..., None], clouds.positions, 0)
    T_map_cloud = jnp.where(jnp.any(clouds.mask, axis=1)[:, None, None], T_map_cloud, 0)
    positions_map = jnp.where(clouds.mask[..., None], rigid.transform_points(T_map_cloud, positions_cloud), 0)
    directions = turned_directions(directions_of(replace(clouds, positions=positions_cloud)), T_map_cloud)
    normals_map = None
    if clouds.normals is not None:
        turn = T_map_cloud.at[:, :3, 3].set(0)
        normals_map = rigid.transform_points(turn, jnp.where(clouds.mask[..., None], clouds.normals, 0))

    def joined(values: Array) -> Array:
        # Descriptors with features come first, in the map as in each cloud.
        parts = values[:, :num_described], values[:, num_described:]
        return jnp.concatenate([part.reshape(-1, *values.shape[2:]) for part in parts])

    placed = replace(clouds, positions=positions_map, directions=directions, normals=normals_map)
    merged: DescriptorCloud = jax.tree.map(joined, placed)
    return merged


def thin_merged(merged: DescriptorCloud, num_per_cloud: int) -> DescriptorCloud:
    """Removes descriptors of a union near those of earlier clouds, on the host; see `thinned_mask`.

    Args:
        merged: union from `merge_clouds`, without further surface elements.
        num_per_cloud: number of descriptors of each cloud.

    Returns:
        The union with a smaller mask.
    """
    mask = thinned_mask(np.asarray(merged.positions), np.asarray(merged.mask), num_per_cloud)
    return replace(merged, mask=jnp.asarray(mask))


def thinned_mask(
    positions: Float[np.ndarray, "n 3"], mask: Bool[np.ndarray, " n"], num_per_cloud: int
) -> Bool[np.ndarray, " n"]:
    """Removes descriptors of a union near those of earlier clouds.

    The softmax over a target would be split between copies of one place. A descriptor is removed if one of an earlier
    cloud is nearer than the spacing of the first cloud: the median distance between its nearest descriptors.

    Args:
        positions: positions of the clouds of the union, cloud by cloud, in one frame, metres.
        mask: False for descriptors that are not there.
        num_per_cloud: number of descriptors of each cloud.

    Returns:
        The mask without the removed ones.
    """
    mask = np.array(mask)
    first = positions[:num_per_cloud][mask[:num_per_cloud]]
    if len(first) < 2 or len(positions) == num_per_cloud:
        return mask
    spacing_m = np.median(np.asarray(cKDTree(first).query(first, 2)[0])[:, 1])
    for start in range(num_per_cloud, len(positions), num_per_cloud):
        rows = np.arange(start, start + num_per_cloud)[mask[start : start + num_per_cloud]]
        if len(rows):
            mask[rows] = cKDTree(positions[:start][mask[:start]]).query(positions[rows])[0] > spacing_m
    return mask
