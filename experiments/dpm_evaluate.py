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
trajectories of every method and the files of our run. `_slam_evaluation.py` says how loops are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, load_model
from dpmjax.io import LidarSequence

EXPERIMENT = "dpm_evaluate"
# Overlap is cheap: more pairs, of each kind.
OVERLAP_FACTOR = 4


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
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
    refine: FlagCreatePairsOff[bool] = False
    """With --slam: polish the keyframes of our run by DeepMapping, and by Open3D's multiway registration."""
    localize: Annotated[int, arg(metavar="N")] = 50
    """With --slam: number of scans that are looked for in the map of the first half; 0 leaves it out."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        cli.check_least(self, pairs=1, num_towns=1, localize=0, town_length_m=100)
        if not self.paths:
            raise ValueError("give at least one folder of scans, or town")
        if not 1 <= len(self.town_length_m) <= (2 if self.slam else 1):
            raise ValueError("--town-length-m: expected one length, or two with --slam")
        if not self.slam and (self.n_scans is not None or self.jump != 1 or self.kitti_angle_correction or self.refine):
            raise ValueError("only with --slam: --n-scans, --jump, --kitti-angle-correction, --refine")


def main(config: Config) -> list[cli.Row]:
    """Compares SLAM, or registers pairs."""
    return evaluate_slam(config) if config.slam else evaluate_pairs(config)


def evaluate_slam(config: Config) -> list[cli.Row]:
    """Makes the rows of drives and methods that are missing, and writes tables, numbers and pictures."""
    from experiments import _slam_comparison as comparison

    compared = comparison.Comparison(
        weights=config.weights, seed=config.seed, is_refined=config.refine, num_localized=config.localize
    )
    seeds = range(cli.FIRST_TOWN, cli.FIRST_TOWN + config.num_towns)
    lengths_m = np.linspace(config.town_length_m[0], config.town_length_m[-1], config.num_towns).tolist()
    drives = comparison.open_drives(config.paths, config, dict(zip(seeds, lengths_m, strict=True)))
    return comparison.compare(config, EXPERIMENT, compared, drives)


def evaluate_pairs(config: Config) -> list[cli.Row]:
    """Registers the pairs that are missing, and writes table, numbers and pictures."""
    from experiments._dpm_evaluation import evaluate_matcher, kiss_matcher, search_alone

    model = load_model(config.weights)
    matchers = {"search": partial(search_alone, config=model.config.verification), "KISS-Matcher": kiss_matcher}
    drives = cli.open_evaluation_drives(config.paths, cli.evaluation_towns(config.num_towns, config.town_length_m[0]))
    by_name = {drive.name: drive for drive in drives}
    no_kiss = cli.why_not_importable("kiss_matcher") if not config.no_kiss else "left out by --no-kiss"
    methods = ("DeepPointMap", "search", *(("KISS-Matcher",) if no_kiss is None else ()))

    def work(run: cli.TableRun, method: str, sequence: str, band: str) -> cli.Row:
        drive = by_name[sequence]
        if method == "overlap":
            num_pairs = OVERLAP_FACTOR * config.pairs
            return cli.overlap_row(model, drive, num_pairs, seed=config.seed, on_scan=run.check_stop)
        if method == "DeepPointMap":
            return cli.registration_row(model, drive, band, config.pairs, seed=config.seed, on_pair=run.check_stop)
        return evaluate_matcher(matchers[method], drive, band, config.pairs, seed=config.seed, on_pair=run.check_stop)

    bands = [(method, band) for band in ("near", "middle") for method in methods]
    cases = [
        {"method": method, "sequence": name, "band": band}
        for name in by_name
        for method, band in (*bands, ("DeepPointMap", "far"), ("overlap", "all"))
    ]
    return cli.run_table(config, EXPERIMENT, cases, work, lambda rows: report(config, drives, rows, no_kiss))


def report(config: Config, drives: Sequence[LidarSequence], rows: list[cli.Row], no_kiss: str | None) -> cli.Summary:
    """Returns the numbers, the tables and the pictures of the pairs."""
    from experiments._dpm_evaluation import pooled_rows, pooled_table, table

    recorded = [drive.name for drive in drives if Path(drive.sources[0]).exists()]
    pooled = pooled_rows(rows, recorded or [drive.name for drive in drives])
    numbers = {"weights": config.weights, "kiss_matcher": no_kiss or "run", **cli.calibration_numbers(rows)}
    notes = [] if no_kiss is None else [f"KISS-Matcher was not run: {no_kiss}."]
    text = "\n\n".join(filter(None, [table(rows), pooled_table(pooled), *notes]))
    draw = partial(cli.draw_evaluation, drives=drives, rows=rows, weights=config.weights, seed=config.seed)
    return cli.Summary({**numbers, "pooled": pooled}, text, draw)


if __name__ == "__main__":
    raise SystemExit(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
