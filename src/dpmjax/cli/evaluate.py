"""Measures how well weights of DeepPointMap register the scans of drives whose poses are known.

    dpmjax evaluate                                a simulated suburb that no training has seen
    dpmjax evaluate path/to/drive another/drive    any folders of scans with poses (KITTI, KITTI-360, MulRan, plain ...)
    dpmjax evaluate path/to/drive --weights model.safetensors --pairs 100
    dpmjax evaluate --resume                       continue the latest run

Random pairs of scans, 2 to 10 m and 10 to 20 m apart, are registered, each scan turned by any yaw. A registration
within 2 m and 5 degrees is right. Results go to results/evaluate/<time>/ (latest links to the newest). table.md has the
recall of the network alone, after the verification by the scans, and after the final alignment. metrics.json has every
pair. reliability.png shows the share of right registrations for each confidence, pairs more than 60 m apart included.
failures.png shows wrong registrations from above. The AUC of overlap compares pairs less than 20 m apart (revisits
where the drive has some) with pairs more than 40 m apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax.cli.command import StopFlag, check_least, run_command
from dpmjax.cli.result_files import do_row
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics
from dpmjax.io.files import write_atomically

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence

NAME = "evaluate"
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 2
HEADER = (
    "drive | distance | pairs | recall, network alone | recall, verified | recall, refined (95 % interval) "
    "| median error, network alone | median error, refined | s / pair | overlap AUC"
)


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    data: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, or simulated towns."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    pairs: Annotated[int, arg(metavar="N")] = 15
    """Pairs for each distance."""
    num_towns: Annotated[int, arg(metavar="N")] = 1
    """Number of towns, where town is among the data; a suburb first, then other kinds of place."""
    town_length_m: Annotated[float, arg(metavar="M")] = 400.0
    """Length of the route through each town."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            ValueError: if an option is out of range.
        """
        check_least(self, pairs=1, num_towns=1, seed=0, town_length_m=100)
        if not self.data:
            raise ValueError("give at least one folder of scans, or town")


class BandStopped(Exception):
    """A signal came while the pairs of a band were registered."""


def main(config: Config) -> list[dict[str, Any]]:
    """Makes the rows that are missing, and writes table, numbers and pictures."""
    from dpmjax.cli.evaluation_rows import (
        BAND_NAMES,
        evaluation_towns,
        open_evaluation_drives,
        overlap_row,
        registration_row,
    )
    from dpmjax.simulation import SceneMixture
    from dpmjax.weights import load_model

    model = load_model(config.weights)
    kinds = [kind for kind, _ in SceneMixture().kinds]
    drives = open_evaluation_drives(config.data, evaluation_towns(config.num_towns, config.town_length_m, kinds))
    folder = open_run_folder(config, NAME)
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop, tqdm(unit=" pairs", dynamic_ncols=True) as bar:

        def add(drive: LidarSequence, band: str, work: Callable[[], dict[str, Any]]) -> None:
            if not stop.is_requested:
                bar.set_description(f"{drive.name}, {BAND_NAMES.get(band, band)}")
                with suppress(BandStopped):
                    rows.append(do_row(folder.path, {"sequence": drive.name, "band": band}, work, seed=config.seed))

        def advance(num_pairs: int) -> None:
            bar.update(num_pairs)
            if stop.is_requested:
                raise BandStopped

        for drive in drives:
            for band in ("near", "middle", "far"):
                work = partial(registration_row, model, drive, band, config.pairs)
                add(drive, band, partial(work, seed=config.seed, on_pair=partial(advance, 1)))
            of_overlap = partial(overlap_row, model, drive, OVERLAP_FACTOR * config.pairs)
            add(drive, "overlap", partial(of_overlap, seed=config.seed, on_scan=partial(advance, 0)))
        text = write_results(folder, config, drives, rows, is_interrupted=stop.is_requested)
    print(text, f"results in {folder.path}", sep="\n")
    return rows


def write_results(
    folder: RunFolder,
    config: Config,
    drives: Sequence[LidarSequence],
    rows: Sequence[dict[str, Any]],
    *,
    is_interrupted: bool,
) -> str:
    """Writes table.md, metrics.json and the pictures; returns the text to print."""
    from dpmjax.cli.evaluation_rows import calibration_numbers, draw_evaluation

    numbers = calibration_numbers(rows)
    metrics = {"weights": config.weights, **numbers, "is_interrupted": is_interrupted}
    note = write_metrics(folder, metrics, seed=config.seed, rows=rows)
    text = table(rows)
    if numbers:
        note_of_score = "" if numbers["is_calibrated"] else "; these weights are not calibrated"
        text += f"\n\nBrier score of the confidence, all pairs: {numbers['brier']:.3f} (0 is best{note_of_score})."
    write_atomically(folder / "table.md", text + (f"\n\n{note}.\n" if note else "\n"))
    title = f"{Path(config.weights).stem}, all pairs"
    draw_evaluation(folder, drives, rows, title=title, seed=config.seed)
    return text


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the table as Markdown: a row for each drive and distance."""
    from dpmjax.cli.evaluation_rows import BAND_NAMES
    from dpmjax.metrics import wilson_interval

    by_case = {(row["sequence"], row["band"]): row for row in rows}
    lines = [f"| {HEADER} |", "|" + "---|" * (HEADER.count("|") + 1)]
    for (sequence, band), row in by_case.items():
        if band not in BAND_NAMES or not row["num_pairs"]:
            continue
        auc = by_case.get((sequence, "overlap"), {}).get("auc")
        refined = wilson_interval(int(np.sum(row["is_right"])), row["num_pairs"])
        cells = [
            sequence,
            BAND_NAMES[band],
            str(row["num_pairs"]),
            *(f"{row[f'recall_{stage}']:.2f}" for stage in ("descriptors", "verified")),
            f"{refined.share:.2f} ({refined.low:.2f} to {refined.high:.2f})",
            *(_length(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined")),
            f"{row['pair_s']:.2f}",
            "-" if auc is None or band != "near" else f"{auc:.3f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _length(metres: float | None) -> str:
    # Without a right registration the median is NaN, which JSON has no word for.
    return "-" if metres is None or np.isnan(metres) else f"{metres:.3f} m"


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)
