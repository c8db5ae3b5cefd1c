"""Evaluation of a model on pairs of raw scans of a drive: registration after each stage of `register`, and overlap.

pairs = read_scan_pairs(drive, draw_scan_pairs(drive, "near", 30))
evaluation = evaluate_scan_pairs(model, pairs)
evaluation.refined.recall
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.deeppointmap.confidence import MatchEvidence, calibrated_probability, gather_evidence
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.evaluation_pairs import ScanPair, draw_rows, scan_distances, true_poses, turn_scan
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.motion_choice import choose_motion, refine_motion
from dpmjax.deeppointmap.overlap_prediction import OVERLAP_M, overlap_pairs
from dpmjax.deeppointmap.scan_registration import distinct_motions, match_clouds
from dpmjax.metrics.drives import path_lengths
from dpmjax.metrics.statistics import area_under_curve, brier_score
from dpmjax.scans.lidar import measure_scan
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, Pose

# Scans between `OVERLAP_M` and this apart may see the same place; the evaluation leaves them out.
NO_OVERLAP_M = 40.0

# A revisit is at least this distance of driving after the first visit, metres.
REVISIT_PATH_M = 100.0

REVISIT_STREAM = 4133


class StagedRegistration(NamedTuple):
    """A registration with the motion after each stage.

    Attributes:
        descriptors: `T_target_source` of the best hypothesis of the network alone.
        verified: motion under which the scans agree best.
        refined: verified motion after the final alignment.
        evidence: features of the confidence of the verified motion.
        confidence: a probability where the model is calibrated, else the mean score of the pairs of descriptors.
        seconds: seconds of all stages.
    """

    descriptors: Pose
    verified: Pose
    refined: Pose
    evidence: MatchEvidence
    confidence: float
    seconds: float


def register_in_stages(model: Model, pair: ScanPair) -> StagedRegistration:
    """Registers a pair as `register` does with `refine=True`, and keeps the motion after each stage.

    Scans of fewer than 20 descriptors, which `register` does not register, are treated as all others.

    Args:
        model: encoder and decoder.
        pair: two scans.

    Returns:
        The motion after each stage.
    """
    settings, begun = model.config.verification, time.perf_counter()
    scans = pair.source, pair.target
    clouds = [encode(model, points) for points in scans]
    source, target = (measure_scan(points, settings.surface) for points in scans)
    hypotheses = match_clouds(model, *clouds, config=model.config.matching)
    motions = distinct_motions(hypotheses)
    verified = choose_motion(source, target, motions, settings)
    refined = refine_motion(source, target, verified, settings)
    evidence = gather_evidence(hypotheses, verified.row, verified.verification)
    return StagedRegistration(
        descriptors=motions[0],
        verified=verified.T_target_source,
        refined=refined.T_target_source,
        evidence=evidence,
        confidence=_confidence(model, evidence),
        seconds=time.perf_counter() - begun,
    )


def _confidence(model: Model, evidence: MatchEvidence) -> float:
    calibration = model.config.calibration
    if calibration is None:
        return float(evidence.of_clouds[1])
    return calibrated_probability(calibration, evidence)


class OverlapEvaluation(NamedTuple):
    """Overlap probabilities of pairs.

    Attributes:
        probability: overlap probability of each pair.
        is_overlap: True for scans less than 20 m apart.
        has_revisits: True if the overlapping pairs are revisits, because the drive comes back to places.
        by_head: probability by the overlap head of a model that has a regression, too; None for other models.
    """

    probability: Float[np.ndarray, " p"]
    is_overlap: Bool[np.ndarray, " p"]
    has_revisits: bool
    by_head: Float[np.ndarray, " p"] | None = None

    @property
    def area_under_curve(self) -> float:
        """Share of comparisons in which the overlapping pair has the higher probability; NaN without pairs."""
        return area_under_curve(self.probability, self.is_overlap)

    @property
    def brier_score(self) -> float:
        """Mean squared error of the probabilities; NaN without pairs."""
        return brier_score(self.probability, self.is_overlap)


def evaluate_overlap(model: Model, drive: LidarSequence, num_pairs: int, *, seed: int = 0) -> OverlapEvaluation:
    """Predicts the overlap of pairs nearer than 20 m, and of pairs farther than 40 m.

    The near pairs are revisits if the drive comes back to places. Each scan is turned by a random yaw.

    Args:
        model: encoder and decoder.
        drive: scans with true poses.
        num_pairs: pairs of each of the two kinds; fewer where the drive has fewer.
        seed: seed of the draws.

    Returns:
        The probabilities; none where the drive lacks pairs of one kind.

    Raises:
        ValueError: if the drive has no poses, or a scan cannot be read.
    """
    near, far, has_revisits = overlap_candidates(drive)
    rng = np.random.default_rng([REVISIT_STREAM, seed])
    if min(len(near), len(far)) == 0:
        return OverlapEvaluation(np.zeros(0), np.zeros(0, bool), has_revisits)
    near, far = draw_rows(near, num_pairs, rng), draw_rows(far, num_pairs, rng)
    pairs = np.concatenate([near, far])
    sides = encode_pairs(model, [drive], pairs, rng=rng)
    by_head = None if model.config.overlap is None else head_overlap(model, sides)
    probability = np.asarray(overlap_pairs(model, *sides), float)
    return OverlapEvaluation(probability, np.arange(len(pairs)) < len(near), has_revisits, by_head)


def encode_pairs(
    model: Model, drives: Sequence[LidarSequence], pairs: Int[np.ndarray, "p 2"], *, rng: np.random.Generator
) -> tuple[list[DescriptorCloud], ...]:
    """Encodes the scans of pairs, each turned by a random yaw.

    Args:
        model: encoder.
        drives: drives with scans.
        pairs: scans of each pair, counted through all drives.
        rng: source of the yaws.

    Returns:
        Descriptors of the first scans, and of the second ones, as arrays of NumPy.
    """
    scans = [(drive, number) for drive in drives for number in range(len(drive))]
    clouds = {}
    for row in np.unique(pairs).tolist():
        drive, number = scans[row]
        points, _ = turn_scan(drive.read_scan(number), np.eye(4), rng)
        clouds[row] = jax.device_get(encode(model, points))
    return tuple([clouds[row] for row in side] for side in pairs.T.tolist())


def head_overlap(model: Model, sides: tuple[list[DescriptorCloud], ...]) -> Float[np.ndarray, " p"] | None:
    """Computes the overlap probabilities of pairs by the head of a model that may have a regression, too.

    Args:
        model: encoder and decoder.
        sides: descriptors from `encode_pairs`.

    Returns:
        The probabilities; None where the head is not trained.
    """
    if "overlap" not in model.config.trained:
        return None
    return np.asarray(overlap_pairs(replace(model, config=replace(model.config, overlap=None)), *sides), float)


def overlap_candidates(drive: LidarSequence) -> tuple[Int[np.ndarray, "k 2"], Int[np.ndarray, "l 2"], bool]:
    """Finds all pairs of a drive that overlap, and all that surely do not.

    Args:
        drive: scans with true poses.

    Returns:
        Pairs nearer than 20 m, which are revisits if there are some; pairs farther than 40 m; True if there
        are revisits.

    Raises:
        ValueError: if the drive has no poses.
    """
    distances = scan_distances(drive)
    path = np.full(len(drive), np.nan)
    path[drive.has_reference] = path_lengths(true_poses(drive)[drive.has_reference])
    is_near = (distances < OVERLAP_M) & (distances > 0)
    is_revisit = is_near & (np.abs(path[:, None] - path[None]) > REVISIT_PATH_M)
    has_revisits = bool(is_revisit.any())
    return np.argwhere(is_revisit if has_revisits else is_near), np.argwhere(distances > NO_OVERLAP_M), has_revisits
