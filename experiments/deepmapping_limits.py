"""Where each method works: success over the distance of the scans, the range noise, and with or without their order.

    python -m experiments.deepmapping_limits --limit 3       three trajectories a cell
    python -m experiments.deepmapping_limits --resume        go on where the last run stopped

Trajectories of 256 poses in the built-in worlds, thinned to every 1st, 2nd, 4th, 8th and 16th scan, with range noise of
0, 1, 3 and 10 px, in order and shuffled. The hard cells come first. Results: metrics.json, ordered.png, shuffled.png.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, arg

from experiments._command import run_command
from experiments._deepmapping_methods import METHODS, SUCCESS_PX, Problem, make_problem, run_method, split_by_extras
from experiments._resumable_rows import do_row
from experiments._run_folder import open_run_folder, recording, write_metrics
from experiments._stop import StopFlag

EXPERIMENT = "deepmapping_limits"
COLUMNS = ("icp-plane", "multiview", "direct-adam", "deepmapping-cold", "deepmapping-warm")
NUM_SCANS, NUM_WORLDS = 256, 3


@dataclass(frozen=True)
class Config:
    """Options of the grid."""

    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/deepmapping_limits/<time>."""
    limit: Annotated[int, arg(metavar="N")] = 3
    """Trajectories in a cell."""
    strides: tuple[int, ...] = (8, 16, 4, 2, 1)
    """Every so manyth scan is used."""
    noises_px: tuple[float, ...] = (0.0, 1.0, 3.0, 10.0)
    """Standard deviations of the range noise."""
    orders: tuple[str, ...] = ("ordered", "shuffled")
    """With the order of time, or without."""
    methods: tuple[str, ...] = COLUMNS
    """Methods to compare."""
    steps: int = 600
    """Steps of the fit."""
    seed: int = 0
    """Seed of everything random."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue an interrupted run, the latest or that in OUT."""
    force: FlagCreatePairsOff[bool] = False
    """Replace an earlier run in OUT."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        for name, values, known in (
            ("methods", self.methods, tuple(METHODS)),
            ("orders", self.orders, ("ordered", "shuffled")),
        ):
            if not values or any(value not in known for value in values):
                raise ValueError(f"--{name}: expected some of {', '.join(known)}, got {', '.join(values) or 'none'}")
        if self.limit < 1 or self.steps < 2 or any(s < 1 or s > NUM_SCANS // 4 for s in self.strides):
            raise ValueError(f"--limit, --steps, --strides: expected at least 1, at least 2, 1 to {NUM_SCANS // 4}")
        if any(noise < 0 for noise in self.noises_px):
            raise ValueError(f"--noises-px: expected zero or more, got {self.noises_px}")


def main(config: Config) -> list[dict[str, Any]]:
    """Runs what is missing, cell by cell."""
    methods, missing = split_by_extras(config.methods)
    config = replace(config, methods=methods)
    folder = open_run_folder(
        config,
        EXPERIMENT,
        output=config.output,
        resume=config.resume,
        force=config.force,
        may_change=frozenset({"limit", "methods", "strides", "noises_px", "orders"}),
    )
    cells = [
        (walk, stride, noise, order)
        for stride in config.strides
        for walk in range(config.limit)
        for noise in config.noises_px
        for order in config.orders
    ]
    rows: list[dict[str, Any]] = []
    with recording(folder), StopFlag() as stop:
        for cell in tqdm(cells, desc="limits", unit=" cells"):
            if stop.is_requested:
                break
            rows += _run_cell(folder.path, cell, config)
            _write(folder, rows, config)
    for line in summary(rows, config):
        print(line)
    for name, reason in missing.items():
        print(f"{name}: not run ({reason})")
    print(f"results in {folder.path}")
    return rows


def _run_cell(folder: Path, cell: tuple[int, int, float, str], config: Config) -> list[dict[str, Any]]:
    """All methods on one trajectory of one cell."""
    walk, stride, noise, order = cell
    named = {"stride": stride, "noise_px": noise, "order": order, "walk": walk}
    # Made once, and not at all where all rows are there.
    problem = cache(partial(_make_cell_problem, cell, config))
    return [
        do_row(folder, {"method": method, **named}, lambda m=method: run_method(m, problem()))
        for method in config.methods
    ]


def _make_cell_problem(cell: tuple[int, int, float, str], config: Config) -> Problem:
    from dpmjax.simulation import simulate_sequence

    walk, stride, noise, order = cell
    sequence = simulate_sequence(walk % NUM_WORLDS, NUM_SCANS, seed=200 + walk, range_noise_px=noise)
    return make_problem(
        sequence.take(slice(None, None, stride)),
        is_ordered=order == "ordered",
        steps=config.steps,
        seed=config.seed,
    )


def success_grid(rows: list[dict[str, Any]], method: str, order: str, config: Config) -> NDArray[np.float64]:
    """(strides, noises) success rates, smallest stride first; NaN where nothing was run."""
    grid = np.full((len(config.strides), len(config.noises_px)), np.nan)
    for i, stride in enumerate(sorted(config.strides)):
        for j, noise in enumerate(config.noises_px):
            key = (method, order, stride, noise)
            mine = [r["success"] for r in rows if (r["method"], r["order"], r["stride"], r["noise_px"]) == key]
            grid[i, j] = np.mean(mine) if mine else np.nan
    return grid


def summary(rows: list[dict[str, Any]], config: Config) -> list[str]:
    """One line an order and method: mean success over all cells that were run, and at every 8th scan."""
    lines = []
    for order in config.orders:
        for method in config.methods:
            mine = [row for row in rows if (row["method"], row["order"]) == (method, order)]
            if mine:
                eighth = [row["success"] for row in mine if row["stride"] == 8]
                at_eighth = f", at every 8th scan {np.mean(eighth):.0%} of {len(eighth)}" if eighth else ""
                lines.append(
                    f"{order}, {method}: {np.mean([r['success'] for r in mine]):.0%} of {len(mine)}{at_eighth}"
                )
    return lines


def _write(folder: Any, rows: list[dict[str, Any]], config: Config) -> None:
    """metrics.json and one picture an order."""
    from dpmjax import viz

    good = [row for row in rows if row["is_trusted"]]
    metrics = {
        "success_threshold_px": SUCCESS_PX,
        "summary": summary(rows, config),
        "num_called_good": len(good),
        "success_of_good": float(np.mean([row["success"] for row in good])) if good else None,
        "rows": rows,
    }
    write_metrics(folder, metrics, seed=config.seed)
    for order in config.orders:
        grids = {method: success_grid(rows, method, order, config) for method in config.methods}
        figure = viz.success_grids_figure(
            grids,
            [f"1/{stride}" for stride in sorted(config.strides)],
            [f"{noise:g}" for noise in config.noises_px],
            row_label="scans used",
            column_label="range noise, px",
        )
        viz.save_figure(figure, folder / f"{order}.png")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
