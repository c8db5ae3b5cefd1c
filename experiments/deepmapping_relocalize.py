"""Draws how well a fit re-localises unseen scans, at every free pixel of a world (DeepMapping figure 7).

    dpmjax map2d --world 1 --init zero -o run
    python -m experiments.deepmapping_relocalize run

RUN is a folder of `dpmjax map2d` on a built-in world. L-Net is trained on the poses that the fit has found; it proposes
poses of each scan, and M-Net chooses. Headings are random and unknown. Beside it stands L-Net alone, as in the paper:
the scans have the heading of the nearest scan of the fit, and the output of L-Net is the pose. That L-Net is the one of
the fit where a single one moved all scans from zero poses, as with --preset paper; else it is trained on the poses of
the fit. Written beside the results of RUN: relocalization.json, and relocalization.npz with the
numbers of each scan.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import ScanSet, cli, metrics, simulation
from dpmjax import deepmapping as dm
from dpmjax.geometry import se2
from dpmjax.io import ScanSequence

EXPERIMENT = "deepmapping_relocalize"
# A fit counts as a success below this error (section 4.1); so does a re-localisation.
_RIGHT_PX = 20.0
# Scans of a batch.
_CHUNK = 256
# Training steps of L-Net on the poses of the run.
_NUM_STEPS = 5000
_BINS_PX = (0.0, 10.0, 20.0, 50.0, 100.0, 1500.0)


@dataclass(frozen=True)
class Config:
    """Options of the picture."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run of `dpmjax map2d` on a built-in world."""
    stride_px: Annotated[int, arg(metavar="PX")] = 6
    """A scan is taken at the centre of every free square of this side."""
    seed: int = 0
    """Seed of the training."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, stride_px=1)


def main(config: Config) -> None:
    """Loads the run, trains L-Net on its poses, re-localises scans everywhere, draws, writes."""
    import jax

    run = cli.read_map2d_run(config.run)
    if run.world is None:
        raise ValueError(f"{config.run} is a run on {run.sequence.name}, whose world is needed; use a built-in one")
    sequence, fitted = run.sequence, run.fitted
    grid = simulation.make_world(run.world).is_obstacle
    truth = free_poses(grid, config)
    begun = time.perf_counter()
    scans = ScanSet(sequence.points, sequence.mask)
    trained = dm.train_localization(fitted, scans, num_steps=_NUM_STEPS, key=jax.random.key(config.seed))
    jax.block_until_ready(trained.params)
    training_s, begun = time.perf_counter() - begun, time.perf_counter()
    found = dm.relocalize(trained, scan_all(grid, truth, sequence))
    relocalization_s = time.perf_counter() - begun
    errors, turns = errors_at(found.pose, truth, fitted, sequence)
    queries = Queries(errors, turns, found.is_known, is_mapped(truth, fitted, sequence), found.nats)
    has_one_net = can_localize_alone(fitted)
    turned = turn_to_nearest(truth, sequence)
    poses = localize_alone(fitted if has_one_net else trained, scan_all(grid, turned, sequence))
    errors, turns = errors_at(poses, turned, fitted, sequence)
    alone = queries._replace(errors=errors, turns=turns)
    report = {
        "world": sequence.name,
        "num_scans": len(sequence),
        "num_poses": len(truth),
        **summarise(queries, truth, sequence),
        "lnet_alone": {
            "network": "of the fit" if has_one_net else "trained on the poses of the fit",
            "groups": summarise(alone, truth, sequence)["groups"],
        },
        "training_s": training_s,
        "relocalization_s": relocalization_s,
        "seed": config.seed,
        **cli.environment(),
    }
    cli.write_json(config.run / "relocalization.json", report)
    np.savez(config.run / "relocalization.npz", truth=truth, errors_alone=alone.errors, **queries._asdict())
    print(lines_of(report), f"results in {config.run}", sep="\n")


class Queries(NamedTuple):
    """Results of the scans, (m,) each.

    Attributes:
        errors: distance to the truth, px.
        turns: error of the heading, degrees.
        is_known: True where the view is in the map, by the fit.
        is_mapped: taken where some beam of the fit's scans has passed.
        nats: cost of a beam by the map.
    """

    errors: np.ndarray
    turns: np.ndarray
    is_known: np.ndarray
    is_mapped: np.ndarray
    nats: np.ndarray


def free_poses(grid: np.ndarray, config: Config) -> np.ndarray:
    """Returns (m, 3) poses of random headings at the centres of the free squares."""
    half = config.stride_px // 2
    rows, columns = np.nonzero(~grid[half :: config.stride_px, half :: config.stride_px])
    places = np.column_stack([columns, rows]) * config.stride_px + half + 0.5
    headings = np.random.default_rng([config.seed, 7]).uniform(-np.pi, np.pi, len(places))
    return np.column_stack([places, headings])


def scan_all(grid: np.ndarray, poses: np.ndarray, sequence: ScanSequence) -> ScanSet:
    """Returns the scans at poses, with the number of beams of the sequence."""
    return ScanSet(*simulation.scan_world(grid, poses, num_beams=sequence.points.shape[1]))


def turn_to_nearest(truth: np.ndarray, sequence: ScanSequence) -> np.ndarray:
    """Returns the poses with the heading of the nearest scan of the fit."""
    from scipy.spatial import KDTree

    _, nearest = KDTree(sequence.reference_poses[:, :2]).query(truth[:, :2])
    return np.column_stack([truth[:, :2], sequence.reference_poses[nearest, 2]])


def can_localize_alone(fitted: dm.Fitted) -> bool:
    """Returns True where one L-Net has moved all scans of the fit from zero poses."""
    is_one = all(phase.poses == "network" and phase.scans_per_window is None for phase in fitted.config.cold_phases)
    return is_one and not np.any(np.asarray(fitted.params.start))


def localize_alone(fitted: dm.Fitted, scans: ScanSet) -> np.ndarray:
    """Returns the output of L-Net for each scan as its pose, in the world of the fit; no search, no M-Net."""
    parts = []
    for k in range(0, len(scans.points), _CHUNK):
        part = ScanSet(scans.points[k : k + _CHUNK] / fitted.unit, scans.mask[k : k + _CHUNK])
        found = dm.propose_poses(fitted.params.localization, part, num_turns=1, fit_config=fitted.config)
        parts.append(np.asarray(found[:, 0], np.float64))
    return np.concatenate(parts) * [fitted.unit, fitted.unit, 1.0]


def is_mapped(truth: np.ndarray, fitted: dm.Fitted, sequence: ScanSequence) -> np.ndarray:
    """Returns True for places of true poses that some beam of the fit's scans has passed."""
    picture = dm.map_picture(fitted, sequence.points, sequence.mask)
    T_fit_world = metrics.align_rigid(sequence.reference_poses[:, :2], fitted.poses[:, :2])
    places = truth[:, :2] @ T_fit_world[:2, :2].T + T_fit_world[:2, 2]
    x_min, x_max, y_min, y_max = picture.extent
    height, width = picture.explored.shape
    cells = np.floor((places - [x_min, y_min]) / [x_max - x_min, y_max - y_min] * [width, height]).astype(int)
    is_inside = ((cells >= 0) & (cells < [width, height])).all(axis=1)
    column, row = np.where(is_inside[:, None], cells, 0).T
    return is_inside & picture.explored[row, column]


def errors_at(
    poses: np.ndarray, truth: np.ndarray, fitted: dm.Fitted, sequence: ScanSequence
) -> tuple[np.ndarray, np.ndarray]:
    """Returns distance (px) and angle (degrees) to the truth, after the run's trajectory is aligned with it."""
    T = metrics.align_rigid(fitted.poses[:, :2], sequence.reference_poses[:, :2])
    moved = poses[:, :2] @ T[:2, :2].T + T[:2, 2]
    turn = se2.wrap_angle(poses[:, 2] + np.arctan2(T[1, 0], T[0, 0]) - truth[:, 2])
    return np.linalg.norm(moved - truth[:, :2], axis=1), np.degrees(np.abs(turn))


def summarise(queries: Queries, truth: np.ndarray, sequence: ScanSequence) -> cli.Row:
    """Returns the numbers of all mapped free space, of the known scans, and by the distance from the trajectory."""
    from scipy.spatial import KDTree

    distance, _ = KDTree(sequence.reference_poses[:, :2]).query(truth[:, :2])
    known, mapped, is_right = queries.is_known, queries.is_mapped, queries.errors < _RIGHT_PX
    groups = [("mapped", mapped), ("mapped and known", mapped & known), ("known", known), ("not mapped", ~mapped)]
    groups += [
        (f"mapped, {low:.0f} to {high:.0f} px from the trajectory", mapped & (distance >= low) & (distance < high))
        for low, high in itertools.pairwise(_BINS_PX)
    ]
    return {
        "groups": {name: _numbers(queries, rows) for name, rows in groups if rows.any()},
        "precision_of_known": float(is_right[known].mean()) if known.any() else None,
        "share_of_mapped_known": float(known[mapped].mean()),
        "share_of_unmapped_known": float(known[~mapped].mean()),
    }


def _numbers(queries: Queries, rows: np.ndarray) -> cli.Row:
    return {
        "num_poses": int(rows.sum()),
        "median_px": float(np.median(queries.errors[rows])),
        "median_deg": float(np.median(queries.turns[rows])),
        "share_below_20_px": float((queries.errors[rows] < _RIGHT_PX).mean()),
        "share_known": float(queries.is_known[rows].mean()),
    }


def lines_of(report: cli.Row) -> str:
    """Returns the numbers of each group of scans for the console."""

    def line(name: str, row: cli.Row) -> str:
        errors = f"median {row['median_px']:.1f} px, {row['median_deg']:.1f} degrees"
        return f"{name}: {row['num_poses']} scans, {errors}, {row['share_below_20_px']:.0%} below {_RIGHT_PX:.0f} px"

    lines = [f"{line(name, row)}, {row['share_known']:.0%} called known" for name, row in report["groups"].items()]
    lines += [line(f"L-Net alone, {name}", row) for name, row in report["lnet_alone"]["groups"].items()]
    precision = report["precision_of_known"]
    answer = "none is called known" if precision is None else f"{precision:.1%} of those called known are right"
    known = f"{answer}; {report['share_of_mapped_known']:.0%} of the mapped ones are called known"
    return "\n".join([*lines, known])


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
