"""Overlap: the probability that two scans or maps are less than 20 m apart, from how well their descriptors match.

The published head sees the mean of the correlated features alone. Overlap shows in the match: in the
similarity of the best pairs, and in the number of pairs that agree on one motion. These numbers, the evidence, come
from descriptors only, so that thousands of candidates can be compared. A logistic regression, fitted by `dpmjax train`
and `python -m experiments.dpm_calibrate`, turns them into a probability. Published models have no regression and use
their head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.checks import require_pairs, runs_on_host
from dpmjax.deeppointmap.confidence import OverlapEvidence
from dpmjax.deeppointmap.encoding import ScanOrCloud, descriptors_of, encode_scans
from dpmjax.deeppointmap.matching import MAX_OFFSET_M, MatchConfig, best_pairs, dual_softmax
from dpmjax.deeppointmap.model import Model, correlate, decode, descriptor_similarity, predict_offsets, unit_rows
from dpmjax.geometry import rigid
from dpmjax.geometry.bearing import directions_of
from dpmjax.geometry.consensus import ConsensusConfig, find_consensus
from dpmjax.kept_programs import kept_jit
from dpmjax.scan.lidar.record import Scan
from dpmjax.types import DescriptorCloud

# Scans that are nearer to each other overlap.
OVERLAP_M = 20.0

# A quarter of the work of a registration: only the two best motions count.
CONSENSUS = ConsensusConfig(num_seeds=48, num_rounds=3, num_motions=2)

# How sharply `near_support` falls at `OVERLAP_M`.
GATE_M = 2.0

# Descriptors of two clouds meet where they are nearer than this under the motion.
MET_M = 2.0

# Quantile of the good pairs.
HIGH = 0.9

MAX_DISTANCE_M, MAX_DISAGREEMENT_M = 100.0, 5.0


@runs_on_host("call correlate there")
def overlap(model: Model, source: ScanOrCloud, target: ScanOrCloud) -> Float[Array, ""]:
    """Predicts the probability that two scans or maps overlap: that their origins are less than 20 m apart.

    A calibrated model (`model.config.overlap`, from `dpmjax train`) predicts it from the match of the descriptors. Half
    of the pairs of its fit overlapped, a quarter was 20 to 40 m apart, and a quarter was farther apart or of different
    places. Where overlap is rarer, the probability is too high. A model without calibration uses the trained head of
    its decoder, as published ones do (DeepPointMap section 3.2).

    Raises a `ValueError` if the model has neither, if the points are no real numbers (n, 3), or if features have
    another width than the model.

    Args:
        model: encoder and decoder.
        source: a raw scan (n, 3) in metres, a scan from `prepare_scan`, or a descriptor cloud.
        target: the same; the order matters a little.

    Returns:
        The probability; 0 where a scan is empty or a feature is not finite.
    """
    return overlap_pairs(model, [source], [target])[0]


@runs_on_host("call correlate there")
def overlap_pairs(model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Float[Array, " n"]:
    """Predicts the overlap probability of many pairs as `overlap` does; each scan is encoded once.

    Raises a `ValueError` if the model has neither a calibration nor a trained head, or if the lengths differ or are 0.

    Args:
        model: encoder and decoder.
        sources: raw scans, prepared scans or descriptor clouds; clouds must have one capacity.
        targets: the same, one for each source.

    Returns:
        The probabilities.
    """
    require_overlap(model)
    return jnp.asarray(_apply_to_pairs(overlap_probability, model, sources, targets))


def require_overlap(model: Model) -> None:
    """Refuses a model that cannot predict overlap: its head would answer any pair with one number.

    Args:
        model: a model.

    Raises:
        ValueError: if the model has neither a fitted regression nor a trained head.
    """
    if model.config.overlap is None and "overlap" not in model.config.trained:
        missing = "expected a trained overlap head or a regression of overlap, got neither"
        raise ValueError(f"model: {missing}; run `dpmjax train --stages overlap --weights FILE --data ...`")


def evidence_pairs(model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Float[Array, "n f"]:
    """Computes the features of the overlap probability of many pairs.

    Raises a `ValueError` if the lengths differ or are 0.

    Args:
        model: encoder and decoder.
        sources: as in `overlap_pairs`.
        targets: the same, one for each source.

    Returns:
        A row for each pair, in the order of `confidence.OVERLAP_FEATURES`.
    """
    return jnp.stack(_apply_to_pairs(overlap_evidence, model, sources, targets), axis=1)


@kept_jit()
def overlap_evidence(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> OverlapEvidence:
    """Matches two clouds and computes the features of their overlap probability.

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors of a scan or a map.
        b: the same.

    Returns:
        The features; finite for finite descriptors, also where a cloud is empty.
    """
    a, b = a.described, b.described
    correlated = correlate(model, a, b)
    is_pair = a.mask[:, None] & b.mask[None, :]
    similarity = jnp.where(is_pair, descriptor_similarity(model, *correlated), -1)
    scores = dual_softmax(similarity, is_pair)
    best = jnp.argmax(scores, axis=1)
    is_mutual = a.mask & (jnp.argmax(scores, axis=0)[best] == jnp.arange(len(best)))
    motion = _best_motion(model, correlated, similarity)
    gate = jax.nn.sigmoid((OVERLAP_M - motion["distance_m"]) / GATE_M)
    radii = [_mean(jnp.linalg.norm(cloud.positions, axis=1), cloud.mask) + 1 for cloud in (a, b)]
    return OverlapEvidence(
        scan_similarity=jnp.dot(_mean_direction(a), _mean_direction(b)),
        similarity_median=_quantile_of_best(similarity, a.mask, b.mask, 0.5),
        similarity_high=_quantile_of_best(similarity, a.mask, b.mask, HIGH),
        score_median=_quantile_of_best(scores, a.mask, b.mask, 0.5),
        score_high=_quantile_of_best(scores, a.mask, b.mask, HIGH),
        mutual_share=jnp.sum(is_mutual) / jnp.maximum(jnp.minimum(jnp.sum(a.mask), jnp.sum(b.mask)), 1),
        near_support=motion["support"] * gate,
        log_radius=jnp.log(jnp.minimum(*radii)),
        log_radius_ratio=jnp.abs(jnp.log(radii[0] / radii[1])),
        **motion,
    )


@kept_jit()
def overlap_probability(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    """Predicts the probability that two clouds are less than 20 m apart, by the regression or else by the head.

    Raises a `ValueError` if the features have another width than the model, or if the model has neither.

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors.
        b: the same; the order matters a little.

    Returns:
        The probability (see `dpmjax.overlap`). It is 0 where a cloud is empty or holds a feature that is not finite.
    """
    fitted = model.config.overlap
    if fitted is None:
        return head_probability(model, a, b)
    evidence = jnp.stack(overlap_evidence(model, a, b))
    logit = jnp.sum(evidence * np.asarray(fitted.weights, np.float32)) + fitted.bias
    return _probability(logit, a, b)


@jax.jit
def head_probability(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    """Predicts the probability that two clouds are less than 20 m apart, by the head of the decoder alone.

    This is the overlap of DeepPointMap (section 3.2, figure 2e).

    Args:
        model: encoder and decoder.
        a: uncorrelated descriptors.
        b: the same; the order matters a little.

    Returns:
        The probability. It is 0 where a cloud is empty or holds a feature that is not finite.

    Raises:
        ValueError: if the head is not trained, or if the features have another width than the model.
    """
    require_overlap(replace(model, config=replace(model.config, overlap=None)))
    return _probability(decode(model, *correlate(model, a, b), part="overlap_logit"), a, b)


def _probability(logit: Float[Array, ""], a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
    is_known = jnp.any(a.mask) & jnp.any(b.mask) & jnp.isfinite(logit)
    return jnp.where(is_known, jax.nn.sigmoid(jnp.where(is_known, logit, 0)), 0)


def _apply_to_pairs(function: Any, model: Model, sources: Sequence[ScanOrCloud], targets: Sequence[ScanOrCloud]) -> Any:
    """Applies a compiled function of one pair to all pairs; each scan is encoded once."""
    require_pairs(sources, targets)
    scans: dict[int, Any] = {id(scan): scan for scan in (*sources, *targets)}
    raw = {key: scan for key, scan in scans.items() if not isinstance(scan, DescriptorCloud | Scan)}
    if raw:
        encoded = jax.device_get(encode_scans(model, list(raw.values())))
        scans |= {key: jax.tree.map(lambda leaf, row=row: leaf[row], encoded) for row, key in enumerate(raw)}
    pairs = [
        [descriptors_of(scans[id(scan)]).described for scan in pair] for pair in zip(sources, targets, strict=True)
    ]
    # One by one: a pair takes a CPU 24 ms, and most calls of SLAM have one or two.
    results = jax.device_get([function(model, *pair) for pair in pairs])
    return jax.tree.map(lambda *values: np.stack(values), *results)


def _best_motion(
    model: Model, correlated: tuple[DescriptorCloud, DescriptorCloud], similarity: Float[Array, "m n"]
) -> dict[str, Float[Array, ""]]:
    # The fields of `OverlapEvidence` that depend on the best motion.
    a, b = correlated
    pairs = best_pairs(similarity, a.mask, b.mask, config=MatchConfig(pair_ratio=1.0))
    rows, columns = pairs.source_indices, pairs.target_indices
    features_a, features_b = a.features[rows], b.features[columns]
    offsets = predict_offsets(model, features_a, features_b, directions_of(a)[rows])
    returning = predict_offsets(model, features_b, features_a, directions_of(b)[columns])
    is_used = pairs.mask & (jnp.sum(offsets**2, axis=1) <= MAX_OFFSET_M**2)
    points = a.positions[rows]
    found = find_consensus(points + offsets, b.positions[columns], is_used, config=CONSENSUS)
    T, is_inlier = found.T_target_source[0], found.is_inlier[0]
    disagreement = jnp.linalg.norm(offsets @ T[:3, :3].T + returning, axis=1)
    support = found.support / jnp.maximum(jnp.sum(pairs.mask), 1)
    is_pair = a.mask[:, None] & b.mask[None]
    moved = rigid.transform_points(T, a.positions)
    apart = jnp.where(is_pair, jnp.sum((moved[:, None] - b.positions[None]) ** 2, axis=2), jnp.inf)
    meets = [jnp.min(apart, axis=axis) < MET_M**2 for axis in (1, 0)]
    centre = jnp.stack([_mean(column, is_inlier) for column in points.T[:2]])
    similarity_there = jnp.take_along_axis(similarity, jnp.argmin(apart, axis=1)[:, None], axis=1)[:, 0]
    return {
        "support": support[0],
        "support_second": support[1],
        "offset_disagreement_m": _mean(jnp.minimum(disagreement, MAX_DISAGREEMENT_M), is_inlier),
        "distance_m": jnp.minimum(jnp.linalg.norm(T[:3, 3]), MAX_DISTANCE_M),
        "met_share": (_mean(meets[0], a.mask) + _mean(meets[1], b.mask)) / 2,
        "met_similarity": _mean(similarity_there, meets[0]),
        "spread_m": jnp.sqrt(_mean(jnp.sum((points[:, :2] - centre) ** 2, axis=1), is_inlier)),
    }


def _mean(values: Array, mask: Bool[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(jnp.sum(mask), 1)


def _mean_direction(cloud: DescriptorCloud) -> Float[Array, " c"]:
    total = jnp.sum(jnp.where(cloud.mask[:, None], unit_rows(cloud.features), 0), axis=0)
    return unit_rows(total[None])[0]


def _quantile_of_best(
    values: Float[Array, "m n"], rows: Bool[Array, " m"], columns: Bool[Array, " n"], quantile: float
) -> Float[Array, ""]:
    """Returns a quantile of the row maxima and of the column maxima, the mean of both."""
    total = jnp.zeros(())
    for axis, mask in ((1, rows), (0, columns)):
        ordered = jnp.sort(jnp.where(mask, jnp.max(values, axis=axis), jnp.inf))
        place = jnp.floor(quantile * (jnp.sum(mask) - 1)).astype(int)
        total += jnp.where(jnp.any(mask), ordered[jnp.maximum(place, 0)], 0)
    return total / 2
