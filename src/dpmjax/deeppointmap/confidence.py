"""Confidence of a registration, and of an overlap: probabilities by logistic regression on a few features.

Platt (1999): a score becomes a probability by a logistic function that is fitted on held-out examples. The function is
fitted by `python -m experiments.dpm_calibrate` and stored in the configuration of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
import scipy  # loads scipy.optimize, which takes a third of a second, when it is needed
from jaxtyping import Array, Bool, Float
from scipy.special import expit, logit

from dpmjax.scan.lidar.compare import CORRIDOR_CONFIDENCE, MAX_SCORE
from dpmjax.types import Registration, Verification

CLOUD_FEATURES = ("log_support", "mean_score", "rmse_m", "lead_share")
ELEMENT_FEATURES = (*CLOUD_FEATURES, "visible_share", "matched_share", "contradicted_share", "facing_gap")
SCAN_FEATURES = (
    *("support", "mean_score", "rmse_m", "support_gap"),
    *("visible_share", "matched_share", "contradicted_share", "score", "score_gap"),
)
WEAK_FEATURES = ("score_capped", "facing_gap_root")
MAX_RMSE_M = 5.0
# Niches and pillars at equal steps repeat at other places. Of 148 wrong motions of simulated corridors and tunnels none
# has a larger `distinct_gap` than 7.5; of 125 right ones 51 have more than this limit.
CLEAR_DISTINCT_GAP = 10.0
# Fewer elements see and meet less of each other than those of the fit.
MIN_NUM_ELEMENTS = 512
# Few elements of a cloud face an axis; more of them say no more.
MAX_FACING_GAP = 5.0
RIDGE = 1e-3


class OverlapEvidence(NamedTuple):
    """Features from which overlap is predicted; similarities are cosines, shares are in [0, 1].

    Attributes:
        scan_similarity: similarity of the mean encoder features of both clouds.
        similarity_median: median, over descriptors, of the similarity to the best descriptor of the opposite cloud.
        similarity_high: a high quantile of the same similarity.
        score_median: median of the dual softmax with the best descriptor of the opposite cloud.
        score_high: a high quantile of the same dual softmax.
        mutual_share: share of the descriptors that are the best match of their own best match.
        support: consensus support of the best motion, as a share of the pairs.
        near_support: `support` of a motion shorter than 20 m; it falls to 0 beyond.
        support_second: support of the second motion.
        offset_disagreement_m: mean difference, over inliers, of the two offsets that are predicted from both sides.
        distance_m: length of the motion.
        met_share: share of the descriptors that meet a descriptor of the opposite cloud under the motion.
        met_similarity: mean similarity of the descriptors that meet.
        spread_m: spread of the inliers in the horizontal plane.
        log_radius: logarithm of the smaller of the mean distances of the descriptors from both origins.
        log_radius_ratio: logarithm of the ratio of these two mean distances.
    """

    scan_similarity: Float[Array, ""]
    similarity_median: Float[Array, ""]
    similarity_high: Float[Array, ""]
    score_median: Float[Array, ""]
    score_high: Float[Array, ""]
    mutual_share: Float[Array, ""]
    support: Float[Array, ""]
    near_support: Float[Array, ""]
    support_second: Float[Array, ""]
    offset_disagreement_m: Float[Array, ""]
    distance_m: Float[Array, ""]
    met_share: Float[Array, ""]
    met_similarity: Float[Array, ""]
    spread_m: Float[Array, ""]
    log_radius: Float[Array, ""]
    log_radius_ratio: Float[Array, ""]


OVERLAP_FEATURES = OverlapEvidence._fields


@dataclass(frozen=True)
class LogisticModel:
    """Probability 1 / (1 + exp(-(weights . features + bias))).

    Attributes:
        features: names of the features.
        weights: weight of each feature.
        bias: the constant.
    """

    features: tuple[str, ...]
    weights: tuple[float, ...]
    bias: float

    def __post_init__(self) -> None:
        if len(self.features) != len(self.weights):
            raise ValueError(f"weights: expected {len(self.features)}, one for each feature, got {len(self.weights)}")
        if self.features not in (CLOUD_FEATURES, ELEMENT_FEATURES, SCAN_FEATURES, WEAK_FEATURES, OVERLAP_FEATURES):
            raise ValueError(f"features: expected those that this version computes, got {', '.join(self.features)}")


@dataclass(frozen=True)
class Calibration:
    """Logistic models of P(right within 2 m and 5 degrees).

    Attributes:
        of_clouds: model for descriptor clouds without surface elements, and for maps.
        of_scans: model for motions that the scans have verified.
        of_weak_scans: model for verified scans whose walls constrain one direction only, as in corridors; None uses
            `of_scans`.
        of_elements: model for descriptor clouds of single scans with surface elements; None uses `of_clouds`.
    """

    of_clouds: LogisticModel
    of_scans: LogisticModel
    of_weak_scans: LogisticModel | None = None
    of_elements: LogisticModel | None = None


class MatchEvidence(NamedTuple):
    """Features from which the confidence is computed.

    Attributes:
        of_clouds: `CLOUD_FEATURES`.
        of_scans: `SCAN_FEATURES`; None without scans.
        of_weak_scans: `WEAK_FEATURES`; None where the walls constrain all directions, and without scans.
        lookalike_gap: lead over other places, as log odds; infinite where none looks alike. In corridors it is that of
            `CORRIDOR_CONFIDENCE`, for scans only if the lead in the elements that face the axis is not clear.
        of_elements: `ELEMENT_FEATURES`; None without 512 surface elements that were compared.
    """

    of_clouds: Float[np.ndarray, " f"]
    of_scans: Float[np.ndarray, " g"] | None
    of_weak_scans: Float[np.ndarray, " w"] | None = None
    lookalike_gap: float = np.inf
    of_elements: Float[np.ndarray, " e"] | None = None


def gather_evidence(
    hypotheses: Registration,
    row: int | None,
    verification: Verification | None,
    elements: Verification | None = None,
    num_elements: int = 0,
) -> MatchEvidence:
    """Gathers the features of one hypothesis.

    Args:
        hypotheses: all hypotheses of a pair, with a leading axis.
        row: row of the chosen one; None for a motion that no pairs of descriptors support.
        verification: verification of the chosen motion; None without scans.
        elements: agreement of surface elements under the motion, of clouds without scans.
        num_elements: number of elements of the cloud that has fewer.

    Returns:
        The features.
    """
    supports = np.asarray(hypotheses.support, np.float64)
    if row is None:
        support, mean_score, rmse_m, gap = 0.0, 0.0, MAX_RMSE_M, -supports.max()
    else:
        support, mean_score = supports[row], float(hypotheses.mean_score[row])
        rmse_m = min(float(hypotheses.rmse[row]), MAX_RMSE_M)
        gap = support - np.delete(supports, row).max(initial=0.0)
    lead_share = gap / max(supports.max(), 1e-6)
    of_clouds = np.array([np.log1p(support), mean_score, rmse_m, lead_share])
    if elements is not None:
        facing_gap = np.clip(elements.facing_gap, -MAX_FACING_GAP, MAX_FACING_GAP)
        is_dense = num_elements >= MIN_NUM_ELEMENTS
        of_elements = np.array([*of_clouds, *elements[:3], facing_gap]) if is_dense else None
        return MatchEvidence(
            of_clouds, None, None, logit(CORRIDOR_CONFIDENCE if elements.num_slid else 1.0), of_elements
        )
    if verification is None:
        return MatchEvidence(of_clouds, None)
    of_verification = verification[: verification._fields.index("num_tried")]
    of_scans = np.array([support, mean_score, rmse_m, gap, *of_verification])
    if verification.num_slid == 0:
        return MatchEvidence(of_clouds, of_scans, None, verification.lookalike_gap)
    limit = 1.0 if verification.distinct_gap >= CLEAR_DISTINCT_GAP else CORRIDOR_CONFIDENCE
    return MatchEvidence(of_clouds, of_scans, weak_features(verification), logit(limit))


def weak_features(verification: Verification) -> Float[np.ndarray, "2"]:
    """Computes `WEAK_FEATURES`. A count enters by its root, because its noise grows with the root.

    Args:
        verification: verification of scans whose walls constrain one direction only.

    Returns:
        The features.
    """
    return np.array([min(verification.score, MAX_SCORE), np.sqrt(max(verification.facing_gap, 0.0))])


def calibrated_probability(calibration: Calibration, evidence: MatchEvidence) -> float:
    """Computes the probability that a registration is right, by the model that fits its features.

    Args:
        calibration: fitted models.
        evidence: features of the registration.

    Returns:
        In [0, 1].
    """
    kinds = ("of_weak_scans", "of_scans", "of_elements", "of_clouds")
    fitting = (one for one in kinds if getattr(evidence, one) is not None and getattr(calibration, one) is not None)
    kind = next(fitting)
    probability = logistic_probability(getattr(calibration, kind), getattr(evidence, kind))
    if kind == "of_weak_scans":
        return float(np.minimum(probability, expit(evidence.lookalike_gap)))
    # One of two places under which the scans agree is right; the odds are those of their scores.
    return float(expit(evidence.lookalike_gap) * probability)


def logistic_probability(model: LogisticModel, features: Float[np.ndarray, "*n f"]) -> Float[np.ndarray, "*n"]:
    """Computes the probability that a registration is right.

    Args:
        model: fitted weights.
        features: features in the order of `model.features`.

    Returns:
        In [0, 1].
    """
    return np.asarray(expit(np.asarray(features, np.float64) @ np.asarray(model.weights) + model.bias))


def fit_weights(
    features: Float[np.ndarray, "n f"],
    is_right: Bool[np.ndarray, " n"],
    shares: Float[np.ndarray, " n"] | float = 1.0,
) -> tuple[tuple[float, ...], float]:
    """Fits the weights and the constant of a logistic model by maximum likelihood.

    A small ridge on the standardised weights keeps them finite.

    Args:
        features: features of held-out registrations.
        is_right: True for right ones.
        shares: factors of the probability, in (0, 1], as of places that look alike in `calibrated_probability`.

    Returns:
        Weights and constant; the probability of the model times the share is the fitted probability.

    Raises:
        ValueError: if all are right, or none.
    """
    if is_right.all() or not is_right.any():
        raise ValueError(f"is_right: expected right and wrong registrations, got {is_right.sum()} of {len(is_right)}")
    mean, scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
    standard = np.column_stack([(features - mean) / scale, np.ones(len(features))])
    with np.errstate(divide="ignore"):
        log_rest = np.log1p(-np.broadcast_to(shares, len(features)))  # -inf for a share of 1

    def loss(weights: Float[np.ndarray, " w"]) -> tuple[float, Float[np.ndarray, " w"]]:
        margins = standard @ weights
        # -log(p) of a right example and -log(1 - share p) of a wrong one; the share of a right one is a constant.
        of_wrong = np.logaddexp(0, margins) - np.logaddexp(0, margins + log_rest)
        losses = np.where(is_right, np.logaddexp(0, -margins), of_wrong)
        slopes = np.where(is_right, -expit(-margins), expit(margins) - expit(margins + log_rest))
        ridge = RIDGE * np.append(weights[:-1], 0.0)
        return float(losses.mean() + ridge @ weights / 2), standard.T @ slopes / len(slopes) + ridge

    found = scipy.optimize.minimize(loss, np.zeros(standard.shape[1]), jac=True, method="L-BFGS-B").x
    weights = found[:-1] / scale
    return tuple(weights.tolist()), float(found[-1] - weights @ mean)


def with_confidence(match: Registration, evidence: MatchEvidence, calibration: Calibration | None) -> Registration:
    """Sets the confidence of a registration to the calibrated probability.

    Args:
        match: a registration.
        evidence: its features.
        calibration: None leaves the mean score.

    Returns:
        The registration.
    """
    verified = match.verification
    is_empty = int(match.num_inliers) == 0 and (verified is None or verified.matched_share == 0)
    if calibration is None or is_empty:
        return match
    return replace(match, confidence=jax.numpy.float32(calibrated_probability(calibration, evidence)))
