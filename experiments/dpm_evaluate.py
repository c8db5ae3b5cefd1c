"""Measures how well a DeepPointMap model registers scans, and SLAM with it, beside other programs on the same scans.

    python -m experiments.dpm_evaluate path/to/drive another/drive --weights model.safetensors
    python -m experiments.dpm_evaluate town                             towns that no training has seen
    python -m experiments.dpm_evaluate --slam path/to/drive another/drive
    python -m experiments.dpm_evaluate --slam town --num-towns 5 --town-length-m 1000 4000
    python -m experiments.dpm_evaluate --resume                         go on where the last run stopped

A path is any folder of scans with poses (KITTI, KITTI-360, MulRan, plain ...). Random pairs of scans, 2 to 10 m and 10
to 20 m apart and turned by any yaw, are registered; a registration within 2 m and 5 degrees is right. Results go to
results/dpm_evaluate/<time>/: table.md, metrics.json, reliability.png, failures.png (the worst pairs from above). Two
more methods see the same pairs: the search and the verification of `register` without the network, and KISS-Matcher
(extra `kiss`).

With --slam, the whole system and its odometry run beside KISS-ICP, KISS-SLAM and odometry by small_gicp (extra
`peers`); then random scans are looked for in the map of each drive's first half. Poses are needed for the errors only.
--refine adds two rows: the keyframes of our run polished by DeepMapping, and by multiway registration (Open3D, extra
`baselines`), from the same poses.
table.md has ATE, KITTI's t_rel, loops, their recall, seconds a scan, bytes of maps and localisations; trajectories.png
and map_sizes.png show them, and drives/ holds the trajectories of every method and the files of our run.
experiments/_slam_evaluation.py says how loops are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax.cli.command import StopFlag, check_least, run_command
from dpmjax.cli.result_files import do_row
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics

if TYPE_CHECKING:
    from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_evaluate"
# No training, selection or calibration uses these towns.
FIRST_TOWN = 5_000_000
NUM_SHOWN = 4
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 4


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"refine"})

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, or simulated towns."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    slam: FlagCreatePairsOff[bool] = False
    """Compare SLAM on whole drives instead of registrations of pairs."""
    pairs: Annotated[int, arg(metavar="N")] = 30
    """Pairs for each distance."""
    num_towns: Annotated[int, arg(metavar="N")] = 3
    """Number of towns, where town is among the paths."""
    town_length_m: Annotated[tuple[float, ...], arg(metavar="M")] = (400.0,)
    """Length of the towns' routes; two numbers with --slam: from that of the first town to that of the last."""
    no_kiss: FlagCreatePairsOff[bool] = False
    """Leave KISS-Matcher out."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """With --slam: the first N scans of each drive."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """With --slam: every Nth scan."""
    kitti_angle_correction: FlagCreatePairsOff[bool] = False
    """With --slam: raise the beams of all drives by 0.205 degrees, as KITTI's HDL-64E needs, for all methods."""
    refine: FlagCreatePairsOff[bool] = False
    """With --slam: polish the keyframes of our run by DeepMapping, and by Open3D's multiway registration."""
    localize: Annotated[int, arg(metavar="N")] = 50
    """With --slam: number of scans that are looked for in the map of the first half; 0 leaves it out."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, pairs=1, num_towns=1, seed=0, n_scans=1, jump=1, localize=0, town_length_m=100)
        if not self.paths:
            raise ValueError("give at least one folder of scans, or town")
        if not 1 <= len(self.town_length_m) <= (2 if self.slam else 1):
            raise ValueError("--town-length-m: expected one length, or two with --slam")
        if not self.slam and (self.n_scans is not None or self.jump != 1 or self.kitti_angle_correction or self.refine):
            raise ValueError("only with --slam: --n-scans, --jump, --kitti-angle-correction, --refine")

    @property
    def town_length_range(self) -> tuple[float, float]:
        """Returns the lengths of the first and of the last town."""
        return self.town_length_m[0], self.town_length_m[-1]


def main(config: Config) -> list[dict[str, Any]]:
    """Compares SLAM, or registers pairs."""
    return evaluate_slam(config) if config.slam else evaluate_pairs(config)


def evaluate_slam(config: Config) -> list[dict[str, Any]]:
    """Makes the rows of drives and methods that are missing, and writes tables, numbers and pictures."""
    from dpmjax import load_model
    from experiments import _slam_comparison as comparison

    load_model(config.weights)
    drives = comparison.open_drives(config, FIRST_TOWN)
    folder = open_run_folder(config, EXPERIMENT)
    rows: list[dict[str, Any]] = []
    opened = {}
    with recording(folder), StopFlag() as stop:
        missing = comparison.missing_peers(config)
        numbers = {"weights": config.weights, "peers_left_out": missing}
        note = write_metrics(folder, numbers, seed=config.seed, rows=rows)
        for drive, row in comparison.compare(config, folder, drives, lambda: stop.is_requested):
            opened[drive.sequence.name] = drive
            rows.append(row)
            note = write_metrics(folder, numbers, seed=config.seed, rows=rows)
        text = "\n\n".join([comparison.tables(rows), *(f"{name} was not run: {why}." for name, why in missing.items())])
        (folder / "table.md").write_text(text + (f"\n\n{note}.\n" if note else "\n"), encoding="utf-8")
        print(f"{text}\nresults in {folder.path}")
        comparison.draw(folder, list(opened.values()), rows)
    return rows


def evaluate_pairs(config: Config) -> list[dict[str, Any]]:
    """Registers the pairs that are missing, and writes table, numbers and pictures."""
    from dpmjax import load_model
    from experiments._dpm_evaluation import (
        evaluate_matcher,
        evaluate_registrations,
        kiss_matcher,
        search_alone,
        why_no_kiss,
    )
    from experiments._dpm_overlap import evaluate_overlap

    model = load_model(config.weights)
    search = partial(search_alone, config=model.config.verification)
    drives = open_drives(config)
    num_overlap = OVERLAP_FACTOR * config.pairs
    no_kiss = why_no_kiss() if not config.no_kiss else "left out by --no-kiss"
    folder = open_run_folder(config, EXPERIMENT)
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop, tqdm(unit=" pairs", dynamic_ncols=True) as bar:

        def add(method: str, drive: LidarSequence, band: str, work: Any) -> None:
            if not stop.is_requested:
                bar.set_description(f"{drive.name}, {band}, {method}")
                case = {"method": method, "sequence": drive.name, "band": band}
                rows.append(do_row(folder.path, case, work, seed=config.seed))

        for drive in drives:
            for band in ("near", "middle", "far"):
                pairs = (drive, band, config.pairs, config.seed)
                add("DeepPointMap", drive, band, lambda p=pairs: evaluate_registrations(model, *p, bar))
                if band == "far":
                    continue
                add("search", drive, band, lambda p=pairs: evaluate_matcher(search, *p, bar))
                if no_kiss is None:
                    add("KISS-Matcher", drive, band, lambda p=pairs: evaluate_matcher(kiss_matcher, *p, bar))
            add("overlap", drive, "all", lambda d=drive: evaluate_overlap(model, d, num_overlap, config.seed, bar))
        text = write_results(folder, config, rows, no_kiss)
        draw(folder, config, drives, rows)
    print(text)
    print(f"results in {folder.path}")
    return rows


def open_drives(config: Config) -> list[LidarSequence]:
    """Opens the drives; a `ValueError` names one without poses or without pairs."""
    from dpmjax.cli.train_data import find_sources
    from experiments._dpm_pairs import draw_pairs

    towns = range(FIRST_TOWN, FIRST_TOWN + config.num_towns)
    drives = [source.open() for source in find_sources(config.paths, towns, config.town_length_m[0])]
    for drive in drives:
        if not len(draw_pairs(drive, "near", 1, 0)):
            raise ValueError(f"{drive.name}: no two scans are 2 to 10 m apart; are the poses in metres?")
    names = [drive.name for drive in drives]
    if len(set(names)) < len(names):
        raise ValueError(f"two drives have the same name ({', '.join(sorted(names))}); evaluate them one by one")
    return drives


def write_results(folder: RunFolder, config: Config, rows: Sequence[dict[str, Any]], no_kiss: str | None) -> str:
    """Writes table.md and metrics.json; returns the table."""
    from experiments._dpm_evaluation import calibration_numbers, table

    numbers = {"weights": config.weights, "kiss_matcher": no_kiss or "run", **calibration_numbers(rows)}
    note = write_metrics(folder, numbers, seed=config.seed, rows=rows)
    text = table(rows)
    if no_kiss is not None:
        text += f"\n\nKISS-Matcher was not run: {no_kiss}."
    (folder / "table.md").write_text(text + (f"\n\n{note}.\n" if note else "\n"), encoding="utf-8")
    return text


def draw(folder: RunFolder, config: Config, drives: Sequence[LidarSequence], rows: Sequence[dict[str, Any]]) -> None:
    """Draws reliability.png and failures.png."""
    from dpmjax import viz
    from experiments._dpm_evaluation import worst_failures

    mine = [row for row in rows if row["method"] == "DeepPointMap"]
    confidence = np.concatenate([row["confidence"] for row in mine] or [np.zeros(0)])
    is_right = np.concatenate([row["is_right"] for row in mine] or [np.zeros(0, bool)])
    figure = viz.reliability_figure(confidence, is_right, title=f"{Path(config.weights).stem}, all pairs")
    viz.save_figure(figure, folder / "reliability.png")
    worst = worst_failures(drives, mine, NUM_SHOWN, config.seed)
    if worst:
        viz.save_figure(viz.registered_pairs_figure(worst), folder / "failures.png")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
