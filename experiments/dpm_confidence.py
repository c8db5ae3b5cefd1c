"""Checks the confidence of registrations where it is easy to be wrong, on places that no fit has seen.

    python -m experiments.dpm_confidence dpm_small
    python -m experiments.dpm_confidence dpm_small results/dpm_calibrate/latest/model.safetensors

The places are simulated corridors, tunnels, halls, open fields and streets with queues of moving cars, scanned by
lidars of 16, 32 and 64 beams. Pairs are 1 to 5 m, 5 to 10 m and 10 to 20 m apart, and the same number has no overlap.
They are registered as scans, and as clouds of surface elements. A registration within 2 m and 5 degrees is right, and
sure with a confidence of 0.9 or more. Further models are the same network with other calibrations: they rate the same
registrations. With --resume, other models rate the registrations of an earlier run. Results go to
results/dpm_confidence/<time>/: table.md, metrics.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import jax
import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax.cli import (
    RunFolder,
    RunOptions,
    check_least,
    do_row,
    open_run_folder,
    recording,
    run_command,
    write_metrics,
)

if TYPE_CHECKING:
    from dpmjax.deeppointmap import Calibration, Model

EXPERIMENT = "dpm_confidence"
# Apart from the seeds of the calibration.
FIRST_PLACE = 3_200_000
BANDS_M = ((1.0, 5.0), (5.0, 10.0), (10.0, 20.0), (60.0, np.inf))
SURE = 0.9
NEAR_M = 5.0
RATED = {"scans": "is_right", "clouds": "is_right_of_clouds"}


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"models"})

    models: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME|FILE ...")] = ("dpm_small",)
    """Calibrated models of one network: names of shipped ones, or .safetensors files."""
    places: Annotated[int, arg(metavar="N")] = 15
    """Number of places: five kinds take turns, then three lidars."""
    pairs: Annotated[int, arg(metavar="N")] = 8
    """Pairs of each place and distance."""
    length_m: Annotated[float, arg(metavar="M")] = 400.0
    """Length of the way through each place out of doors; inside a quarter of it."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, places=1, pairs=1, length_m=150, seed=0)
        if not self.models:
            raise ValueError("give at least one model")


def main(config: Config) -> list[dict[str, Any]]:
    """Registers the pairs, rates them by each calibration, and writes the table and the numbers."""
    from dpmjax import load_model
    from experiments._dpm_places import ambiguous_case

    models = {name: load_model(name) for name in config.models}
    calibrations = {name: model.config.calibration for name, model in models.items()}
    first = models[config.models[0]]
    for name, model in models.items():
        if calibrations[name] is None:
            raise ValueError(f"{name}: expected a calibrated model; run experiments.dpm_calibrate")
        if not jax.tree.all(jax.tree.map(np.array_equal, model.params, first.params)):
            raise ValueError(f"{name}: expected the network of {config.models[0]} with another calibration")
    folder = open_run_folder(config, EXPERIMENT)
    rows = []
    with recording(folder), tqdm(total=config.places * config.pairs * len(BANDS_M), unit=" pairs") as bar:
        for number in range(config.places):
            case = ambiguous_case(number, FIRST_PLACE)
            work = partial(_registrations, config, first, **case, bar=bar)
            rows.append(do_row(folder.path, case, work, seed=config.seed))
            bar.update(sum(len(row["is_right"]) for row in rows) - bar.n)
        numbers = [
            {"model": name, "rated": rated, "kind": kind, **rate(some, calibration, rated)}
            for rated in RATED
            for name, calibration in calibrations.items()
            for kind, some in _by_kind(rows).items()
        ]
        print(write_results(folder, config, numbers))
    print(f"results in {folder.path}")
    return numbers


def _registrations(config: Config, model: Model, *, place: int, kind: str, beams: int, bar: tqdm) -> dict[str, Any]:
    from experiments._dpm_places import ambiguous_drive, measure_pairs

    drive = ambiguous_drive(place, kind, beams, config.length_m)
    return measure_pairs(model, drive, BANDS_M, config.pairs, seed=config.seed, on_pair=lambda: bar.update(1))


def _by_kind(rows: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    kinds = dict.fromkeys(row["kind"] for row in rows)
    return {**{kind: [row for row in rows if row["kind"] == kind] for kind in kinds}, "all": list(rows)}


def rate(rows: Sequence[dict[str, Any]], calibration: Calibration, rated: str) -> dict[str, Any]:
    """Returns the numbers of registrations that a calibration is sure of, and its expected calibration error."""
    from dpmjax.deeppointmap import MatchEvidence, calibrated_probability
    from dpmjax.metrics import brier_score, expected_calibration_error

    confidence, is_right, distance_m = [], [], []
    for row in rows:
        for number, of_clouds in enumerate(row["of_clouds"]):
            of_scans = (row[name][number] if rated == "scans" else None for name in ("of_scans", "of_weak_scans"))
            arrays = (None if values is None else np.asarray(values) for values in (of_clouds, *of_scans))
            confidence.append(calibrated_probability(calibration, MatchEvidence(*arrays)))
        is_right += row[RATED[rated]]
        distance_m += row["distance_m"]
    probability, right, distance = np.array(confidence), np.array(is_right), np.array(distance_m)
    is_sure, is_near = probability >= SURE, distance <= NEAR_M
    return {
        "num_pairs": len(right),
        "num_right": int(right.sum()),
        "num_sure": int(is_sure.sum()),
        "num_sure_wrong": int((is_sure & ~right).sum()),
        "num_near": int(is_near.sum()),
        "num_near_sure_right": int((is_near & is_sure & right).sum()),
        "calibration_error": expected_calibration_error(probability, right),
        "brier_score": brier_score(probability, right),
    }


def write_results(folder: RunFolder, config: Config, numbers: Sequence[dict[str, Any]]) -> str:
    """Writes table.md and metrics.json; returns the table."""
    note = write_metrics(folder, {"models": list(config.models)}, seed=config.seed, rows=numbers)
    text = table(numbers)
    (folder / "table.md").write_text(text + (f"\n\n{note}.\n" if note else "\n"), encoding="utf-8")
    return text


def table(numbers: Sequence[dict[str, Any]]) -> str:
    """Returns the table as Markdown."""
    names = "pairs | right | sure | sure and wrong | 1-5 m, right and sure | calibration error | Brier score"
    lines = [f"| match of | calibration of | place | {names} |", "|---" * 10 + "|"]
    for row in numbers:
        counts = " | ".join(str(row[name]) for name in ("num_pairs", "num_right", "num_sure", "num_sure_wrong"))
        near = f"{row['num_near_sure_right']} of {row['num_near']}"
        errors = f"{row['calibration_error']:.3f} | {row['brier_score']:.3f}"
        lines.append(f"| {row['rated']} | {row['model']} | {row['kind']} | {counts} | {near} | {errors} |")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
