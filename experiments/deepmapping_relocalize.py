"""Measures how well a fit re-localises unseen scans, at every free place of a world (DeepMapping figure 7).

    python -m experiments.deepmapping_relocalize --world 1 --stride-px 24
    python -m experiments.deepmapping_relocalize --init zero --preset paper

256 scans of a built-in world are fitted, and L-Net is trained on the poses of the fit. For each unseen scan L-Net
proposes poses, and M-Net chooses. Headings are random and unknown. Beside it stands L-Net alone, as in the paper: the
scans have the heading of the nearest scan of the fit, and the output of L-Net is the pose. If a single L-Net moved all
scans of the fit from zero poses, as with --preset paper, this L-Net is used. Otherwise L-Net is trained on the poses of
the fit. A pose is right within 20 px. The file table.md has the errors by the distance from the trajectory, places.npz
those of each scan.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import numpy as np
from scipy.spatial import KDTree
from tyro.conf import arg

from dpmjax import ScanSet, cli, metrics, scan, simulation, slam
from dpmjax import deepmapping as dm
from dpmjax.geometry import se2
from dpmjax.io import ScanSequence

NUM_SCANS = 256
# A fit counts as a success below this error (section 4.1); so does a re-localisation.
RIGHT_PX = 20.0
# Scans of a batch, and training steps of L-Net on the poses of the fit.
CHUNK, NUM_STEPS = 256, 5000
BINS_PX = (10, 20, 50, 100)
COLUMNS = ("error_px", "turn_deg", "right", "known")


@dataclass(frozen=True, kw_only=True)
class RelocalizeOptions(cli.RunOptions):
    """Options of the experiment."""

    world: Literal[0, 1, 2, "grove"] = 0
    """Which built-in world."""
    init: Literal["icp-plane", "zero"] = "icp-plane"
    """Where the poses of the fit start."""
    preset: Literal["fast", "paper"] = "fast"
    """Settings of the fit."""
    stride_px: Annotated[int, arg(metavar="PX"), cli.Bound(1)] = 6
    """A scan is taken at the centre of every free square of this side."""


def main(options: RelocalizeOptions, run: cli.Run) -> cli.Row:
    """Fits, trains L-Net on the poses of the fit, re-localises scans everywhere, and writes the table."""
    run.open()
    sequence = simulation.simulate_sequence(options.world, NUM_SCANS, seed=options.seed)
    grid, key = simulation.make_world(options.world).is_obstacle, jax.random.key(options.seed)
    scans, start = ScanSet(sequence.points, sequence.mask), None
    if options.init == "icp-plane":
        start = slam.incremental_icp(scan.planar_scans(sequence.points, sequence.mask), "plane").poses
    fitted = dm.fit_deepmapping(scans, dm.preset(options.preset), key=key, start=start)
    begun = time.perf_counter()
    trained = jax.block_until_ready(dm.train_localization(fitted, scans, num_steps=NUM_STEPS, key=key))
    training_s, begun = time.perf_counter() - begun, time.perf_counter()
    truth = free_poses(grid, options)
    found = dm.relocalize(trained, scan_all(grid, truth, sequence))
    numbers = {"training_s": training_s, "relocalization_s": time.perf_counter() - begun}
    numbers["ate_of_fit_px"] = metrics.planar_errors(sequence, fitted.poses)["ate_px"]
    distance, nearest = KDTree(sequence.reference_poses[:, :2]).query(truth[:, :2])
    turned = np.column_stack([truth[:, :2], sequence.reference_poses[nearest, 2]])
    is_one = all(phase.poses == "network" and phase.scans_per_window is None for phase in fitted.config.cold_phases)
    # One L-Net has moved all scans from zero poses, or else the trained one is used.
    network = fitted if is_one and not np.any(np.asarray(fitted.params.start)) else trained
    alone = localize_alone(network, scan_all(grid, turned, sequence))
    names = np.array([f"{low} px or more from the scans" for low in (0, *BINS_PX)])
    places, is_known = names[np.digitize(distance, BINS_PX)], found.is_known
    errors_px, _ = ours = errors_at(found.pose, truth, fitted, sequence)
    errors = {"L-Net and M-Net": ours, "L-Net alone, known heading": errors_at(alone, turned, fitted, sequence)}
    rows = [
        dict(zip(("method", "place", *COLUMNS), (method, place, px, deg, bool(px < RIGHT_PX), known), strict=True))
        for method, of_method in errors.items()
        for place, known, px, deg in sorted(
            zip(places.tolist(), is_known.tolist(), *of_method, strict=True), key=lambda row: int(row[0].split()[0])
        )
    ]
    np.savez(run / "places.npz", truth=truth, errors_px=errors_px, is_known=is_known)
    numbers["precision_of_known"] = float((errors_px[is_known] < RIGHT_PX).mean()) if is_known.any() else None
    return numbers | cli.write_summary(run, cli.summarize(rows, ("method", "place"), COLUMNS))


def free_poses(grid: np.ndarray, options: RelocalizeOptions) -> np.ndarray:
    """Returns (m, 3) poses of random headings at the centres of the free squares."""
    half = options.stride_px // 2
    rows, columns = np.nonzero(~grid[half :: options.stride_px, half :: options.stride_px])
    places = np.column_stack([columns, rows]) * options.stride_px + half + 0.5
    headings = np.random.default_rng([options.seed, 7]).uniform(-np.pi, np.pi, len(places))
    return np.column_stack([places, headings])


def scan_all(grid: np.ndarray, poses: np.ndarray, sequence: ScanSequence) -> ScanSet:
    """Returns the scans at poses, with the number of beams of the sequence."""
    return ScanSet(*simulation.scan_world(grid, poses, num_beams=sequence.points.shape[1]))


def localize_alone(fitted: dm.Fitted, scans: ScanSet) -> np.ndarray:
    """Returns the output of L-Net for each scan as its pose, in the world of the fit; no search, no M-Net."""
    parts = []
    for k in range(0, len(scans.points), CHUNK):
        part = ScanSet(scans.points[k : k + CHUNK] / fitted.unit, scans.mask[k : k + CHUNK])
        found = dm.propose_poses(fitted.params.localization, part, num_turns=1, fit_config=fitted.config)
        parts.append(np.asarray(found[:, 0], np.float64))
    return np.concatenate(parts) * [fitted.unit, fitted.unit, 1.0]


def errors_at(
    poses: np.ndarray, truth: np.ndarray, fitted: dm.Fitted, sequence: ScanSequence
) -> tuple[np.ndarray, np.ndarray]:
    """Returns distance (px) and angle (degrees) to the truth, after the run's trajectory is aligned with it."""
    T = metrics.align_rigid(fitted.poses[:, :2], sequence.reference_poses[:, :2])
    moved = poses[:, :2] @ T[:2, :2].T + T[:2, 2]
    turn = se2.wrap_angle(poses[:, 2] + np.arctan2(T[1, 0], T[0, 0]) - truth[:, 2])
    return np.linalg.norm(moved - truth[:, :2], axis=1), np.degrees(np.abs(turn))


if __name__ == "__main__":
    cli.run_experiment(main)
