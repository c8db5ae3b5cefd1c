"""Fits the weights by which `register` scores motions: the evidence of two scans for a right motion.

    python -m experiments.dpm_evidence

Pairs of scans of simulated scenes are registered: out of doors and inside, whole and thinned to 1,400 points within 30
m. All hypotheses of a pair, by the network and by the search among views from above, are aligned and compared with the
truth. A logistic regression on `evidence_shares` predicts which are right. Results go to results/dpm_evidence/<time>/.
The file metrics.json has the weights for `dpmjax.deeppointmap.EvidenceWeights`. The file table.md has the share of
pairs whose right hypothesis has the highest score, scene by scene, each by a fit without this scene.
"""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass
from functools import partial
from typing import Any

import numpy as np

from dpmjax import cli, load_model, registration_recall, scans, simulation
from dpmjax import deeppointmap as dpm
from dpmjax.geometry import rigid

EXPERIMENT = "dpm_evidence"
# Far from the seeds of all other commands.
FIRST_SCENE = 6_500_000
WHOLE, THINNED = "whole", "thinned"
SCENES = tuple(
    (*scene.split(), points)
    for points, scenes in (
        (WHOLE, "suburb HDL64E, campus OS1_64, canyon HDL64E, country HDL32E, wood OS1_64, car_park HDL32E"),
        (WHOLE, "office HDL64E, hall OS1_64, flat OS1_64, office OS1_64, hall HDL32E"),
        (THINNED, "suburb HDL64E, suburb HDL32E, campus HDL32E, canyon HDL64E, country HDL32E, hall OS1_64"),
    )
    for scene in scenes.split(", ")
)
INDOORS = ("office", "hall", "flat")
BANDS = {"near": (2.0, 10.0), "far": (10.0, 20.0)}
BANDS_INDOORS = {"near": (1.0, 5.0), "far": (5.0, 12.0)}
# Pairs of each distance of each scene.
NUM_PAIRS = 20
NUM_POINTS, MAX_RANGE_M = 1400, 30.0
TILT_DEG = 1.0
LENGTH_M = 200.0


@dataclass(frozen=True, kw_only=True)
class Config(cli.ModelOptions, cli.RunOptions):
    """Options of the run."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seed=0)


def main(config: Config) -> list[cli.Row]:
    """Registers the pairs, fits, and writes weights and table."""
    cases = [
        {"scene": number, "kind": kind, "sensor": sensor, "points": points}
        for number, (kind, sensor, points) in enumerate(SCENES)
    ]

    def report(rows: list[cli.Row]) -> cli.Summary:
        if len(rows) < len(cases):
            return cli.Summary({"weights_of": config.weights}, f"{len(rows)} of {len(cases)} scenes", rows=())
        weights, table = fit(rows)
        columns = [name.replace("_", " ") for name in table[0]]
        numbers = {"weights_of": config.weights, "evidence": asdict(weights), "table": table}
        text = f"{cli.markdown(columns, [list(row.values()) for row in table])}\n\n{weights}"
        return cli.Summary(numbers, text, rows=())

    return cli.run_table(config, EXPERIMENT, cases, partial(measure_scene, config, load_model(config.weights)), report)


def measure_scene(config: Config, model: dpm.Model, run: cli.TableRun, **case: Any) -> cli.Row:
    """Returns the pairs of a scene: the evidence of each hypothesis, and whether it is right."""
    scene, kind, sensor, points = (case[name] for name in ("scene", "kind", "sensor", "points"))
    lidar = getattr(simulation, sensor)
    drive = simulation.simulate_drive(FIRST_SCENE + scene, length_m=LENGTH_M, kind=kind, sensor=lidar)
    distances = dpm.scan_distances(drive)
    bands = BANDS_INDOORS if kind in INDOORS else BANDS
    drawn = [
        (band, rows)
        for number, (band, limits_m) in enumerate(bands.items())
        for rows in dpm.draw_rows_apart(distances, *limits_m, NUM_PAIRS, np.random.default_rng([config.seed, number]))
    ]
    pairs = []
    for band, rows in run.until_stopped(drawn):
        clouds, poses = [], []
        for row in rows:
            rng = np.random.default_rng([config.seed, row])
            T_lidar_turned = _turn(rng)
            scan = drive.read_scan(int(row)) @ T_lidar_turned[:3, :3]
            clouds.append(_thinned(scan, rng) if points == THINNED else scan)
            poses.append(drive.T_world_lidar[row] @ T_lidar_turned)
        prepared = [dpm.prepare_scan(model, scan.astype(np.float32)) for scan in clouds]
        found = dpm.match_clouds(model, *(scan.descriptors for scan in prepared), config=model.config.matching)
        measured = [scan.measured for scan in prepared]
        pairs.append({"band": band, **hypotheses(model, measured, found, rigid.inverse(poses[1]) @ poses[0])})
    return {"pairs": pairs}


def hypotheses(model: dpm.Model, measured: list[Any], found: Any, T_true: np.ndarray) -> cli.Row:
    """Returns the evidence of all hypotheses of a pair, aligned as `register` aligns them."""
    config, surfaces = model.config.verification, [scan.surface for scan in measured]
    T = np.concatenate([dpm.distinct_motions(found), scans.correlate_views(*surfaces, config.views)])
    for alignment in (dpm.COARSE, dpm.FINE):
        T = scans.align_surfaces(*surfaces, T, alignment)
    return {
        "shares": dpm.evidence_shares(*measured, T, config).tolist(),
        "is_right": registration_recall(T, np.broadcast_to(T_true, T.shape)).is_right.tolist(),
    }


def fit(rows: list[cli.Row]) -> tuple[dpm.EvidenceWeights, list[cli.Row]]:
    """Returns the weights by all scenes, and a table of the choices by weights without the scene."""
    _, *present = astuple(dpm.EvidenceWeights())
    scene = np.concatenate([np.full(len(pair["is_right"]), row["scene"]) for row in rows for pair in row["pairs"]])
    shares = np.concatenate([pair["shares"] for row in rows for pair in row["pairs"]])
    is_right = np.concatenate([pair["is_right"] for row in rows for pair in row["pairs"]])
    table = []
    for row in rows:
        others = scene != row["scene"]
        weights, _ = dpm.fit_weights(shares[others], is_right[others])
        case = {name: row[name] for name in ("kind", "sensor", "points")}
        for (band,), pairs in cli.group_rows(row["pairs"], "band").items():
            numbers = {
                **case,
                "band": band,
                "num_pairs": len(pairs),
                "by_the_present_weights": share_right(pairs, np.array(present)),
                "by_a_fit_on_the_others": share_right(pairs, weights),
                "any_right": float(np.mean([np.any(pair["is_right"]) for pair in pairs])),
            }
            table.append(numbers)
    weights, bias = dpm.fit_weights(shares, is_right)
    return dpm.EvidenceWeights(round(bias, 2), *np.round(weights, 2).tolist()), table


def share_right(pairs: list[cli.Row], weights: np.ndarray) -> float:
    """Returns the share of pairs whose hypothesis of the highest score is right."""
    return float(np.mean([pair["is_right"][int(np.argmax(pair["shares"] @ weights))] for pair in pairs]))


def _thinned(scan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    scan = scan[np.linalg.norm(scan, axis=1) < MAX_RANGE_M]
    return scan[rng.choice(len(scan), min(NUM_POINTS, len(scan)), replace=False)]


def _turn(rng: np.random.Generator) -> np.ndarray:
    """Returns `T_lidar_turned`: any yaw, and a tilt by about a degree."""
    from scipy.spatial.transform import Rotation

    tilt = Rotation.from_euler("xy", rng.normal(0, TILT_DEG, 2), degrees=True)
    T = np.eye(4)
    T[:3, :3] = (tilt * Rotation.from_euler("z", rng.uniform(0, 360), degrees=True)).as_matrix()
    return T


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
