"""Overlap: the probability that two scans or maps are less than 20 m apart, from how well their descriptors match.

The published head sees the mean of the correlated features alone. What tells overlap is in the match: how alike the
best pairs are, and how many pairs agree on one motion. These numbers, the evidence, come from descriptors only. A small
network turns them into a probability (`deeppointmap.overlap_fit`). Its parameters are `params["overlap"]`; a model
without them, as a published one, answers with its head.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.deeppointmap.matching import MatchConfig, best_pairs
from dpmjax.deeppointmap.model import (
    Model,
    correlate,
    descriptor_similarity,
    overlap_logit,
    predict_offsets,
    unit_rows,
)
from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import directions_of
from dpmjax.geometry.consensus import ConsensusConfig, find_consensus
from dpmjax.types import DescriptorCloud

MATCHING = MatchConfig(pair_ratio=1.0)
CONSENSUS = ConsensusConfig(num_seeds=48, num_rounds=3, num_motions=2)
"""A quarter of the work of a registration: only the two best motions count."""

NEAR_M = 2.0
"""Descriptors of two clouds that are nearer than this under the motion lie in the same place."""

QUANTILES = (0.25, 0.5, 0.75, 0.9)
MAX_STANDARD = 5.0
"""Evidence is clipped to this number of standard deviations."""


class OverlapEvidence(NamedTuple):
    """Numbers that tell overlap; shares are in [0, 1], similarities are cosines.

    Attributes:
        scan_similarity: of the mean encoder features of both clouds.
        best_similarity: quantiles, over the descriptors, of the similarity to the best descriptor of the other cloud.
        best_score: the same of the dual softmax.
        mutual_share: share of the descriptors whose best ones choose them in turn.
        support: consensus support of the best motion, as a share of the pairs.
        support_second: the same of the best other motion.
        offset_disagreement_m: mean distance between the two offsets that are predicted for an inlier, one from each
            side, under the motion.
        offset_length_m: mean length of the offsets of the inliers.
        distance_m: length of the motion.
        height_m: its vertical part.
        tilt_rad: angle between the vertical axes of both clouds under the motion.
        met_share: share of the descriptors that meet a descriptor of the other cloud under the motion.
        met_similarity: mean similarity of those that meet.
        spread_m: spread of the inliers in the horizontal plane.
        log_radius: logarithm of the smaller of the mean distances of the descriptors from the origins.
        log_radius_ratio: logarithm of the ratio of both.
    """

    scan_similarity: Float[Array, ""]
    best_similarity: Float[Array, " q"]
    best_score: Float[Array, " q"]
    mutual_share: Float[Array, ""]
    support: Float[Array, ""]
    support_second: Float[Array, ""]
    offset_disagreement_m: Float[Array, ""]
    offset_length_m: Float[Array, ""]
    distance_m: Float[Array, ""]
    height_m: Float[Array, ""]
    tilt_rad: Float[Array, ""]
    met_share: Float[Array, ""]
    met_similarity: Float[Array, ""]
    spread_m: Float[Array, ""]
    log_radius: Float[Array, ""]
    log_radius_ratio: Float[Array, ""]

    @property
    def numbers(self) -> Float[Array, " f"]:
        """All of them in one vector."""
        return jnp.concatenate([jnp.ravel(part) for part in self])


@jax.jit
def overlap_evidence(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, " f"]:
    """Matches two clouds and measures how well that went.

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors of a scan or a map.
        b: the same.

    Returns:
        The numbers of `OverlapEvidence`; finite for finite features, also where a cloud is empty.
    """
    correlated = correlate(model, a, b)
    similarity = descriptor_similarity(model, *correlated)
    is_pair = a.mask[:, None] & b.mask[None, :]
    similarity = jnp.where(is_pair, similarity, -1)
    logits = jnp.where(is_pair, similarity / MATCHING.temperature, jnp.finfo(similarity.dtype).min)
    scores = jnp.where(is_pair, jax.nn.softmax(logits, axis=1) * jax.nn.softmax(logits, axis=0), 0)
    chosen = jnp.argmax(scores, axis=1)
    is_mutual = a.mask & (jnp.argmax(scores, axis=0)[chosen] == jnp.arange(len(chosen)))
    radii = [_mean(jnp.linalg.norm(cloud.positions, axis=1), cloud.mask) + 1 for cloud in (a, b)]
    return OverlapEvidence(
        scan_similarity=jnp.dot(_mean_direction(a), _mean_direction(b)),
        best_similarity=_best_of_both(similarity, a.mask, b.mask),
        best_score=_best_of_both(scores, a.mask, b.mask),
        mutual_share=jnp.sum(is_mutual) / jnp.maximum(jnp.minimum(jnp.sum(a.mask), jnp.sum(b.mask)), 1),
        log_radius=jnp.log(jnp.minimum(*radii)),
        log_radius_ratio=jnp.abs(jnp.log(radii[0] / radii[1])),
        **_motion_evidence(model, correlated, similarity)._asdict(),
    ).numbers


@jax.jit
def overlap_probability(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    """Predicts the probability that two clouds are less than 20 m apart.

    A `ValueError` says if the features have another width than the model.

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors.
        b: the same; the order matters a little.

    Returns:
        The probability; that of the head (DeepPointMap section 3.2) where the model has no fitted overlap. It is 0
        where a cloud is empty or holds a feature that is not finite.
    """
    if "overlap" in model.params:
        logit = evidence_logit(model.params["overlap"], overlap_evidence(model, a, b))
    else:
        logit = overlap_logit(model, *correlate(model, a, b))
    is_known = jnp.any(a.mask) & jnp.any(b.mask) & jnp.isfinite(logit)
    return jnp.where(is_known, jax.nn.sigmoid(jnp.where(is_known, logit, 0)), 0)


def evidence_logit(params: dict[str, Any], evidence: Float[Array, "*n f"]) -> Float[Array, "*n"]:
    """Computes the log odds of overlap: linear, relu, linear on standardised evidence.

    Args:
        params: `mean` and `scale` of the evidence, `hidden` and `output` with `kernel` and `bias` each.
        evidence: from `overlap_evidence`.

    Returns:
        The log odds; NaN where the evidence is.
    """
    standard = (evidence - params["mean"]) / params["scale"]
    standard = jnp.clip(standard, -MAX_STANDARD, MAX_STANDARD)
    hidden = jax.nn.relu(standard @ params["hidden"]["kernel"] + params["hidden"]["bias"])
    return (hidden @ params["output"]["kernel"] + params["output"]["bias"])[..., 0]


class _MotionEvidence(NamedTuple):
    # The part of `OverlapEvidence` that needs the best motion.
    support: Float[Array, ""]
    support_second: Float[Array, ""]
    offset_disagreement_m: Float[Array, ""]
    offset_length_m: Float[Array, ""]
    distance_m: Float[Array, ""]
    height_m: Float[Array, ""]
    tilt_rad: Float[Array, ""]
    met_share: Float[Array, ""]
    met_similarity: Float[Array, ""]
    spread_m: Float[Array, ""]


def _motion_evidence(
    model: Model, correlated: tuple[DescriptorCloud, DescriptorCloud], similarity: Float[Array, "m n"]
) -> _MotionEvidence:
    a, b = correlated
    pairs = best_pairs(similarity, a.mask, b.mask, config=MATCHING)
    rows, columns = pairs.source_indices, pairs.target_indices
    features_a, features_b = a.features[rows], b.features[columns]
    offsets = predict_offsets(model, features_a, features_b, directions_of(a)[rows])
    returning = predict_offsets(model, features_b, features_a, directions_of(b)[columns])
    lengths = jnp.linalg.norm(offsets, axis=1)
    points, targets = a.positions[rows], b.positions[columns]
    is_used = pairs.mask & (lengths <= MATCHING.max_offset_m)
    found = find_consensus(points + offsets, targets, is_used, config=CONSENSUS)
    T, is_inlier = found.T_target_source[0], found.is_inlier[0]
    disagreement = jnp.linalg.norm(offsets @ T[:3, :3].T + returning, axis=1)
    num_pairs = jnp.maximum(jnp.sum(pairs.mask), 1)
    moved = rigid.transform_points(T, a.positions)
    apart = jnp.sum((moved[:, None] - b.positions[None]) ** 2, axis=2)
    apart = jnp.where(a.mask[:, None] & b.mask[None], apart, jnp.inf)
    meets = jnp.min(apart, axis=1) < NEAR_M**2
    similarity_there = jnp.take_along_axis(similarity, jnp.argmin(apart, axis=1)[:, None], axis=1)[:, 0]
    return _MotionEvidence(
        support=found.support[0] / num_pairs,
        support_second=found.support[1] / num_pairs,
        offset_disagreement_m=_mean(disagreement, is_inlier),
        offset_length_m=_mean(lengths, is_inlier),
        distance_m=jnp.linalg.norm(T[:3, 3]),
        height_m=jnp.abs(T[2, 3]),
        tilt_rad=jnp.arccos(jnp.clip(T[2, 2], -1, 1)),
        met_share=(_mean(meets, a.mask) + _mean(jnp.min(apart, axis=0) < NEAR_M**2, b.mask)) / 2,
        met_similarity=_mean(similarity_there, meets),
        spread_m=_spread(points[:, :2], is_inlier),
    )


def _mean(values: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(jnp.sum(mask), 1)


def _spread(points: Float[Array, "n d"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    centre = jnp.stack([_mean(column, mask) for column in points.T])
    return jnp.sqrt(_mean(jnp.sum((points - centre) ** 2, axis=1), mask))


def _mean_direction(cloud: DescriptorCloud) -> Float[Array, " c"]:
    total = jnp.sum(jnp.where(cloud.mask[:, None], unit_rows(cloud.features), 0), axis=0)
    return unit_rows(total[None])[0]


def _best_of_both(
    values: Float[Array, "m n"], rows: Bool[Array, " m"], columns: Bool[Array, " n"]
) -> Float[Array, " q"]:
    """Returns quantiles of the row maxima and of the column maxima, the mean of both."""
    sides = ((jnp.max(values, axis=1), rows), (jnp.max(values, axis=0), columns))
    return sum(_quantiles(best, mask) for best, mask in sides) / 2


def _quantiles(values: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, " q"]:
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf))
    places = jnp.floor(jnp.asarray(QUANTILES) * (jnp.sum(mask) - 1)).astype(int)
    return jnp.where(jnp.any(mask), ordered[jnp.maximum(places, 0)], 0)
