"""Fits the probability that `register` gives for two planar scans and for two depth images.

    python -m experiments.pair_probability planar                     pairs of simulated walks; a fit
    python -m experiments.pair_probability depth
    python -m experiments.pair_probability planar LOG.gz ...          pairs of logs with references: no fit, a check

Pairs of scans, one to a hundred steps apart, are registered without a first guess. The file rows.csv has the evidence
of each and whether it is right: within a twentieth of the typical range (depth: 0.1 m) and 3 degrees. A logistic
regression with equal weight of right and wrong pairs gives the constants in `pair_registration.py` of both rooms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

import dpmjax
from dpmjax import cli, io, metrics, simulation
from dpmjax import deeppointmap as dpm
from dpmjax.geometry import rigid, se2, se3
from dpmjax.scan import PairEvidence

NUM_SCANS, PLANAR_STEPS, DEPTH_STEPS = 160, (1, 4, 8, 16, 32, 64, 128), (1, 1, 2, 3)
RIGHT_SHARE, RIGHT_M, RIGHT_RAD, SURE = 0.05, 0.1, np.radians(3.0), 0.9
# No other setting was chosen on these worlds and apartments.
FIRST = 2000


@dataclass(frozen=True, kw_only=True)
class PairOptions(cli.RunOptions):
    """Options of the run."""

    sensor: Annotated[Positional[Literal["planar", "depth"]], arg(metavar="planar|depth")]
    """Sensor of the scans."""
    logs: Annotated[Positional[tuple[Path, ...]], arg(metavar="[LOG ...]")] = ()
    """Planar logs with references, to check the fit on."""
    walks: Annotated[int, arg(metavar="N")] = 100
    """Number of simulated walks."""
    pairs: Annotated[int, arg(metavar="N")] = 12
    """Number of pairs of each."""


def main(options: PairOptions, run: cli.Run) -> cli.Row:
    """Registers the pairs, and fits or checks."""
    run.open()
    walks = range(len(options.logs) or options.walks)
    cases = [{"walk": walk, "pair": pair} for walk in walks for pair in range(options.pairs)]
    read = lru_cache(maxsize=2)(partial(read_walk, options))
    rows = cli.fill_table(run, cases, partial(register_pair, options, read))
    if not rows:
        return {"num_pairs": 0}
    is_right, confidence = (np.array([row[name] for row in rows], float) for name in ("is_right", "confidence"))
    is_sure = confidence >= SURE
    numbers: cli.Row = {
        "num_pairs": len(rows),
        "num_right": int(is_right.sum()),
        "num_sure": int(is_sure.sum()),
        "num_sure_and_wrong": int((is_sure & (is_right == 0)).sum()),
        "brier": metrics.brier_score(confidence, is_right),
    }
    if not options.logs and 0 < is_right.sum() < len(rows):
        features = [PairEvidence(*(float(row[name]) for name in PairEvidence._fields)).features() for row in rows]
        weights, bias = dpm.fit_weights(np.array(features), is_right.astype(bool))
        share = is_right.mean()
        numbers |= {"weights": list(weights), "bias": float(bias - np.log(share / (1 - share)))}
    return numbers


def read_walk(options: PairOptions, walk: int) -> Any:
    """Returns a log, or simulates a walk of a sensor with a field of view, range and noise of its own."""
    if options.logs:
        return io.read_sequence(options.logs[walk])
    seed = FIRST + walk
    if options.sensor == "depth":
        config = simulation.HARD_WALK if walk % 2 else simulation.DepthWalkConfig()
        return simulation.simulate_depth_sequence(seed, 16, seed=seed, config=config)
    rng = np.random.default_rng(seed)
    noise, beams = float(rng.choice([0.0, 0.5, 1.0, 2.0, 4.0])), int(rng.choice([180, 256, 360, 512]))
    world = ("office", "yard", "clinic", "grove")[walk // 3 % 4] if walk % 3 == 0 else seed
    sequence = simulation.simulate_sequence(world, NUM_SCANS, num_beams=2 * beams, range_noise_px=noise, seed=seed)
    ranges = np.linalg.norm(sequence.points, axis=-1)
    bearings = np.arctan2(sequence.points[..., 1], sequence.points[..., 0])
    mask = sequence.mask & (np.abs(bearings) < rng.choice([0.5, 0.75, 1.0]) * np.pi)
    mask &= ranges < np.quantile(ranges[mask], rng.choice([0.6, 0.8, 0.95, 1.0]))
    return io.ScanSequence(sequence.name, sequence.points, mask, "px", sequence.reference_poses)


def register_pair(options: PairOptions, read: Any, walk: int, pair: int) -> cli.Row:
    """Registers a pair; every fourth pair of a simulated planar walk joins two worlds, so that no motion is right."""
    is_planar, rng, sequence = options.sensor == "planar", np.random.default_rng((walk, pair)), read(walk)
    is_apart = is_planar and not options.logs and pair % 4 == 3 and walk > 0
    other = read(walk - 1) if is_apart else sequence
    ends = rng.integers(len(sequence)), rng.integers(len(other))
    if not is_apart:
        step = min(int(rng.choice(PLANAR_STEPS if is_planar else DEPTH_STEPS)), len(sequence) - 1)
        first = int(rng.integers(len(sequence) - step))
        ends = (first, first + step) if rng.random() < 0.5 else (first + step, first)
    scans = [each.points[end] for each, end in zip((sequence, other), ends, strict=True)]
    if is_planar:
        scans = [each.points[end][each.mask[end]] for each, end in zip((sequence, other), ends, strict=True)]
    found = dpmjax.register(None, *scans)
    numbers = {"confidence": found.confidence, **found.evidence._asdict()}
    return {**numbers, "is_right": not is_apart and is_right(options, sequence, ends, found.T_target_source)}


def is_right(options: PairOptions, sequence: Any, ends: tuple[Any, Any], T_target_source: np.ndarray) -> bool:
    """Compares a motion with that of the reference poses."""
    if options.sensor == "depth":
        T = rigid.inverse(sequence.T_world_camera[ends[1]]) @ sequence.T_world_camera[ends[0]]
        return se3.are_near(T, T_target_source, RIGHT_M, RIGHT_RAD)
    true = se2.relative(sequence.reference_poses[ends[1]], sequence.reference_poses[ends[0]])
    apart = se2.from_matrix(T_target_source) - true
    ranges = np.linalg.norm(sequence.points, axis=-1)[sequence.mask]
    limit = RIGHT_SHARE * np.percentile(ranges, 90)
    return bool(np.hypot(*apart[:2]) < limit and abs(se2.wrap_angle(apart[2])) < RIGHT_RAD)


if __name__ == "__main__":
    cli.run_experiment(main)
