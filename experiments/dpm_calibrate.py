"""Calibrates a DeepPointMap model on towns that it was not trained on: its confidence, and its overlap probability.

    python -m experiments.dpm_calibrate results/train/latest/model.safetensors

Pairs of scans of held-out towns, overlapping and not, are registered. A logistic regression then predicts whether the
motion is right within 2 m and 5 degrees. Its few features include the consensus support, the share of points that meet
surfaces and the share of points in free space. Pairs whose walls hold one direction only have a regression of their
own, on two features, and so have matches of clouds of surface elements, without the scans. Ambiguous places add pairs:
corridors, tunnels, halls, open fields and streets with queues of moving cars, by lidars of 16, 32 and 64 beams. Overlap
is another regression, on the evidence of the match (similarities of descriptors, consensus support ...) of pairs of
further towns, half of them less than 20 m apart. Results go to results/dpm_calibrate/<time>/: model.safetensors,
metrics.json, reliability.png, reliability_clouds.png and reliability_overlap.png. The file model.safetensors is the
model with all regressions. The file metrics.json has the Brier scores, and the AUC of overlap, of places that were left
out of the fits. `python -m experiments.dpm_confidence` checks the confidence on other places.
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

EXPERIMENT = "dpm_calibrate"
MODEL = "model.safetensors"
OVERLAP_LABELS = ("overlap probability", "share of overlapping pairs")
TOWN_BANDS_M = ((2.0, 10.0), (10.0, 20.0), (60.0, np.inf))
# The two ends of a corridor may look alike: no evidence tells a pair without overlap from a right one.
AMBIGUOUS_BANDS_M = ((1.0, 10.0), (10.0, 20.0))
# Far from the seeds of the towns of training, also of its held-out one.
FIRST_TOWN, FIRST_AMBIGUOUS, FIRST_OVERLAP_TOWN = 3_000_000, 3_100_000, 3_500_000


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
    ambiguous: Annotated[int, arg(metavar="N")] = 30
    """Number of ambiguous places, each with as many pairs 1 to 10 m and 10 to 20 m apart."""
    overlap_towns: Annotated[int, arg(metavar="N")] = 24
    """Number of towns for overlap; 0 keeps the overlap probability of the model."""
    overlap_pairs: Annotated[int, arg(metavar="N")] = 96
    """Pairs of each of them."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, towns=2, pairs=5, ambiguous=2, overlap_towns=0, overlap_pairs=16, town_length_m=150, seed=0)
        if self.overlap_towns == 1:
            raise ValueError("--overlap-towns: expected 0, or 2 or more: each is left out once, got 1")


def main(config: Config) -> dict[str, Any]:
    """Registers and compares the pairs, fits, and writes the model."""
    from dpmjax import load_model, save_model, viz
    from dpmjax.weights import read_card
    from experiments import _dpm_overlap

    model = load_model(config.model)
    folder = open_run_folder(config, EXPERIMENT)
    rows, overlap_rows = [], []
    num_pairs = config.pairs * (config.towns * len(TOWN_BANDS_M) + config.ambiguous * len(AMBIGUOUS_BANDS_M))
    total = num_pairs + config.overlap_towns * config.overlap_pairs
    with recording(folder), tqdm(total=total, unit=" pairs") as bar:
        for case in _cases(config):
            work = partial(_registrations, config, model, **case, bar=bar)
            rows.append(do_row(folder.path, case, work, seed=config.seed))
            bar.update(sum(len(row["is_right"]) for row in rows) - bar.n)
        num_done = sum(len(row["is_right"]) for row in rows)
        for town in range(FIRST_OVERLAP_TOWN, FIRST_OVERLAP_TOWN + config.overlap_towns):
            work = partial(_overlap_town, config, model, town, bar)
            overlap_rows.append(do_row(folder.path, {"overlap_town": town}, work, seed=config.seed))
            bar.update(num_done + sum(len(row["is_overlap"]) for row in overlap_rows) - bar.n)
        calibration, numbers, held_out = fit(rows)
        calibrated = model.replace(config=replace(model.config, calibration=calibration))
        note = (
            f"Confidence calibrated on {config.towns} towns and {config.ambiguous} ambiguous places, "
            f"{numbers['num_pairs']} pairs"
        )
        title = "places left out of the fit"
        if overlap_rows:
            overlap, overlap_numbers, overlap_held_out = _dpm_overlap.fit(overlap_rows)
            numbers |= overlap_numbers
            calibrated = calibrated.replace(config=replace(calibrated.config, overlap=overlap))
            note += f"; overlap fitted on {config.overlap_towns} towns, {numbers['num_overlap_pairs']} pairs"
            values = overlap_held_out["probability"], overlap_held_out["is_overlap"]
            figure = viz.reliability_figure(*values, title=f"overlap, {title}", labels=OVERLAP_LABELS)
            viz.save_figure(figure, folder / "reliability_overlap.png")
        card = read_card(Path(config.model)) if config.model.endswith(".safetensors") else config.model
        save_model(calibrated, folder / MODEL, card=f"{card} {note}.".strip())
        write_metrics(folder, {"model": config.model, **numbers}, seed=config.seed)
        for kind, name in (("of_scans", "reliability.png"), ("of_clouds", "reliability_clouds.png")):
            found = held_out[kind]
            figure = viz.reliability_figure(found["confidence"], found["is_right"], title=title)
            viz.save_figure(figure, folder / name)
    print(", ".join(f"{name} {value:.3f}" for name, value in numbers.items() if isinstance(value, float)))
    print(f"results in {folder.path}")
    return numbers


def _cases(config: Config) -> list[dict[str, Any]]:
    from dpmjax.simulation import SceneMixture
    from experiments._dpm_places import ambiguous_case

    kinds = [kind for kind, _ in SceneMixture().kinds]
    towns = [{"town": FIRST_TOWN + number, "kind": kinds[number % len(kinds)]} for number in range(config.towns)]
    return towns + [ambiguous_case(number, FIRST_AMBIGUOUS) for number in range(config.ambiguous)]


def _registrations(config: Config, model: Any, *, kind: str, bar: tqdm, **case: int) -> dict[str, Any]:
    from dpmjax.simulation import simulate_drive
    from experiments._dpm_places import ambiguous_drive, measure_pairs

    if "town" in case:
        drive, bands_m = simulate_drive(case["town"], length_m=config.town_length_m, kind=kind), TOWN_BANDS_M
    else:
        drive = ambiguous_drive(case["place"], kind, case["beams"], config.town_length_m)
        bands_m = AMBIGUOUS_BANDS_M
    return measure_pairs(model, drive, bands_m, config.pairs, seed=config.seed, on_pair=lambda: bar.update(1))


def _overlap_town(config: Config, model: Any, town: int, bar: tqdm) -> dict[str, Any]:
    from dpmjax.simulation import simulate_drive
    from experiments._dpm_overlap import measure_town

    # The other town is that of the next row.
    drives = [simulate_drive(seed, length_m=config.town_length_m) for seed in (town, town + 1)]
    return measure_town(model, drives, config.overlap_pairs, config.seed, bar)


def fit(rows: list[dict[str, Any]]) -> tuple[Any, dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """Returns the calibration of all places, its numbers, and the confidence of each place when it is left out.

    Each model is fitted on the pairs that it rates: scans on those whose walls hold all directions.
    """
    from dpmjax.deeppointmap import CLOUD_FEATURES, SCAN_FEATURES, WEAK_FEATURES, Calibration, fit_logistic
    from experiments._dpm_overlap import held_out_probability
    from experiments._dpm_places import KINDS

    numbers: dict[str, Any] = {"num_pairs": sum(len(row["is_right"]) for row in rows)}
    models, held_out = {}, {}
    for kind, names in zip(KINDS, (CLOUD_FEATURES, SCAN_FEATURES, WEAK_FEATURES), strict=True):
        pairs = [
            (place, row[kind][number], row["is_right_of_clouds" if kind == "of_clouds" else "is_right"][number])
            for place, row in enumerate(rows)
            for number, weak in enumerate(row["of_weak_scans"])
            if row[kind][number] is not None and (kind != "of_scans" or weak is None)
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
    return Calibration(**models), numbers, held_out


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
