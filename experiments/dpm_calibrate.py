"""Calibrates a DeepPointMap model on towns that it was not trained on: its confidence, and its overlap probability.

    python -m experiments.dpm_calibrate results/train/latest/model.safetensors
    python -m experiments.dpm_calibrate --evidence                    weights of register

Pairs of scans of held-out towns, overlapping and not, are registered. A logistic regression then predicts whether the
motion is right within 2 m and 5 degrees. Its few features include the consensus support, the share of points that meet
surfaces and the share of points in free space. Pairs whose walls hold one direction only have a regression of their
own, on two features, and so have matches of clouds of surface elements, without the scans. Ambiguous places add pairs:
corridors, tunnels, halls, open fields and streets with queues of moving cars, by lidars of 16, 32 and 64 beams. Overlap
is another regression, on the evidence of the match (similarities of descriptors, consensus support ...) of pairs of
further towns, half of them less than 20 m apart.

The file model.safetensors is the model with all regressions. The file metrics.json has the Brier scores, the
calibration errors and the AUC of overlap. All are measured on places that were left out of the fits. The pictures
reliability*.png show them. On drives of your own, `dpmjax train --stages overlap --weights MODEL` calibrates.

With --evidence, all motions that `register` tries for pairs of simulated scenes are compared with the truth. A
regression on `evidence_shares` predicts the right ones. The file metrics.json has the weights for
`dpmjax.scan.EvidenceWeights`, and the shares of pairs whose right motion has the highest score.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, load_model, metrics, save_model, scan, simulation, viz
from dpmjax import deeppointmap as dpm
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from dpmjax.weights import read_card

MODEL = "model.safetensors"
AMBIGUOUS = ("corridor", "tunnel", "jam", "hall", "field")
BEAMS = {16: simulation.VLP16, 32: simulation.HDL32E, 64: simulation.OS1_64}
# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
TOWN_BANDS_M = ((2.0, 10.0), (10.0, 20.0), (dpm.FAR_M, np.inf))
AMBIGUOUS_BANDS_M = ((1.0, 10.0), (10.0, 20.0), (dpm.FAR_M, np.inf))
# Far from the seeds of the towns of training, also of its held-out one, and apart from each other.
FIRST_TOWN, FIRST_AMBIGUOUS, FIRST_OVERLAP_TOWN = 3_000_000, 3_100_000, 3_500_000
FIRST_SCENE = 6_500_000
TOWN_LENGTH_M, SCENE_LENGTH_M = 400.0, 200.0
# The kinds of town, of which there are nine, and of ambiguous place take turns, so that each counts the same.
NUM_TOWNS, NUM_AMBIGUOUS, NUM_OVERLAP_TOWNS = 9, 30, 24
# Pairs of each band of a place, of each town of the overlap, and of each band of a scene.
NUM_PAIRS, NUM_OVERLAP_PAIRS, NUM_SCENE_PAIRS = 30, 96, 20
# Whole scans, and scans thinned to 1,400 points within 30 m.
SCENES = {
    False: "suburb HDL64E, campus OS1_64, canyon HDL64E, country HDL32E, wood OS1_64, car_park HDL32E, "
    "office HDL64E, hall OS1_64, flat OS1_64, office OS1_64, hall HDL32E",
    True: "suburb HDL64E, suburb HDL32E, campus HDL32E, canyon HDL64E, country HDL32E, hall OS1_64",
}
INDOORS, SCENE_BANDS_M, INDOOR_BANDS_M = (
    ("office", "hall", "flat"),
    ((2.0, 10.0), (10.0, 20.0)),
    ((1.0, 5.0), (5.0, 12.0)),
)
NUM_THINNED, THINNED_RANGE_M, TILT_DEG = 1400, 30.0, 1.0


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(cli.RunOptions):
    """Options of the run."""

    model: Annotated[Positional[str], arg(metavar="NAME|FILE")] = "dpm_small"
    """The model: a .safetensors file, or the name of a shipped one."""
    evidence: FlagCreatePairsOff[bool] = False
    """Fit the weights by which `register` scores motions."""


def main(options: CalibrateOptions, run: cli.Run) -> cli.Row:
    """Registers and compares the pairs, fits, and writes the model."""
    model = load_model(options.model)
    run.open()
    if options.evidence:
        return fit_evidence(options, run, model)
    pairs, matches = measure_places(run, model, options.seed), measure_towns(run, model, options.seed)
    if run.is_stopped:
        return {"verdict": f"stopped after {len(pairs)} registrations and {len(matches)} matches: nothing is fitted"}
    calibration, numbers, held_out = dpm.fit_confidence(pairs)
    overlap, overlap_numbers, held_out["overlap"] = dpm.fit_overlap(matches)
    note = f"Confidence calibrated on {NUM_TOWNS} towns and {NUM_AMBIGUOUS} ambiguous places, {len(pairs)} pairs; "
    note += f"overlap fitted on {NUM_OVERLAP_TOWNS} towns, {len(matches)} pairs"
    calibrated = model.replace(config=replace(model.config, calibration=calibration, overlap=overlap))
    card = read_card(Path(options.model)) if options.model.endswith(".safetensors") else options.model
    save_model(calibrated, run / MODEL, card=f"{card} {note}.".strip())
    for kind, name in (("of_scans", ""), ("of_elements", "_clouds"), ("overlap", "_overlap")):
        labels = {"labels": ("overlap probability", "share of overlapping pairs")} if kind == "overlap" else {}
        figure = viz.reliability_figure(*held_out[kind], title=f"{kind}, places left out of the fit", **labels)
        viz.save_figure(figure, run / f"reliability{name}.png")
    return {"model": options.model, **numbers, **overlap_numbers, "verdict": note}


def list_places() -> list[cli.Row]:
    """Returns towns of all kinds, and ambiguous places: their kinds take turns, then lidars do."""
    kinds, lidars = [kind for kind, _ in simulation.SceneMixture().kinds], list(BEAMS)
    towns = [{"place": FIRST_TOWN + k, "kind": kinds[k % len(kinds)], "beams": 0} for k in range(NUM_TOWNS)]
    return towns + [
        {
            "place": FIRST_AMBIGUOUS + k,
            "kind": AMBIGUOUS[k % len(AMBIGUOUS)],
            "beams": lidars[k // len(AMBIGUOUS) % len(BEAMS)],
        }
        for k in range(NUM_AMBIGUOUS)
    ]


def open_place(place: int, kind: str, beams: int) -> LidarSequence:
    """Simulates a town, or an ambiguous place in its true size."""
    if not beams:
        return simulation.simulate_drive(place, length_m=TOWN_LENGTH_M, kind=kind)
    true_size = simulation.SceneMixture(indoor_scale=(1.0, 1.0))
    return simulation.simulate_drive(place, length_m=TOWN_LENGTH_M, kind=kind, sensor=BEAMS[beams], mixture=true_size)


def measure_places(run: cli.Run, model: dpm.Model, seed: int) -> list[cli.Row]:
    """Registers pairs of each place and band of distances; a row for each pair, fewer where a place has fewer."""

    @lru_cache(maxsize=1)
    def read(place: int, kind: str, beams: int) -> list[dpm.ScanPair]:
        bands = AMBIGUOUS_BANDS_M if beams else TOWN_BANDS_M
        return list(dpm.draw_calibration_pairs(open_place(place, kind, beams), bands, NUM_PAIRS, seed))

    def work(place: int, kind: str, beams: int, pair: int) -> cli.Row:
        pairs = read(place, kind, beams)
        if pair >= len(pairs):
            return {}
        row = dpm.measure_pair(model, pairs[pair])
        return row | {"is_end": beams > 0 and row["distance_m"] >= dpm.FAR_M}

    numbers = range(NUM_PAIRS * len(TOWN_BANDS_M))
    cases = [{**place, "pair": number} for place in list_places() for number in numbers]
    return [row for row in cli.fill_table(run, cases, work, "pairs.csv") if row["is_right"] is not None]


def measure_towns(run: cli.Run, model: dpm.Model, seed: int) -> list[cli.Row]:
    """Matches pairs of a few scans of each town, and of fewer ones of the next town; a row for each pair."""

    @lru_cache(maxsize=1)
    def measure(place: int) -> list[cli.Row]:
        drives = []
        for number, num in ((place, NUM_SCANS), (place + 1, NUM_OTHER_SCANS)):
            drive = simulation.simulate_drive(number, length_m=TOWN_LENGTH_M)
            drives.append(drive.take(np.unique(np.linspace(0, len(drive) - 1, num).astype(int))))
        found = dpm.measure_overlap(model, drives, NUM_OVERLAP_PAIRS, seed)
        if not found:
            raise ValueError(f"{drives[0].name}: no pairs of scans with overlap, or none without")
        return found

    def work(place: int, pair: int) -> cli.Row:
        return measure(place)[pair]

    towns = range(FIRST_OVERLAP_TOWN, FIRST_OVERLAP_TOWN + NUM_OVERLAP_TOWNS)
    cases = [{"place": town, "pair": pair} for town in towns for pair in range(NUM_OVERLAP_PAIRS)]
    return cli.fill_table(run, cases, work, "overlap.csv")


def fit_evidence(options: CalibrateOptions, run: cli.Run, model: dpm.Model) -> cli.Row:
    """Compares the motions of pairs of simulated scenes with the truth, and fits `EvidenceWeights`.

    Args:
        options: seed of the pairs.
        run: gets scene_N.npz with the evidence of all motions of each scene, and the table.
        model: encoder and decoder.

    Returns:
        The weights, and shares of pairs whose motion of the highest score is right.
    """

    def work(scene: int, kind: str, sensor: str, thinned: bool) -> cli.Row | None:
        drive = simulation.simulate_drive(
            FIRST_SCENE + scene, length_m=SCENE_LENGTH_M, kind=kind, sensor=getattr(simulation, sensor)
        )
        found = []
        for pair, rows in enumerate(draw_scene_pairs(drive, kind, options.seed)):
            if run.is_stopped:
                return None
            shares, is_right = measure_motions(model, drive, rows, thinned, options.seed)
            found.append((np.full(len(is_right), pair), shares, is_right))
        pairs, shares, is_right = map(np.concatenate, zip(*found, strict=True))
        np.savez(run / f"scene_{scene}.npz", pair=pairs, shares=shares, is_right=is_right)
        return {"num_pairs": len(found), "num_motions": len(pairs)}

    scenes = [(*scene.split(), thinned) for thinned, some in SCENES.items() for scene in some.split(", ")]
    cases = [
        {"scene": number, "kind": kind, "sensor": sensor, "thinned": thinned}
        for number, (kind, sensor, thinned) in enumerate(scenes)
    ]
    done = cli.fill_table(run, cases, work)
    if len(done) < len(cases):
        return {"verdict": f"stopped after {len(done)} of {len(cases)} scenes: nothing is fitted"}
    evidence = [np.load(run / f"scene_{number}.npz") for number in range(len(cases))]
    shares, is_right = (np.concatenate([one[name] for one in evidence]) for name in ("shares", "is_right"))
    weights, bias = dpm.fit_weights(shares, is_right)
    fitted = scan.EvidenceWeights(round(bias, 2), *np.round(weights, 2).tolist())
    compared = {"present": scan.EvidenceWeights(), "fitted": fitted}
    rights = {f"right_by_{name}": share_right(evidence, np.array(astuple(one)[1:])) for name, one in compared.items()}
    return {"evidence": asdict(fitted), **rights, "verdict": str(fitted)}


def draw_scene_pairs(drive: LidarSequence, kind: str, seed: int) -> list[np.ndarray]:
    """Returns the numbers of the scans of pairs, near ones and then far ones."""
    distances, bands = dpm.scan_distances(drive), INDOOR_BANDS_M if kind in INDOORS else SCENE_BANDS_M
    return [
        rows
        for number, limits_m in enumerate(bands)
        for rows in dpm.draw_rows_apart(distances, *limits_m, NUM_SCENE_PAIRS, np.random.default_rng([seed, number]))
    ]


def measure_motions(
    model: dpm.Model, drive: LidarSequence, rows: np.ndarray, thinned: bool, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (m, 6) evidence of all motions of a pair, aligned as by `register`, and whether each is right."""
    clouds, poses = [], []
    for row in rows:
        rng, T_lidar_turned = np.random.default_rng([seed, row]), np.eye(4)
        tilt = Rotation.from_euler("xy", rng.normal(0, TILT_DEG, 2), degrees=True)
        T_lidar_turned[:3, :3] = (tilt * Rotation.from_euler("z", rng.uniform(0, 360), degrees=True)).as_matrix()
        points = drive.read_scan(int(row)) @ T_lidar_turned[:3, :3]
        if thinned:
            points = points[np.linalg.norm(points, axis=1) < THINNED_RANGE_M]
            points = points[rng.choice(len(points), min(NUM_THINNED, len(points)), replace=False)]
        clouds.append(points.astype(np.float32))
        poses.append(drive.T_world_lidar[row] @ T_lidar_turned)
    prepared = [dpm.prepare_scan(model, points) for points in clouds]
    found = dpm.match_clouds(model, *(side.descriptors for side in prepared), config=model.config.matching)
    surfaces, config = [side.surface for side in prepared], model.config.verification
    T = np.concatenate([dpm.distinct_motions(found), scan.correlate_views(*surfaces, config.views)])
    for alignment in (scan.COARSE, scan.FINE):
        T = scan.align_on_host(*surfaces, T, alignment).T_target_source
    T_true = np.broadcast_to(rigid.inverse(poses[1]) @ poses[0], T.shape)
    return scan.evidence_shares(*prepared, T, config), metrics.registration_recall(T, T_true).is_right


def share_right(scenes: Sequence[Mapping[str, np.ndarray]], weights: np.ndarray) -> float:
    """Returns the share of pairs whose motion of the highest score is right."""
    pairs = [(scene, scene["pair"] == pair) for scene in scenes for pair in np.unique(scene["pair"])]
    chosen = [scene["is_right"][rows][np.argmax(scene["shares"][rows] @ weights)] for scene, rows in pairs]
    return float(np.mean(chosen))


if __name__ == "__main__":
    cli.run_experiment(main)
