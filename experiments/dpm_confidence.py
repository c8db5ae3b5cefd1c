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

from dataclasses import dataclass
from typing import Annotated, ClassVar

import jax
import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, load_model, metrics
from dpmjax import deeppointmap as dpm
from experiments.dpm_calibrate import ambiguous_case, ambiguous_drive

EXPERIMENT = "dpm_confidence"
# Apart from the seeds of the calibration.
FIRST_PLACE = 3_200_000
BANDS_M = ((1.0, 5.0), (5.0, 10.0), (10.0, 20.0), (60.0, np.inf))
SURE = 0.9
NEAR_M = 5.0
RATED = {"scans": "is_right", "clouds": "is_right_of_clouds"}
COLUMNS = (
    "match of", "calibration of", "place", "pairs", "right", "sure", "sure and wrong", "1-5 m, right and sure",
    "calibration error", "Brier score",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"models"})

    models: Annotated[Positional[tuple[str, ...]], arg(metavar="NAME|FILE ...")] = ("dpm_small",)
    """Calibrated models of one network: names of shipped ones, or .safetensors files."""
    places: Annotated[int, arg(metavar="N")] = 15
    """Number of places: five kinds take turns, then three lidars."""
    pairs: Annotated[int, arg(metavar="N")] = 8
    """Pairs of each place and distance."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, places=1, pairs=1, seed=0)
        if not self.models:
            raise ValueError("give at least one model")


def main(config: Config) -> list[cli.Row]:
    """Registers the pairs, rates them by each calibration, and writes the table and the numbers."""
    models = {name: load_model(name) for name in config.models}
    calibrations = {name: model.config.calibration for name, model in models.items()}
    first = models[config.models[0]]
    for name, model in models.items():
        if calibrations[name] is None:
            raise ValueError(f"{name}: expected a calibrated model; run experiments.dpm_calibrate")
        if not jax.tree.all(jax.tree.map(np.array_equal, model.params, first.params)):
            raise ValueError(f"{name}: expected the network of {config.models[0]} with another calibration")

    def work(run: cli.TableRun, place: int, kind: str, beams: int) -> cli.Row:
        drive = ambiguous_drive(place, kind, beams)
        pairs = cli.draw_calibration_pairs(drive, BANDS_M, config.pairs, config.seed)
        return cli.measure_pairs(first, run.until_stopped(pairs))

    def report(rows: list[cli.Row]) -> cli.Summary:
        numbers = [
            {"model": name, "rated": rated, "kind": kind, **rate(some, calibration, rated)}
            for rated in RATED
            for name, calibration in calibrations.items()
            for (kind,), some in {**cli.group_rows(rows, "kind"), ("all",): rows}.items()
        ]
        return cli.Summary({"models": list(config.models)}, table(numbers), rows=numbers)

    cases = [ambiguous_case(number, FIRST_PLACE) for number in range(config.places)]
    return cli.run_table(config, EXPERIMENT, cases, work, report)


def rate(rows: list[cli.Row], calibration: dpm.Calibration, rated: str) -> cli.Row:
    """Returns the numbers of registrations that a calibration is sure of, and its expected calibration error."""
    confidence, is_right, distance_m = [], [], []
    for row in rows:
        for number, of_clouds in enumerate(row["of_clouds"]):
            evidence = dpm.MatchEvidence(np.asarray(of_clouds), None)
            names = ("of_elements",) if rated == "clouds" else ("of_scans", "of_weak_scans")
            arrays = {name: row[name][number] for name in names}
            evidence = evidence._replace(**{name: np.asarray(some) for name, some in arrays.items() if some})
            gap = cli.lookalike_gap(row, number, "of_elements" if rated == "clouds" else "of_scans")
            evidence = evidence._replace(lookalike_gap=gap)
            confidence.append(dpm.calibrated_probability(calibration, evidence))
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
        "calibration_error": metrics.expected_calibration_error(probability, right),
        "brier_score": metrics.brier_score(probability, right),
    }


def table(numbers: list[cli.Row]) -> str:
    """Returns the table as Markdown."""
    names = ("rated", "model", "kind", "num_pairs", "num_right", "num_sure", "num_sure_wrong")
    lines = []
    for row in numbers:
        near = f"{row['num_near_sure_right']} of {row['num_near']}"
        errors = (f"{row[name]:.3f}" for name in ("calibration_error", "brier_score"))
        lines.append([*(row[name] for name in names), near, *errors])
    return cli.markdown(COLUMNS, lines)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
