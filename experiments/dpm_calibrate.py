"""Calibrates a DeepPointMap model on towns that it was not trained on: its confidence, and its overlap probability.

    python -m experiments.dpm_calibrate results/train/latest/model.safetensors

Pairs of scans of held-out towns, overlapping and not, are registered; a logistic regression on a few features of each
registration (consensus support, share of points that meet surfaces, share in free space ...) then predicts whether the
motion is right within 2 m and 5 degrees. Pairs whose walls hold one direction only have a regression of their own, on
two features; further simulated corridors add such pairs. Overlap is another regression, on the evidence of the match
(similarities of descriptors, consensus support ...) of pairs of further towns, half of them less than 20 m apart.
Results go to results/dpm_calibrate/<time>/: model.safetensors, which is the model with all of them; metrics.json, with
the Brier scores, and the AUC of overlap, of places that were left out of the fits; reliability.png and
reliability_overlap.png.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax.cli import RunOptions, check_least, do_row, open_run_folder, recording, run_command, write_metrics
from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_calibrate"
MODEL = "model.safetensors"
OVERLAP_LABELS = ("overlap probability", "share of overlapping pairs")
TOWN_BANDS = ("near", "middle", "far")
# The two ends of a corridor may look alike: no evidence tells a pair without overlap from a right one.
CORRIDOR_BANDS = ("near", "middle")
KINDS = ("of_clouds", "of_scans", "of_weak_scans")
# Far from the seeds of the towns of training, also of its held-out one.
FIRST_TOWN, FIRST_CORRIDOR, FIRST_OVERLAP_TOWN = 3_000_000, 3_100_000, 3_500_000


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    model: Positional[str]
    """The model: a .safetensors file, or the name of a shipped one."""
    towns: Annotated[int, arg(metavar="N")] = 9
    """Number of towns. The kinds of place, of which there are nine, take turns, so that each counts the same."""
    pairs: Annotated[int, arg(metavar="N")] = 30
    """Pairs of each town that are 2 to 10 m apart, as many 10 to 20 m apart, and as many without overlap."""
    town_length_m: Annotated[float, arg(metavar="M")] = 400.0
    """Length of the drive through each town."""
    corridors: Annotated[int, arg(metavar="N")] = 8
    """Number of corridors with a lidar of 16 beams, each with as many pairs of the first two kinds."""
    overlap_towns: Annotated[int, arg(metavar="N")] = 24
    """Number of towns for overlap."""
    overlap_pairs: Annotated[int, arg(metavar="N")] = 96
    """Pairs of each of them."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, towns=2, pairs=5, corridors=2, overlap_towns=2, overlap_pairs=16, town_length_m=150, seed=0)


def main(config: Config) -> dict[str, Any]:
    """Registers and compares the pairs, fits, and writes the model."""
    from dpmjax import load_model, save_model, viz
    from dpmjax.simulation import SceneMixture
    from dpmjax.weights import read_card
    from experiments import _dpm_overlap

    model = load_model(config.model)
    folder = open_run_folder(config, EXPERIMENT)
    rows, overlap_rows = [], []
    num_registered = (config.towns * len(TOWN_BANDS) + config.corridors * len(CORRIDOR_BANDS)) * config.pairs
    total = num_registered + config.overlap_towns * config.overlap_pairs
    with recording(folder), tqdm(total=total, unit=" pairs") as bar:
        kinds = [kind for kind, _ in SceneMixture().kinds]
        for number in range(config.towns):
            case = {"town": FIRST_TOWN + number, "kind": kinds[number % len(kinds)]}
            work = partial(_town, config, model, **case, bar=bar)
            rows.append(do_row(folder.path, case, work, seed=config.seed))
            bar.update(sum(len(row["is_right"]) for row in rows) - bar.n)
        for corridor in range(FIRST_CORRIDOR, FIRST_CORRIDOR + config.corridors):
            work = partial(_corridor, config, model, corridor=corridor, bar=bar)
            rows.append(do_row(folder.path, {"corridor": corridor}, work, seed=config.seed))
            bar.update(sum(len(row["is_right"]) for row in rows) - bar.n)
        num_done = sum(len(row["is_right"]) for row in rows)
        for town in range(FIRST_OVERLAP_TOWN, FIRST_OVERLAP_TOWN + config.overlap_towns):
            work = partial(_overlap_town, config, model, town, bar)
            overlap_rows.append(do_row(folder.path, {"overlap_town": town}, work, seed=config.seed))
            bar.update(num_done + sum(len(row["is_overlap"]) for row in overlap_rows) - bar.n)
        calibration, numbers, held_out = fit(rows)
        overlap, overlap_numbers, overlap_held_out = _dpm_overlap.fit(overlap_rows)
        numbers |= overlap_numbers
        calibrated = model.replace(config=replace(model.config, calibration=calibration, overlap=overlap))
        card = read_card(Path(config.model)) if config.model.endswith(".safetensors") else config.model
        note = (
            f"Confidence calibrated on {config.towns} towns, {numbers['num_pairs']} pairs, and {config.corridors} "
            f"corridors; overlap fitted on {config.overlap_towns} towns, {numbers['num_overlap_pairs']} pairs."
        )
        save_model(calibrated, folder / MODEL, card=f"{card} {note}".strip())
        write_metrics(folder, {"model": config.model, **numbers}, seed=config.seed)
        title = "towns left out of the fit"
        figure = viz.reliability_figure(held_out["confidence"], held_out["is_right"], title=title)
        viz.save_figure(figure, folder / "reliability.png")
        values = overlap_held_out["probability"], overlap_held_out["is_overlap"]
        figure = viz.reliability_figure(*values, title=f"overlap, {title}", labels=OVERLAP_LABELS)
        viz.save_figure(figure, folder / "reliability_overlap.png")
    print(", ".join(f"{name} {value:.3f}" for name, value in numbers.items() if isinstance(value, float)))
    print(f"results in {folder.path}")
    return numbers


def _town(config: Config, model: Any, *, town: int, kind: str, bar: tqdm) -> dict[str, Any]:
    from dpmjax.simulation import simulate_drive

    drive = simulate_drive(town, length_m=config.town_length_m, kind=kind)
    return _registrations(config, model, drive, TOWN_BANDS, bar)


def _corridor(config: Config, model: Any, *, corridor: int, bar: tqdm) -> dict[str, Any]:
    from dpmjax.simulation import VLP16, SceneMixture, simulate_scenes

    mixture = SceneMixture(
        kinds=(("corridor", 1.0),), sensors=((VLP16, 1.0),), indoor_scale=(1.0, 1.0), length_m=config.town_length_m
    )
    return _registrations(config, model, simulate_scenes([corridor], mixture)[0], CORRIDOR_BANDS, bar)


def _registrations(
    config: Config, model: Any, drive: LidarSequence, bands: tuple[str, ...], bar: tqdm
) -> dict[str, Any]:
    from dpmjax.deeppointmap import draw_scan_pairs, read_scan_pairs, register_in_stages
    from dpmjax.metrics import registration_recall

    found: dict[str, list[Any]] = {name: [] for name in (*KINDS, "is_right_of_clouds", "is_right")}
    for band in bands:
        drawn = draw_scan_pairs(drive, band, config.pairs, seed=config.seed)
        for pair in read_scan_pairs(drive, drawn, seed=config.seed):
            result = register_in_stages(model, pair)
            motions = np.stack([result.descriptors, result.verified])
            is_right = registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
            for name, features in result.evidence._asdict().items():
                found[name].append(None if features is None else features.tolist())
            found["is_right_of_clouds"].append(bool(is_right[0]))
            found["is_right"].append(bool(is_right[1]))
            bar.update(1)
    return found


def _overlap_town(config: Config, model: Any, town: int, bar: tqdm) -> dict[str, Any]:
    from dpmjax.simulation import simulate_drive
    from experiments._dpm_overlap import measure_town

    # The other town is that of the next row.
    drives = [simulate_drive(seed, length_m=config.town_length_m) for seed in (town, town + 1)]
    return measure_town(model, drives, config.overlap_pairs, config.seed, bar)


def fit(rows: list[dict[str, Any]]) -> tuple[Any, dict[str, Any], dict[str, np.ndarray]]:
    """Returns the calibration of all places, its numbers, and the confidence of each town when it is left out."""
    from dpmjax.deeppointmap import CLOUD_FEATURES, SCAN_FEATURES, WEAK_FEATURES, Calibration, fit_logistic
    from experiments._dpm_overlap import held_out_probability

    towns = [row for row in rows if "town" in row]
    numbers: dict[str, Any] = {"num_pairs": sum(len(row["is_right"]) for row in towns)}
    models, held_out = {}, {}
    # In corridors the descriptors and what scans see are wrong in ways of their own.
    for kind, names, places in zip(
        KINDS, (CLOUD_FEATURES, SCAN_FEATURES, WEAK_FEATURES), (towns, towns, rows), strict=True
    ):
        label = "is_right_of_clouds" if kind == "of_clouds" else "is_right"
        pairs = [
            (place, features, is_right)
            for place, row in enumerate(places)
            for features, is_right in zip(row[kind], row[label], strict=True)
            if features is not None
        ]
        if kind == "of_weak_scans" and len({is_right for _, _, is_right in pairs}) < 2:
            continue
        place, features, is_right = (np.array(column) for column in zip(*pairs, strict=True))
        models[kind] = fit_logistic(names, features, is_right)
        confidence = held_out_probability(names, features, is_right, place)
        held_out[kind] = {"confidence": confidence, "is_right": is_right}
        numbers |= {
            f"num_pairs_{kind}": len(pairs),
            f"share_right_{kind}": float(is_right.mean()),
            f"brier_{kind}": float(np.mean((confidence - is_right) ** 2)),
            f"brier_of_a_constant_{kind}": float(np.mean((is_right.mean() - is_right) ** 2)),
        }
    return Calibration(**models), numbers, held_out["of_scans"]


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
