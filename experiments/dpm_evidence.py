"""Fits the weights by which `register` scores motions: the evidence of two scans for a right motion.

    python -m experiments.dpm_evidence

Pairs of scans of simulated scenes are registered: out of doors and inside, whole and thinned to 1,400 points within 30
m. All hypotheses of a pair, by the network and by the search among views from above, are aligned and compared with the
truth. A logistic regression on `evidence_shares` predicts which are right. Results go to results/dpm_evidence/<time>/.
The file metrics.json has the weights for `dpmjax.deeppointmap.EvidenceWeights`. The file table.md has the share of
pairs whose right hypothesis has the highest score, scene by scene, each by a fit without this scene.
"""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass, fields
from functools import partial
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from dpmjax.cli import (
    RunOptions,
    StopFlag,
    check_least,
    do_rows,
    open_run_folder,
    recording,
    run_command,
    write_metrics,
)
from dpmjax.geometry import rigid

EXPERIMENT = "dpm_evidence"
# Far from the seeds of all other commands.
FIRST_SCENE = 6_500_000
WHOLE, THINNED = "whole", "thinned"
SCENES = (
    *((kind, sensor, WHOLE) for kind, sensor in (("suburb", "HDL64E"), ("campus", "OS1_64"), ("canyon", "HDL64E"))),
    *((kind, sensor, WHOLE) for kind, sensor in (("country", "HDL32E"), ("wood", "OS1_64"), ("car_park", "HDL32E"))),
    *((kind, sensor, WHOLE) for kind, sensor in (("office", "HDL64E"), ("hall", "OS1_64"), ("flat", "OS1_64"))),
    *((kind, sensor, WHOLE) for kind, sensor in (("office", "OS1_64"), ("hall", "HDL32E"))),
    *((kind, sensor, THINNED) for kind, sensor in (("suburb", "HDL64E"), ("suburb", "HDL32E"), ("campus", "HDL32E"))),
    *((kind, sensor, THINNED) for kind, sensor in (("canyon", "HDL64E"), ("country", "HDL32E"), ("hall", "OS1_64"))),
)
INDOORS = ("office", "hall", "flat")
BANDS = {"near": (2.0, 10.0), "far": (10.0, 20.0)}
BANDS_INDOORS = {"near": (1.0, 5.0), "far": (5.0, 12.0)}
NUM_POINTS, MAX_RANGE_M = 1400, 30.0
TILT_DEG = 1.0


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """The network whose hypotheses are judged."""
    pairs: Annotated[int, arg(metavar="N")] = 20
    """Pairs of each distance of each scene."""
    scenes: Annotated[int, arg(metavar="N")] = len(SCENES)
    """Number of scenes."""
    length_m: Annotated[float, arg(metavar="M")] = 200.0
    """Length of the way through each scene."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, pairs=1, scenes=2, length_m=100, seed=0)
        if self.scenes > len(SCENES):
            raise ValueError(f"--scenes: expected at most {len(SCENES)}, got {self.scenes}")


def main(config: Config) -> dict[str, Any]:
    """Registers the pairs, fits, and writes weights and table."""
    from dpmjax import load_model

    model = load_model(config.weights)
    folder = open_run_folder(config, EXPERIMENT)
    cases = [
        {"scene": number, "kind": kind, "sensor": sensor, "points": points}
        for number, (kind, sensor, points) in enumerate(SCENES[: config.scenes])
    ]
    with recording(folder), StopFlag() as stop:
        work = partial(measure_scene, config, model)
        rows = do_rows(folder.path, cases, work, seed=config.seed, is_stopped=lambda: stop.is_requested)
        numbers: dict[str, Any] = {"is_interrupted": stop.is_requested, "weights_of": config.weights}
        if not stop.is_requested:
            weights, table = fit(rows)
            numbers |= {"evidence": asdict(weights), "table": table}
            (folder / "table.md").write_text(as_table(table), encoding="utf-8")
            print(as_table(table))
            print(weights)
        write_metrics(folder, numbers, seed=config.seed)
    print(f"results in {folder.path}")
    return numbers


def measure_scene(
    config: Config, model: Any, *, scene: int, kind: str, sensor: str, points: str
) -> dict[str, list[dict[str, Any]]]:
    """Returns the pairs of a scene: the evidence of each hypothesis, and whether it is right."""
    from dpmjax import simulation
    from dpmjax.deeppointmap import draw_rows_apart, match_clouds, prepare_scan, scan_distances

    lidar = getattr(simulation, sensor)
    drive = simulation.simulate_drive(FIRST_SCENE + scene, length_m=config.length_m, kind=kind, sensor=lidar)
    distances = scan_distances(drive)
    bands = BANDS_INDOORS if kind in INDOORS else BANDS
    drawn = [
        (band, rows)
        for number, (band, limits_m) in enumerate(bands.items())
        for rows in draw_rows_apart(distances, *limits_m, config.pairs, np.random.default_rng([config.seed, number]))
    ]
    pairs = []
    for band, rows in drawn:
        scans, poses = [], []
        for row in rows:
            rng = np.random.default_rng([config.seed, row])
            T_lidar_turned = _turn(rng)
            scan = drive.read_scan(int(row)) @ T_lidar_turned[:3, :3]
            scans.append(_thinned(scan, rng) if points == THINNED else scan)
            poses.append(drive.T_world_lidar[row] @ T_lidar_turned)
        prepared = [prepare_scan(model, scan.astype(np.float32)) for scan in scans]
        found = match_clouds(model, *(scan.descriptors for scan in prepared), config=model.config.matching)
        measured = [scan.measured for scan in prepared]
        pairs.append({"band": band, **judged(model, measured, found, rigid.inverse(poses[1]) @ poses[0])})
    return {"pairs": pairs}


def judged(model: Any, measured: list[Any], hypotheses: Any, T_true: np.ndarray) -> dict[str, Any]:
    """Returns the evidence of all hypotheses of a pair, aligned as `register` aligns them."""
    from dpmjax.deeppointmap import COARSE, FINE, distinct_motions, evidence_shares
    from dpmjax.metrics import registration_recall
    from dpmjax.scans import align_surfaces_from, correlate_views

    config, surfaces = model.config.verification, [scan.surface for scan in measured]
    T = np.concatenate([distinct_motions(hypotheses), correlate_views(*surfaces, config.views)])
    for alignment in (COARSE, FINE):
        T = np.stack([found.T_target_source for found in align_surfaces_from(*surfaces, T, alignment)])
    return {
        "shares": evidence_shares(*measured, T, config).tolist(),
        "is_right": registration_recall(T, np.broadcast_to(T_true, T.shape)).is_right.tolist(),
    }


def fit(rows: list[dict[str, Any]]) -> tuple[Any, list[dict[str, Any]]]:
    """Returns the weights by all scenes, and a table of the choices by weights without the scene."""
    from dpmjax.deeppointmap import EvidenceWeights, fit_weights

    _, *present = astuple(EvidenceWeights())
    names = tuple(field.name for field in fields(EvidenceWeights))
    scene = np.concatenate([np.full(_num_hypotheses(row), row["scene"]) for row in rows])
    shares = np.concatenate([pair["shares"] for row in rows for pair in row["pairs"]])
    is_right = np.concatenate([pair["is_right"] for row in rows for pair in row["pairs"]])
    table = []
    for row in rows:
        others = scene != row["scene"]
        weights, _ = fit_weights(shares[others], is_right[others])
        for band in dict.fromkeys(pair["band"] for pair in row["pairs"]):
            pairs = [pair for pair in row["pairs"] if pair["band"] == band]
            right = [np.asarray(pair["is_right"]) for pair in pairs]
            by_score = [
                is_right[np.argmax(pair["shares"] @ np.array(present))]
                for is_right, pair in zip(right, pairs, strict=True)
            ]
            by_fit = [
                is_right[np.argmax(pair["shares"] @ weights)] for is_right, pair in zip(right, pairs, strict=True)
            ]
            table.append(
                {
                    **{name: row[name] for name in ("kind", "sensor", "points")},
                    "band": band,
                    "num_pairs": len(pairs),
                    "by_the_present_weights": float(np.mean(by_score)),
                    "by_a_fit_on_the_others": float(np.mean(by_fit)),
                    "any_right": float(np.mean([one.any() for one in right])),
                }
            )
    weights, bias = fit_weights(shares, is_right)
    return EvidenceWeights(**dict(zip(names, (round(bias, 2), *np.round(weights, 2).tolist()), strict=True))), table


def as_table(table: list[dict[str, Any]]) -> str:
    """Returns the table in Markdown."""
    lines = ["| " + " | ".join(name.replace("_", " ") for name in table[0]) + " |", "|" + "---|" * len(table[0])]
    for row in table:
        cells = [f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _num_hypotheses(row: dict[str, Any]) -> int:
    return sum(len(pair["is_right"]) for pair in row["pairs"])


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
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
