"""Pairs of scans with known motion: drawn from a drive, registered stage by stage, and compared with the truth."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from dpmjax.deeppointmap import Model, encode
from dpmjax.deeppointmap.confidence import Evidence, gather_evidence
from dpmjax.deeppointmap.evaluation import draw_rows_apart
from dpmjax.deeppointmap.scan_registration import distinct_motions, match_clouds
from dpmjax.deeppointmap.verification import choose_motion, measure_scan, refine_motion
from dpmjax.geometry import rigid, se2
from dpmjax.io import LidarSequence

# Distances between the scans of a pair, metres; scans of "far" do not overlap.
BANDS = {"near": (2.0, 10.0), "middle": (10.0, 20.0), "far": (60.0, np.inf)}
PAIR_STREAM = 4127


class ScanPair(NamedTuple):
    """Two scans, each turned by a random yaw, and the true motion between them.

    Attributes:
        source: (n, 3) points, metres.
        target: the same of the other scan.
        T_target_source: the true motion.
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray


class PairResult(NamedTuple):
    """What a model found for one pair.

    Attributes:
        motions: by stage: "descriptors" (the best hypothesis of the network), "verified", "refined".
        evidence: what the confidence rests on.
        seconds: by stage, both scans together.
    """

    motions: dict[str, np.ndarray]
    evidence: Evidence
    seconds: dict[str, float]


def draw_pairs(drive: LidarSequence, band: str, num_pairs: int, seed: int) -> np.ndarray:
    """Returns (p, 2) rows of scans whose distance is in the band; fewer where the drive has fewer."""
    rng = np.random.default_rng([PAIR_STREAM, list(BANDS).index(band), seed])
    return draw_pairs_within(drive, BANDS[band], num_pairs, rng)


def draw_pairs_within(
    drive: LidarSequence, limits_m: tuple[float, float], num_pairs: int, rng: np.random.Generator
) -> np.ndarray:
    """Returns (p, 2) rows of scans whose distance is within limits; fewer where the drive has fewer."""
    assert drive.T_world_lidar is not None
    positions = drive.T_world_lidar[:, :3, 3]
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    return draw_rows_apart(distances, *limits_m, num_pairs, rng)


def read_pairs(drive: LidarSequence, pairs: np.ndarray, seed: int) -> Iterator[ScanPair]:
    """Reads the scans of pairs, each turned by a random yaw."""
    assert drive.T_world_lidar is not None
    rng = np.random.default_rng([PAIR_STREAM, len(BANDS), seed])
    for pair in pairs:
        scans, poses = [], []
        for row in pair:
            T = np.eye(4)
            T[:2, :2] = se2.rotation(np.asarray(rng.uniform(-np.pi, np.pi)))
            scans.append((drive.read_scan(int(row)) @ T[:3, :3].T).astype(np.float32))
            poses.append(drive.T_world_lidar[row] @ rigid.inverse(T))
        yield ScanPair(scans[0], scans[1], rigid.inverse(poses[1]) @ poses[0])


def register_pair(model: Model, pair: ScanPair) -> PairResult:
    """Registers a pair as `dpmjax.register` does, with the time of each stage."""
    clock = Clock()
    clouds = [jax.block_until_ready(encode(model, points)) for points in (pair.source, pair.target)]
    clock.stop("encode")
    settings = model.config.verification
    measured = [measure_scan(points, settings) for points in (pair.source, pair.target)]
    clock.stop("measure")
    hypotheses = match_clouds(model, *clouds, config=model.config.matching)
    motions = distinct_motions(hypotheses)
    clock.stop("match")
    verified = choose_motion(*measured, motions, settings)
    clock.stop("verify")
    refined = refine_motion(*measured, verified, settings)
    clock.stop("refine")
    evidence = gather_evidence(hypotheses, verified.row, verified.verification)
    found = {"descriptors": motions[0], "verified": verified.T_target_source, "refined": refined.T_target_source}
    return PairResult(found, evidence, clock.seconds)


class Clock:
    """Adds up the seconds of stages.

    Attributes:
        seconds: by stage.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, stage: str) -> None:
        """Ends a stage; the next one begins."""
        now = time.perf_counter()
        self.seconds[stage], self._last = now - self._last, now


def median_seconds(results: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Returns the median of each stage and of the whole."""
    if not results:
        return {}
    stages = {f"{stage}_s": float(np.median([r[stage] for r in results])) for stage in results[0]}
    return {**stages, "pair_s": float(np.median([sum(r.values()) for r in results]))}
