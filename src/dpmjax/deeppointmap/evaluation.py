"""Evaluation of a model on pairs of raw scans of a drive: registration after each stage of `register`, and overlap.

pairs = read_scan_pairs(drive, draw_scan_pairs(drive, "near", 30))
motions = [register_in_stages(model, pair).refined for pair in pairs]

Each scan is turned by a random yaw.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.deeppointmap.confidence import MatchEvidence, calibrated_probability, gather_evidence
from dpmjax.deeppointmap.encoding import descriptors_of, encode, prepare_scans
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.overlap_prediction import OVERLAP_M, overlap_pairs
from dpmjax.deeppointmap.registration import distinct_motions, match_clouds
from dpmjax.geometry import se2
from dpmjax.geometry.rigid import inverse
from dpmjax.metrics.drives import path_lengths
from dpmjax.scan.lidar.choose import choose_motion, refine_motion
from dpmjax.sequences import LidarSequence
from dpmjax.types import DescriptorCloud, Pose, Poses

# Scans between `OVERLAP_M` and this apart may see the same place; the evaluation leaves them out.
NO_OVERLAP_M = 40.0

# A revisit is at least this distance of driving after the first visit, metres.
REVISIT_PATH_M = 100.0

# Distances between the scans of a pair; scans of "far" do not overlap.
DISTANCE_BANDS_M = {"near": (2.0, 10.0), "middle": (10.0, 20.0), "far": (60.0, np.inf)}

PAIR_STREAM, REVISIT_STREAM = 4127, 4133

# Share of the path of a drive, at its end, that is held out of training.
HELD_OUT_SHARE = 0.1

# Scans within this distance of a held-out one see the same place, and are not trained on either.
HELD_OUT_MARGIN_M = 20.0


class ScanPair(NamedTuple):
    """Two scans and the true motion between them.

    Attributes:
        source: points, metres, in the frame of the turned lidar.
        target: points of the second scan.
        T_target_source: the true motion.
    """

    source: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 3"]
    T_target_source: Pose


class PlaceSplit(NamedTuple):
    """Numbers of the scans of a drive that are trained on, and of those of held-out places.

    Attributes:
        training: scans that are trained on.
        held_out: scans of the last places; empty where too little would remain.
    """

    training: Int[np.ndarray, " n"]
    held_out: Int[np.ndarray, " m"]


def split_places(drive: LidarSequence) -> PlaceSplit:
    """Holds out the last tenth of the path of a drive, and leaves out all scans near it, earlier passes included.

    The margin is 20 m, or a tenth of the path if that is shorter. If less than half of the scans would remain, as in a
    room, nothing is held out.

    Args:
        drive: scans with true poses.

    Returns:
        The numbers of the scans.

    Raises:
        ValueError: if the drive has no poses.
    """
    rows = np.flatnonzero(drive.has_reference)
    poses = true_poses(drive)[rows]
    path = path_lengths(poses)
    length_m = float(path.max(initial=0.0))
    is_held_out = path > (1 - HELD_OUT_SHARE) * length_m
    margin_m = min(HELD_OUT_MARGIN_M, HELD_OUT_SHARE * length_m)
    positions = poses[:, :3, 3]
    # Without held-out scans all distances are infinite.
    is_near = np.asarray(cKDTree(positions[is_held_out]).query(positions)[0]) < margin_m
    is_trained = ~is_held_out & ~is_near
    if np.sum(is_trained) < len(rows) / 2 or np.sum(is_held_out) < 2:
        return PlaceSplit(rows, rows[:0])
    return PlaceSplit(rows[is_trained], rows[is_held_out])


def draw_scan_pairs(drive: LidarSequence, band: str, num_pairs: int, *, seed: int = 0) -> Int[np.ndarray, "p 2"]:
    """Draws pairs of scans at the distances of a band, without repetition.

    Args:
        drive: scans with true poses.
        band: one of `DISTANCE_BANDS_M`.
        num_pairs: number of pairs.
        seed: seed of the draw; each band has draws of its own.

    Returns:
        Numbers of the scans; fewer pairs where the drive has fewer.

    Raises:
        ValueError: if the drive has no poses.
    """
    number = list(DISTANCE_BANDS_M).index(band)
    rng = np.random.default_rng([PAIR_STREAM, number, seed])
    return draw_rows_apart(scan_distances(drive), *DISTANCE_BANDS_M[band], num_pairs, rng)


def read_scan_pairs(drive: LidarSequence, pairs: Int[np.ndarray, "p 2"], *, seed: int = 0) -> Iterator[ScanPair]:
    """Reads the scans of pairs, each turned by a random yaw.

    Args:
        drive: scans with true poses.
        pairs: numbers of the scans.
        seed: seed of the yaws.

    Yields:
        The pairs in order.

    Raises:
        ValueError: if the drive has no poses, or a scan cannot be read.
    """
    poses = true_poses(drive)
    rng = np.random.default_rng([PAIR_STREAM, len(DISTANCE_BANDS_M), seed])
    for pair in pairs:
        (source, T_source), (target, T_target) = (turn_scan(drive.read_scan(int(row)), poses[row], rng) for row in pair)
        yield ScanPair(source, target, inverse(T_target) @ T_source)


def turn_scan(
    points: Float[np.ndarray, "n 3"], T_world_lidar: Pose, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Pose]:
    """Turns a scan about the vertical by a random yaw, as if the lidar had another heading.

    Args:
        points: metres, in the frame of the lidar.
        T_world_lidar: true pose.
        rng: source of the yaw.

    Returns:
        float32 points in the turned frame, and its pose.
    """
    T = np.eye(4)
    T[:2, :2] = se2.rotation(np.asarray(rng.uniform(-np.pi, np.pi)))
    return (points @ T[:3, :3].T).astype(np.float32), T_world_lidar @ inverse(T)


def true_poses(drive: LidarSequence) -> Poses:
    """Returns the true poses of a drive.

    Args:
        drive: scans with poses.

    Returns:
        `T_world_lidar`, metres.

    Raises:
        ValueError: if it has none.
    """
    if drive.T_world_lidar is None:
        raise ValueError(f"drive: expected a true pose for each scan, got none in {drive.name}")
    return drive.T_world_lidar


def scan_distances(drive: LidarSequence) -> Float[np.ndarray, "n n"]:
    """Computes the distances between all scans of a drive.

    Args:
        drive: scans with true poses.

    Returns:
        Metres between the positions of the lidar.

    Raises:
        ValueError: if the drive has no poses.
    """
    positions = true_poses(drive)[:, :3, 3]
    return np.linalg.norm(positions[:, None] - positions[None], axis=2)


def draw_rows_apart(
    distances_m: Float[np.ndarray, "n n"], least_m: float, most_m: float, num_pairs: int, rng: np.random.Generator
) -> Int[np.ndarray, "p 2"]:
    """Draws pairs of scans at a distance of each other, without repetition.

    Args:
        distances_m: distances between all scans, metres.
        least_m: smallest distance of a pair, metres.
        most_m: largest one.
        num_pairs: number of pairs.
        rng: source of the draws.

    Returns:
        Rows of the scans; fewer pairs where there are fewer.
    """
    return draw_rows(np.argwhere((distances_m >= least_m) & (distances_m <= most_m)), num_pairs, rng)


def draw_rows(candidates: Int[np.ndarray, "k 2"], num_pairs: int, rng: np.random.Generator) -> Int[np.ndarray, "p 2"]:
    """Draws some of the candidates, without repetition.

    Args:
        candidates: rows of the scans of each.
        num_pairs: number of pairs.
        rng: source of the draws.

    Returns:
        The drawn ones; fewer where there are fewer.
    """
    if len(candidates) == 0:
        return candidates
    return candidates[rng.choice(len(candidates), min(num_pairs, len(candidates)), replace=False)]


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
    settings, calibration, begun = model.config.verification, model.config.calibration, time.perf_counter()
    source, target = prepare_scans(model, (pair.source, pair.target))
    clouds = descriptors_of(source), descriptors_of(target)
    hypotheses = match_clouds(model, *clouds, config=model.config.matching)
    motions = distinct_motions(hypotheses)
    verified = choose_motion(source, target, motions, settings)
    refined = refine_motion(source, target, verified, settings)
    evidence = gather_evidence(hypotheses, verified.row, verified.verification)
    mean_score = float(evidence.of_clouds[1])
    return StagedRegistration(
        descriptors=motions[0],
        verified=verified.T_target_source,
        refined=refined.T_target_source,
        evidence=evidence,
        confidence=mean_score if calibration is None else calibrated_probability(calibration, evidence),
        seconds=time.perf_counter() - begun,
    )


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
