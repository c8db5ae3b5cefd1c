"""Measures how well a DeepPointMap model registers scans, and SLAM with it, beside other programs on the same scans.

    python -m experiments.dpm_evaluate path/to/drive another/drive --weights model.safetensors
    python -m experiments.dpm_evaluate town                             towns that no training has seen
    python -m experiments.dpm_evaluate --slam path/to/drive another/drive
    python -m experiments.dpm_evaluate --slam town --num-towns 5 --town-length-m 1000 4000
    python -m experiments.dpm_evaluate --slam path/to/drive kitti_00.txt kitti_07.txt      towns along real routes
    python -m experiments.dpm_evaluate --resume                         go on where the last run stopped

A path is any folder of scans with poses (KITTI, KITTI-360, MulRan, plain ...). Random pairs of scans, 2 to 10 m and 10
to 20 m apart and turned by any yaw, are registered. A registration within 2 m and 5 degrees is right. Results go to
results/dpm_evaluate/<time>/: table.md, metrics.json, reliability.png, failures.png (the worst pairs from above). Two
more methods see the same pairs: the search and the verification of `register` without the network, and KISS-Matcher
(extra `kiss`). Rows of all recorded drives together have confidence intervals and say which methods differ.

With --slam, the whole system and its odometry run beside KISS-ICP, KISS-SLAM and odometry by small_gicp (extra
`peers`). Then random scans are localised in the map of each drive's first half. Poses are needed for the errors only. A
file of poses (TUM or KITTI) stands for a town that is simulated along it; scans are kept in results/simulated. The
option --refine adds two rows: the keyframes of our run, refined by DeepMapping, and by multiway registration (Open3D,
extra `baselines`), from the same poses. The file table.md has ATE, KITTI's t_rel, loops, their recall, bytes of maps,
localisations and seconds a scan. The seconds are of all scans, and of the first and the last tenth, which show whether
they grow. trajectories.png and map_sizes.png show the trajectories and the bytes of maps; drives/ holds the
trajectories of every method and the files of our run. experiments/_slam_evaluation.py says how loops are counted.
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

from dpmjax.cli import (
    FIRST_TOWN,
    DriveSelection,
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    do_row,
    open_run_folder,
    recording,
    run_command,
    why_not_importable,
    write_metrics,
)

if TYPE_CHECKING:
    from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_evaluate"
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 4


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"refine"})

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="town|PATH ...")] = ("town",)
    """Folders of scans with poses, files of poses along which a town is simulated, or towns of the seeds."""
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
    def selection(self) -> DriveSelection:
        """The scans of each drive, with --slam."""
        return DriveSelection(
            num_scans=self.n_scans, jump=self.jump, is_kitti_corrected=self.kitti_angle_correction, seed=self.seed
        )


def main(config: Config) -> list[dict[str, Any]]:
    """Compares SLAM, or registers pairs."""
    return evaluate_slam(config) if config.slam else evaluate_pairs(config)


def evaluate_slam(config: Config) -> list[dict[str, Any]]:
    """Makes the rows of drives and methods that are missing, and writes tables, numbers and pictures."""
    from dpmjax import load_model
    from experiments import _slam_comparison as comparison

    load_model(config.weights)
    choice = comparison.DriveChoice(
        paths=config.paths,
        selection=config.selection,
        town_seeds=range(FIRST_TOWN, FIRST_TOWN + config.num_towns),
        town_lengths_m=np.linspace(config.town_length_m[0], config.town_length_m[-1], config.num_towns).tolist(),
    )
    compared = comparison.Comparison(
        weights=config.weights, seed=config.seed, is_refined=config.refine, num_localized=config.localize
    )
    drives = comparison.open_drives(choice)
    folder = open_run_folder(config, EXPERIMENT)
    rows: list[dict[str, Any]] = []
    opened = {}
    with recording(folder), StopFlag() as stop:
        missing = comparison.missing_peers(compared)
        numbers = {"weights": config.weights, "peers_left_out": missing}
        note = write_metrics(folder, numbers, seed=config.seed, rows=rows)
        for drive, row in comparison.compare(compared, folder, drives, lambda: stop.is_requested):
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
    from dpmjax.cli import draw_evaluation, evaluation_towns, open_evaluation_drives, overlap_row, registration_row
    from experiments._dpm_evaluation import evaluate_matcher, kiss_matcher, search_alone

    model = load_model(config.weights)
    search = partial(search_alone, config=model.config.verification)
    drives = open_evaluation_drives(config.paths, evaluation_towns(config.num_towns, config.town_length_m[0]))
    num_overlap = OVERLAP_FACTOR * config.pairs
    no_kiss = why_not_importable("kiss_matcher") if not config.no_kiss else "left out by --no-kiss"
    folder = open_run_folder(config, EXPERIMENT)
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop, tqdm(unit=" pairs", dynamic_ncols=True) as bar:

        def add(method: str, drive: LidarSequence, band: str, work: Any) -> None:
            if not stop.is_requested:
                bar.set_description(f"{drive.name}, {band}, {method}")
                case = {"method": method, "sequence": drive.name, "band": band}
                rows.append(do_row(folder.path, case, work, seed=config.seed))

        tick = partial(bar.update, 1)
        for drive in drives:
            for band in ("near", "middle", "far"):
                pairs = (drive, band, config.pairs)
                mine = partial(registration_row, model, *pairs, seed=config.seed, on_pair=tick)
                add("DeepPointMap", drive, band, mine)
                if band == "far":
                    continue
                add("search", drive, band, partial(evaluate_matcher, search, *pairs, config.seed, bar))
                if no_kiss is None:
                    add("KISS-Matcher", drive, band, partial(evaluate_matcher, kiss_matcher, *pairs, config.seed, bar))
            work = partial(overlap_row, model, drive, num_overlap, seed=config.seed, on_scan=bar.refresh)
            add("overlap", drive, "all", work)
        text = write_results(folder, config, drives, rows, no_kiss)
        title = f"{Path(config.weights).stem}, all pairs"
        draw_evaluation(folder, drives, rows, title=title, seed=config.seed)
    print(text)
    print(f"results in {folder.path}")
    return rows


def write_results(
    folder: RunFolder,
    config: Config,
    drives: Sequence[LidarSequence],
    rows: Sequence[dict[str, Any]],
    no_kiss: str | None,
) -> str:
    """Writes table.md and metrics.json; returns the tables."""
    from dpmjax.cli import calibration_numbers
    from experiments._dpm_evaluation import pooled_rows, pooled_table, table

    recorded = [drive.name for drive in drives if Path(drive.sources[0]).exists()]
    pooled = pooled_rows(rows, recorded or [drive.name for drive in drives])
    numbers = {"weights": config.weights, "kiss_matcher": no_kiss or "run", **calibration_numbers(rows)}
    note = write_metrics(folder, {**numbers, "pooled": pooled}, seed=config.seed, rows=rows)
    text = "\n\n".join(filter(None, [table(rows), pooled_table(pooled)]))
    if no_kiss is not None:
        text += f"\n\nKISS-Matcher was not run: {no_kiss}."
    (folder / "table.md").write_text(text + (f"\n\n{note}.\n" if note else "\n"), encoding="utf-8")
    return text


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
