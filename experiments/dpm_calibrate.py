"""Calibrates a DeepPointMap model on towns that it was not trained on: its confidence, and its overlap probability.

    python -m experiments.dpm_calibrate results/train/latest/model.safetensors
    python -m experiments.dpm_calibrate MODEL --data path/to/drive another/drive    on your drives, as dpmjax train does

Pairs of scans of held-out towns, overlapping and not, are registered. A logistic regression then predicts whether the
motion is right within 2 m and 5 degrees. Its few features include the consensus support, the share of points that meet
surfaces and the share of points in free space. Pairs whose walls hold one direction only have a regression of their
own, on two features, and so have matches of clouds of surface elements, without the scans. Ambiguous places add pairs:
corridors, tunnels, halls, open fields and streets with queues of moving cars, by lidars of 16, 32 and 64 beams. Overlap
is another regression, on the evidence of the match (similarities of descriptors, consensus support ...) of pairs of
further towns, half of them less than 20 m apart. Results go to results/dpm_calibrate/<time>/: model.safetensors,
metrics.json, reliability.png, reliability_clouds.png and reliability_overlap.png. The file model.safetensors is the
model with all regressions. The file metrics.json has the Brier scores, the calibration errors, and the AUC of overlap,
of places that were left out of the fits. With --data, pairs of your drives take the place of simulated ones; the fits
leave the last tenth of each drive out, which the numbers are of. `python -m experiments.dpm_confidence` checks the
confidence on other places.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, load_model, save_model, simulation, viz
from dpmjax import deeppointmap as dpm
from dpmjax.io import LidarSequence
from dpmjax.weights import read_card

EXPERIMENT = "dpm_calibrate"
MODEL = "model.safetensors"
AMBIGUOUS = ("corridor", "tunnel", "jam", "hall", "field")
BEAMS = {16: simulation.VLP16, 32: simulation.HDL32E, 64: simulation.OS1_64}
# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
OVERLAP_LABELS = ("overlap probability", "share of overlapping pairs")
TOWN_BANDS_M = ((2.0, 10.0), (10.0, 20.0), (60.0, np.inf))
AMBIGUOUS_BANDS_M = ((1.0, 10.0), (10.0, 20.0), (60.0, np.inf))
# Far from the seeds of the towns of training, also of its held-out one.
FIRST_TOWN, FIRST_AMBIGUOUS, FIRST_OVERLAP_TOWN = 3_000_000, 3_100_000, 3_500_000
TOWN_LENGTH_M = 400.0
# The kinds of town, of which there are nine, and of ambiguous place take turns, so that each counts the same.
NUM_TOWNS, NUM_AMBIGUOUS, NUM_OVERLAP_TOWNS = 9, 30, 24
# Pairs of each band of a place, and of each town of the overlap.
NUM_PAIRS, NUM_OVERLAP_PAIRS = 30, 96


@dataclass(frozen=True, kw_only=True)
class Config(cli.RunOptions):
    """Options of the run."""

    model: Annotated[Positional[str], arg(metavar="NAME|FILE")] = "dpm_small"
    """The model: a .safetensors file, or the name of a shipped one."""
    data: Annotated[tuple[str, ...], arg(metavar="PATH")] = ()
    """Folders of scans with poses to calibrate on, instead of simulated places."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        cli.check_least(self, seed=0)


def main(config: Config) -> list[cli.Row]:
    """Registers and compares the pairs, fits, and writes the model."""
    model = load_model(config.model)
    if config.data:
        return calibrate_on_drives(config, model)

    def work(run: cli.TableRun, **case: int | str) -> cli.Row:
        if "overlap_town" in case:
            # The other town is that of the next row.
            seeds = (case["overlap_town"], case["overlap_town"] + 1)
            drives = [simulation.simulate_drive(seed, length_m=TOWN_LENGTH_M) for seed in seeds]
            return measure_town(model, drives, config.seed)
        drive, bands_m = open_place(**case)
        pairs = cli.draw_calibration_pairs(drive, bands_m, NUM_PAIRS, config.seed)
        return cli.measure_pairs(model, run.until_stopped(pairs))

    cases = list_cases()
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: report(config, model, rows, len(cases)))


def calibrate_on_drives(config: Config, model: dpm.Model) -> list[cli.Row]:
    """Calibrates on the drives of the user."""
    drives = [source() for source in cli.find_sources(config.data, [])]

    def work(run: cli.TableRun) -> cli.Row:
        return cli.measure_drives(model, drives, config.seed)._asdict()

    def report(rows: list[cli.Row]) -> cli.Summary:
        measured = cli.MeasuredDrives(*(rows[0][name] for name in cli.MeasuredDrives._fields))
        calibrated, numbers = cli.calibrate(model, measured)
        note = f"Confidence and overlap calibrated on {', '.join(config.data)}."

        def write(folder: cli.RunFolder) -> None:
            save_model(calibrated, folder / MODEL, card=f"{card_of(config.model)} {note}".strip())

        text = ", ".join(f"{name} {value:.3f}" for name, value in numbers.items() if isinstance(value, float))
        return cli.Summary({"model": config.model, **numbers}, text, write, rows=())

    return cli.run_table(config, EXPERIMENT, [{}], work, report)


def measure_town(model: dpm.Model, drives: list[LidarSequence], seed: int) -> cli.Row:
    """Returns evidence and labels of pairs of a few scans of a town, and of fewer ones of a second town."""
    parts = [
        drive.take(np.unique(np.linspace(0, len(drive) - 1, num).astype(int)))
        for drive, num in zip(drives, (NUM_SCANS, NUM_OTHER_SCANS), strict=True)
    ]
    found = cli.measure_overlap(model, parts, NUM_OVERLAP_PAIRS, seed)
    if found is None:
        raise ValueError(f"{drives[0].name}: no pairs of scans with overlap, or none without")
    return found


def card_of(model: str) -> str:
    """Returns the description of a model file; the name of a shipped model."""
    return read_card(Path(model)) if model.endswith(".safetensors") else model


def list_cases() -> list[cli.Row]:
    """Returns the places of the confidence, then the towns of the overlap."""
    kinds = itertools.cycle(kind for kind, _ in simulation.SceneMixture().kinds)
    towns = [{"town": FIRST_TOWN + number, "kind": next(kinds)} for number in range(NUM_TOWNS)]
    places = [ambiguous_case(number, FIRST_AMBIGUOUS) for number in range(NUM_AMBIGUOUS)]
    return towns + places + [{"overlap_town": FIRST_OVERLAP_TOWN + number} for number in range(NUM_OVERLAP_TOWNS)]


def open_place(
    *, kind: str, town: int | None = None, place: int = 0, beams: int = 0
) -> tuple[LidarSequence, cli.Bands]:
    """Simulates a town or an ambiguous place; returns its drive, and the distances of its pairs, metres."""
    if town is not None:
        return simulation.simulate_drive(town, length_m=TOWN_LENGTH_M, kind=kind), TOWN_BANDS_M
    return ambiguous_drive(place, kind, beams), AMBIGUOUS_BANDS_M


def report(config: Config, model: dpm.Model, rows: list[cli.Row], num_cases: int) -> cli.Summary:
    """Fits the regressions; the model and the reliability of places left out are written with the pictures."""
    if len(rows) < num_cases:
        return cli.Summary({"model": config.model}, f"{len(rows)} of {num_cases} places", rows=())
    calibration, numbers, held_out = cli.fit_confidence([row for row in rows if "overlap_town" not in row])
    overlap, overlap_numbers, overlap_held_out = cli.fit_overlap([row for row in rows if "overlap_town" in row])
    numbers |= overlap_numbers
    calibrated = replace(model.config, calibration=calibration, overlap=overlap)
    note = f"Confidence calibrated on {NUM_TOWNS} towns and {NUM_AMBIGUOUS} ambiguous places, "
    note += f"{numbers['num_pairs']} pairs"
    note += f"; overlap fitted on {NUM_OVERLAP_TOWNS} towns, {numbers['num_overlap_pairs']} pairs"
    title = "places left out of the fit"
    figures = {
        name: viz.reliability_figure(*held_out[kind], title=title)
        for kind, name in (("of_scans", "reliability.png"), ("of_elements", "reliability_clouds.png"))
    }
    figures["reliability_overlap.png"] = viz.reliability_figure(
        *overlap_held_out, title=f"overlap, {title}", labels=OVERLAP_LABELS
    )

    def write(folder: cli.RunFolder) -> None:
        save_model(replace(model, config=calibrated), folder / MODEL, card=f"{card_of(config.model)} {note}.".strip())
        for name, figure in figures.items():
            viz.save_figure(figure, folder / name)

    text = ", ".join(f"{name} {value:.3f}" for name, value in numbers.items() if isinstance(value, float))
    return cli.Summary({"model": config.model, **numbers}, text, write, rows=())


def ambiguous_case(number: int, first_seed: int) -> cli.Row:
    """Returns the case of one of the ambiguous places: kinds of place take turns, then lidars do."""
    beams = list(BEAMS)[number // len(AMBIGUOUS) % len(BEAMS)]
    return {"place": first_seed + number, "kind": AMBIGUOUS[number % len(AMBIGUOUS)], "beams": beams}


def ambiguous_drive(place: int, kind: str, beams: int) -> LidarSequence:
    """Simulates an ambiguous place in its true size."""
    true_size = simulation.SceneMixture(indoor_scale=(1.0, 1.0))
    lidar, length_m = BEAMS[beams], TOWN_LENGTH_M
    return simulation.simulate_drive(place, length_m=length_m, kind=kind, sensor=lidar, mixture=true_size)


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
