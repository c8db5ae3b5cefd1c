"""The 75 trajectories of DeepMapping section 4.1, by all methods: one table, and the boxes of figure 6.

    python -m experiments.deepmapping_suite --limit 6        the first six trajectories
    python -m experiments.deepmapping_suite --resume         go on where the last run stopped

Three built-in worlds, 50 trajectories of 128 poses and 25 of 256, made by seed. Every trajectory of every method is a
file of its own, so that a killed run goes on. With --range-noise-px the rows also say the least error that one scan
allows where the world is known (`dpmjax.metrics.position_bound`). Results: table.md, metrics.json (with all rows),
boxes.png.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, arg

from experiments._command import run_command
from experiments._deepmapping_methods import (
    METHODS,
    NOT_RUN,
    SUCCESS_PX,
    Problem,
    make_problem,
    run_method,
    split_by_extras,
)
from experiments._resumable_rows import do_row
from experiments._run_folder import RunFolder, open_run_folder, recording, write_metrics
from experiments._stop import StopFlag

if TYPE_CHECKING:
    from dpmjax.sequences import ScanSequence

EXPERIMENT = "deepmapping_suite"
NUM_WORLDS, NUM_SHORT, NUM_LONG = 3, 50, 25


@dataclass(frozen=True)
class Config:
    """Options of the suite."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/deepmapping_suite/<time>."""
    limit: Annotated[int | None, arg(metavar="N")] = None
    """Only the first N trajectories; they go through worlds and lengths in turn."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Columns."""
    steps: int = 600
    """Steps of the fit."""
    range_noise_px: Annotated[float, arg(metavar="PX")] = 0.0
    """Standard deviation of the range noise."""
    seed: int = 0
    """Seed of everything random."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue an interrupted run, the latest or that in OUT."""
    force: FlagCreatePairsOff[bool] = False
    """Replace an earlier run in OUT."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise ValueError(f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")
        if self.steps < 2 or (self.limit is not None and self.limit < 1) or self.range_noise_px < 0:
            raise ValueError("--steps, --limit and --range-noise-px: expected at least 2, 1 and 0")


def list_trajectories() -> list[dict[str, int]]:
    """World, length and seed of all 75, ordered so that the first few are of all kinds."""
    short = [{"world": k % NUM_WORLDS, "num_scans": 128, "walk": k} for k in range(NUM_SHORT)]
    long = [{"world": k % NUM_WORLDS, "num_scans": 256, "walk": 100 + k} for k in range(NUM_LONG)]
    # Two short ones, then a long one.
    mixed = [entry for k in range(NUM_LONG) for entry in (short[2 * k], short[2 * k + 1], long[k])]
    return mixed


def main(config: Config) -> list[dict[str, Any]]:
    """Runs what is missing, writes the table after every trajectory."""
    folder = open_run_folder(
        config,
        EXPERIMENT,
        output=config.output,
        resume=config.resume,
        force=config.force,
        may_change=frozenset({"limit", "methods"}),
    )
    methods, missing = split_by_extras(config.methods)
    not_run = NOT_RUN | missing
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop:
        for entry in tqdm(list_trajectories()[: config.limit], desc="suite", unit=" trajectories"):
            # Made once, and not at all where all rows are there.
            prepare = cache(partial(_prepare, entry, config))
            for method in methods:
                if stop.is_requested:
                    break
                case = {"method": method, **entry}
                rows.append(do_row(folder.path, case, partial(_measure, method, prepare)))
            if stop.is_requested:
                break
            if rows:
                _write(folder, rows, methods, not_run, config.seed)
    print(table(rows, methods))
    if config.range_noise_px and rows:
        bound = summarise(rows)["median_bound_px"]
        print(f"no unbiased estimate can have a median ATE below {bound:.3g} px, not even with the world known")
    for name, reason in not_run.items():
        print(f"{name}: not run ({reason})")
    print(f"results in {folder.path}")
    return rows


def _prepare(entry: dict[str, Any], config: Config) -> tuple[Problem, dict[str, float]]:
    """The scans of a trajectory, and the bound on their ATE."""
    from dpmjax.simulation import simulate_sequence

    sequence = simulate_sequence(
        entry["world"], entry["num_scans"], seed=entry["walk"], range_noise_px=config.range_noise_px
    )
    problem = make_problem(sequence, is_ordered=True, steps=config.steps, seed=config.seed)
    return problem, _bound(entry["world"], sequence, config.range_noise_px)


def _measure(method: str, prepare: Callable[[], tuple[Problem, dict[str, float]]]) -> dict[str, Any]:
    problem, bound = prepare()
    return run_method(method, problem) | bound


def _bound(world: int, sequence: ScanSequence, range_noise_px: float) -> dict[str, float]:
    """The bound on the ATE, px; nothing without noise."""
    from dpmjax.metrics import position_bound
    from dpmjax.simulation import cast_scans, make_world

    if not range_noise_px:
        return {}
    assert sequence.reference_poses is not None
    cast = partial(cast_scans, make_world(world).is_obstacle, num_beams=sequence.mask.shape[1])
    bound = position_bound(cast, sequence.reference_poses, range_noise=range_noise_px)
    return {"bound_px": float(np.sqrt(np.mean(bound**2)))}


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians, success and how right the confidence was, of the rows of one method."""
    good = [row for row in rows if row["is_trusted"]]
    return {
        "num_trajectories": len(rows),
        "median_ate_px": float(np.median([row["ate_px"] for row in rows])),
        "median_point_distance_px": float(np.median([row["point_distance_px"] for row in rows])),
        "success": float(np.mean([row["success"] for row in rows])),
        "median_s": float(np.median([row["seconds"] for row in rows])),
        "median_cpu_s": float(np.median([row["cpu_s"] for row in rows])),
        "num_called_good": len(good),
        "success_of_good": float(np.mean([row["success"] for row in good])) if good else None,
        **({"median_bound_px": float(np.median([row["bound_px"] for row in rows]))} if "bound_px" in rows[0] else {}),
    }


def table(rows: list[dict[str, Any]], methods: tuple[str, ...]) -> str:
    """The table as README text."""
    lines = [
        "| method | trajectories | median ATE, px | median point distance, px | success (ATE < 20 px) | median s "
        "| called good | of these right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in methods:
        mine = [row for row in rows if row["method"] == method]
        if mine:
            s = summarise(mine)
            right = "-" if s["success_of_good"] is None else f"{s['success_of_good']:.1%}"
            lines.append(
                f"| {method} | {s['num_trajectories']} | {s['median_ate_px']:.3g} "
                f"| {s['median_point_distance_px']:.3g} | {s['success']:.1%} "
                f"| {s['median_s']:.1f} | {s['num_called_good']} | {right} |"
            )
    return "\n".join(lines)


def _write(
    folder: RunFolder, rows: list[dict[str, Any]], methods: tuple[str, ...], not_run: dict[str, str], seed: int
) -> None:
    """table.md, metrics.json, boxes.png."""
    from dpmjax import viz

    present = [method for method in methods if any(row["method"] == method for row in rows)]
    (folder / "table.md").write_text(table(rows, methods) + "\n", encoding="utf-8")
    by_method = {method: [row for row in rows if row["method"] == method] for method in present}
    metrics = {
        "success_threshold_px": SUCCESS_PX,
        "methods": {method: summarise(mine) for method, mine in by_method.items()},
        "not_run": not_run,
        "rows": rows,
    }
    write_metrics(folder, metrics, seed=seed)
    panels = {
        label: {method: [row[key] for row in mine] for method, mine in by_method.items()}
        for label, key in (("ATE, px", "ate_px"), ("point distance, px", "point_distance_px"))
    }
    viz.save_figure(viz.error_boxes_figure(panels, threshold=SUCCESS_PX), folder / "boxes.png")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
