"""Two descriptor clouds to one motion: mutual matches, moved by their offsets, aligned in rounds of inliers.

Scan to scan and map to map are the same here: a map is the union of descriptor clouds (`merge_clouds`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_count, require_positive, require_shape
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import weighted_svd
from dpmjax.geometry.consensus import ConsensusConfig, find_consensus
from dpmjax.types import AnyArray, Registration

PredictOffsets = Callable[[Int[Array, " k"], Int[Array, " k"]], tuple[Float[Array, "k 3"], Float[Array, "k 3"]]]
"""Of rows in the source and in the target: the offsets of eq. 1 (source frame) and of eq. 2 (target frame), metres."""


ERROR_SLACK = 1 + 1e-5
"""Relative: where all errors are equal, rounding must not drop them."""


@dataclass(frozen=True)
class MatchConfig:
    """How pairs are chosen and which are believed (the numbers of DeepPointMap's published configuration).

    Attributes:
        temperature: of both softmaxes.
        pair_ratio: pairs per direction, as a share of the mean size of the two clouds.
        max_offset_m: pairs with longer offsets are dropped.
        min_inlier_score: pairs with higher scores are the first inliers ...
        min_num_first: ... or so many of the best, where those are fewer.
        num_rounds: how often inliers are chosen anew.
        inlier_sigmas: inliers are no farther than mean + so many standard deviations of those before.
        min_num_inliers: a choice of fewer is not taken.
        num_confident: the confidence is the mean score of so many first inliers.
        consensus: where given, the first inliers are instead the pairs that agree on one motion. Right pairs may
            then be few: networks of little training, or places that look alike.
    """

    temperature: float = 0.1
    pair_ratio: float = 0.5
    max_offset_m: float = 2.0
    min_inlier_score: float = 0.5
    min_num_first: int = 64
    num_rounds: int = 3
    inlier_sigmas: float = 3.0
    min_num_inliers: int = 30
    num_confident: int = 30
    consensus: ConsensusConfig | None = None

    def __post_init__(self) -> None:
        for name in ("temperature", "pair_ratio", "max_offset_m", "inlier_sigmas"):
            require_positive(name, getattr(self, name))
        for name in ("min_num_first", "num_rounds", "min_num_inliers", "num_confident"):
            require_count(name, getattr(self, name))
        if self.pair_ratio > 1:
            raise ValueError(f"pair_ratio: expected at most 1, got {self.pair_ratio}")


def match_descriptors(
    source_positions: Float[AnyArray, "m 3"],
    target_positions: Float[AnyArray, "n 3"],
    similarity: Float[AnyArray, "m n"],
    predict_offsets: PredictOffsets,
    source_mask: Bool[AnyArray, " m"] | None = None,
    target_mask: Bool[AnyArray, " n"] | None = None,
    *,
    config: MatchConfig,
) -> Registration:
    """The motion between two clouds of descriptors (DeepPointMap section 3.2, eq. 1 to 3).

    Pairs with the highest products of both softmaxes of the similarity count twice: as T (p + offset) = q and as
    T p = q + offset. One weighted SVD over both sets solves eq. 3, scores being the weights; then errors decide anew
    who is an inlier, in rounds. How many pairs there are depends on the number of valid descriptors, so that padded
    clouds give what unpadded ones do.

    Traced into the jitted step of the caller, for one pair of clouds; `vmap` for more.

    Args:
        source_positions: metres, source frame.
        target_positions: metres, target frame.
        similarity: cosine of each pair of descriptors, in [-1, 1].
        predict_offsets: the offset head on pairs of rows; called once, with static shapes.
        source_mask: False for descriptors that are not there; they may hold anything.
        target_mask: the same.
        config: thresholds.

    Raises:
        ValueError: the shapes do not match.
    """
    source_positions = as_points("source_positions", source_positions, dimensions=(3,))
    target_positions = as_points("target_positions", target_positions, dimensions=(3,))
    similarity = as_float("similarity", similarity)
    num_source, num_target = len(source_positions), len(target_positions)
    require_shape("similarity", similarity, (num_source, num_target))
    source_mask = as_mask("source_mask", source_mask, (num_source,))
    target_mask = as_mask("target_mask", target_mask, (num_target,))
    best = best_pairs(similarity, source_mask, target_mask, config=config)
    source_offsets, target_offsets = predict_offsets(best.source_indices, best.target_indices)
    return align_pairs(
        source_positions[best.source_indices],
        target_positions[best.target_indices],
        source_offsets,
        target_offsets,
        best,
        config=config,
    )


class BestPairs(NamedTuple):
    """The best matches of two clouds, best first.

    Attributes:
        source_indices: row of each in the source.
        target_indices: row of each in the target.
        scores: product of both softmaxes, in [0, 1]; 0 where `mask` is False.
        mask: False where there are fewer pairs.
    """

    source_indices: Int[Array, " k"]
    target_indices: Int[Array, " k"]
    scores: Float[Array, " k"]
    mask: Bool[Array, " k"]


@functools.partial(jax.jit, static_argnames="config")
def best_pairs(
    similarity: Float[Array, "m n"],
    source_mask: Bool[Array, " m"],
    target_mask: Bool[Array, " n"],
    *,
    config: MatchConfig,
) -> BestPairs:
    """The pairs with the highest dual softmax; a descriptor may be in several."""
    num_source, num_target = similarity.shape
    # floor(floor(ratio * (m + n)) / 2): the count of the published configuration.
    capacity = min(int(config.pair_ratio * (num_source + num_target)) // 2, num_source * num_target)
    is_pair = source_mask[:, None] & target_mask[None, :]
    logits = jnp.where(is_pair, similarity, 0) / config.temperature
    scores = _softmax(logits, is_pair, 1) * _softmax(logits, is_pair, 0)
    scores, flat = lax.top_k(jnp.where(is_pair, scores, -1).ravel(), capacity)
    num_valid = jnp.sum(source_mask) + jnp.sum(target_mask)
    num_pairs = jnp.floor(config.pair_ratio * num_valid).astype(int) // 2
    mask = (jnp.arange(capacity) < num_pairs) & (scores >= 0)
    rows, columns = flat // max(num_target, 1), flat % max(num_target, 1)
    return BestPairs(jnp.where(mask, rows, 0), jnp.where(mask, columns, 0), jnp.where(mask, scores, 0), mask)


@functools.partial(jax.jit, static_argnames="config")
def align_pairs(
    source_points: Float[Array, "k 3"],
    target_points: Float[Array, "k 3"],
    source_offsets: Float[Array, "k 3"],
    target_offsets: Float[Array, "k 3"],
    pairs: BestPairs,
    *,
    config: MatchConfig,
) -> Registration:
    """Weighted SVD with rounds of inliers over both directions of the pairs (DeepPointMap eq. 3)."""
    offsets = jnp.concatenate([source_offsets, target_offsets])
    scores = jnp.tile(pairs.scores, 2)
    is_used = jnp.tile(pairs.mask, 2) & (jnp.sum(offsets**2, axis=1) <= config.max_offset_m**2)
    offsets = jnp.where(is_used[:, None], offsets, 0)
    # Metres in, metres out, whatever the heads compute in.
    offsets = offsets.astype(source_points.dtype)
    num_pairs = len(source_points)
    source = jnp.tile(source_points, (2, 1)).at[:num_pairs].add(offsets[:num_pairs])
    target = jnp.tile(target_points, (2, 1)).at[num_pairs:].add(offsets[num_pairs:])
    source, target = (jnp.where(is_used[:, None], points, 0) for points in (source, target))
    is_inlier = _choose_inliers(source, target, scores, is_used, config)
    T_target_source, errors = _solve(source, target, scores, is_inlier)
    num_inliers = jnp.sum(is_inlier)
    squared = jnp.sum(jnp.where(is_inlier, errors**2, 0)) / jnp.maximum(num_inliers, 1)
    is_confident = is_inlier & (jnp.cumsum(is_inlier) <= config.num_confident)
    return Registration(
        T_target_source=T_target_source,
        confidence=jnp.sum(jnp.where(is_confident, scores, 0)) / jnp.maximum(jnp.sum(is_confident), 1),
        rmse_m=jnp.where(num_inliers > 0, jnp.sqrt(squared), jnp.inf),
        num_inliers=num_inliers,
        source_indices=jnp.tile(pairs.source_indices, 2),
        target_indices=jnp.tile(pairs.target_indices, 2),
        scores=jnp.where(is_used, scores, 0),
        is_inlier=is_inlier,
    )


def _softmax(logits: Float[Array, "m n"], is_pair: Bool[Array, "m n"], axis: int) -> Float[Array, "m n"]:
    largest = jnp.max(jnp.where(is_pair, logits, -jnp.inf), axis=axis, keepdims=True, initial=-jnp.inf)
    shifted = jnp.where(is_pair, logits - jnp.where(jnp.isfinite(largest), largest, 0), 0)
    powers = jnp.where(is_pair, jnp.exp(shifted), 0)
    total = jnp.sum(powers, axis=axis, keepdims=True)
    return powers / jnp.where(total > 0, total, 1)


def _first_inliers(scores: Float[Array, " p"], is_used: Bool[Array, " p"], config: MatchConfig) -> Bool[Array, " p"]:
    is_good = is_used & (scores > config.min_inlier_score)
    ranks = jnp.argsort(jnp.argsort(jnp.where(is_used, -scores, jnp.inf)))
    is_best = is_used & (ranks < config.min_num_first)
    return is_good | is_best


def _agreeing(
    source: Float[Array, "p 3"], target: Float[Array, "p 3"], is_used: Bool[Array, " p"], config: ConsensusConfig
) -> Bool[Array, " p"]:
    """Pairs of both directions that the consensus supports; it is sought in the first alone, a quarter of the work."""
    half = len(source) // 2
    T_target_source = find_consensus(source[:half], target[:half], is_used[:half], config=config).T_target_source
    squared = jnp.sum((rigid.transform_points(T_target_source, source) - target) ** 2, axis=1)
    return is_used & (squared < config.inlier_m**2)


def _choose_inliers(
    source: Float[Array, "p 3"],
    target: Float[Array, "p 3"],
    scores: Float[Array, " p"],
    is_used: Bool[Array, " p"],
    config: MatchConfig,
) -> Bool[Array, " p"]:
    """Which pairs the motion rests on; the choice has no derivative."""
    source, target, scores = lax.stop_gradient((source, target, scores))

    def choose(_: Int[Array, ""], is_inlier: Bool[Array, " p"]) -> Bool[Array, " p"]:
        _, errors = _solve(source, target, scores, is_inlier)
        chosen = is_used & (errors <= _error_limit(errors, is_inlier, config))
        # Taken where they are enough; a choice that does not change any more stays as it is.
        return jnp.where(jnp.sum(chosen) >= config.min_num_inliers, chosen, is_inlier)

    if config.consensus is None:
        first = _first_inliers(scores, is_used, config)
    else:
        first = _agreeing(source, target, is_used, config.consensus)
    return lax.fori_loop(0, config.num_rounds, choose, first)


def _solve(
    source: Float[Array, "p 3"], target: Float[Array, "p 3"], scores: Float[Array, " p"], is_inlier: Bool[Array, " p"]
) -> tuple[Float[Array, "4 4"], Float[Array, " p"]]:
    T_target_source = weighted_svd(source, target, jnp.where(is_inlier, scores, 0))
    squared = jnp.sum((rigid.transform_points(T_target_source, source) - target) ** 2, axis=1)
    is_apart = squared > 0
    return T_target_source, jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, squared, 1)), 0)


def _error_limit(errors: Float[Array, " p"], is_inlier: Bool[Array, " p"], config: MatchConfig) -> Float[Array, ""]:
    count = jnp.maximum(jnp.sum(is_inlier), 1)
    mean = jnp.sum(jnp.where(is_inlier, errors, 0)) / count
    variance = jnp.sum(jnp.where(is_inlier, (errors - mean) ** 2, 0)) / count
    return (mean + config.inlier_sigmas * jnp.sqrt(variance)) * ERROR_SLACK
