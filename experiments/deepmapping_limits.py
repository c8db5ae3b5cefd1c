"""Where each method works: success over the distance of the scans, the range noise, and with or without their order.

    python -m experiments.deepmapping_limits --limit 3       three trajectories a cell
    python -m experiments.deepmapping_limits --resume        go on where the last run stopped

Trajectories of 256 poses in the built-in worlds, thinned to every 1st, 2nd, 4th, 8th and 16th scan, with range noise of
0, 1, 3 and 10 px, in order and shuffled. The hard cells come first. Results: metrics.json, ordered.png, shuffled.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from tyro.conf import arg

from dpmjax import simulation, viz
from experiments import _deepmapping_methods as shared
from experiments._command import run_command
from experiments._deepmapping_methods import Task
from experiments._run_folder import RunFolder, RunOptions, open_run_folder, write_metrics

EXPERIMENT = "deepmapping_limits"
COLUMNS = ("icp-plane", "icp-refined", "direct-adam", "global-deepmapping", "refined-deepmapping")
ORDERS = ("ordered", "shuffled")
NUM_SCANS, NUM_WORLDS = 256, 3


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the grid."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "methods", "strides", "noises_px", "orders"})

    limit: Annotated[int, arg(metavar="N")] = 3
    """Trajectories in a cell."""
    strides: tuple[int, ...] = (8, 16, 4, 2, 1)
    """Every stride-th scan is used."""
    noises_px: tuple[float, ...] = (0.0, 1.0, 3.0, 10.0)
    """Standard deviations of the range noise."""
    orders: tuple[str, ...] = ORDERS
    """With the order of time, or without."""
    methods: tuple[str, ...] = COLUMNS
    """Methods to compare."""
    steps: int = 600
    """Steps of the fit."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        shared.check_methods(self.methods)
        if not self.orders or any(order not in ORDERS for order in self.orders):
            raise ValueError(f"--orders: expected some of {', '.join(ORDERS)}, got {', '.join(self.orders) or 'none'}")
        if self.limit < 1 or self.steps < 2 or any(s < 1 or s > NUM_SCANS // 4 for s in self.strides):
            raise ValueError(f"--limit, --steps, --strides: expected at least 1, at least 2, 1 to {NUM_SCANS // 4}")
        if any(noise < 0 for noise in self.noises_px):
            raise ValueError(f"--noises-px: expected zero or more, got {self.noises_px}")


def main(config: Config) -> list[dict[str, Any]]:
    """Runs what is missing, cell by cell."""
    folder = open_run_folder(config, EXPERIMENT)
    names, missing = shared.split_by_extras(config.methods)
    cells = [
        {"stride": stride, "noise_px": noise, "order": order, "walk": walk}
        for stride in config.strides
        for walk in range(config.limit)
        for noise in config.noises_px
        for order in config.orders
    ]
    write = partial(_write, folder, config)
    rows = shared.run_cells(folder, cells, names, partial(_prepare, config), write, seed=config.seed)
    for line in summary(rows):
        print(line)
    for name, reason in missing.items():
        print(f"{name}: not run ({reason})")
    print(f"results in {folder.path}")
    return rows


def _prepare(config: Config, cell: dict[str, Any]) -> tuple[Task, dict[str, Any]]:
    walk = cell["walk"]
    sequence = simulation.simulate_sequence(
        walk % NUM_WORLDS, NUM_SCANS, seed=200 + walk, range_noise_px=cell["noise_px"]
    )
    scans = sequence.take(slice(None, None, cell["stride"]))
    return shared.make_task(scans, is_ordered=cell["order"] == "ordered", steps=config.steps, seed=config.seed), {}


def success_grid(rows: list[dict[str, Any]], method: str, order: str, config: Config) -> NDArray[np.float64]:
    """(strides, noises) success rates, smallest stride first; NaN where nothing was run."""
    grid = np.full((len(config.strides), len(config.noises_px)), np.nan)
    for i, stride in enumerate(sorted(config.strides)):
        for j, noise in enumerate(config.noises_px):
            key = (method, order, stride, noise)
            mine = [r["success"] for r in rows if (r["method"], r["order"], r["stride"], r["noise_px"]) == key]
            grid[i, j] = np.mean(mine) if mine else np.nan
    return grid


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One line for each order and method: mean success over all cells that were run, and at every 8th scan."""
    lines = []
    for order, method in dict.fromkeys((row["order"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["order"], row["method"]) == (order, method)]
        eighth = [row["success"] for row in mine if row["stride"] == 8]
        at_eighth = f", at every 8th scan {np.mean(eighth):.0%} of {len(eighth)}" if eighth else ""
        lines.append(f"{order}, {method}: {np.mean([row['success'] for row in mine]):.0%} of {len(mine)}{at_eighth}")
    return lines


def _write(folder: RunFolder, config: Config, rows: list[dict[str, Any]]) -> None:
    """metrics.json and one picture an order."""
    trusted = [row["success"] for row in rows if row["is_trusted"]]
    metrics = {
        "success_threshold_px": shared.SUCCESS_PX,
        "summary": summary(rows),
        "num_trusted": len(trusted),
        "success_of_trusted": float(np.mean(trusted)) if trusted else None,
    }
    write_metrics(folder, metrics, seed=config.seed, rows=rows)
    methods = dict.fromkeys(row["method"] for row in rows)
    for order in config.orders:
        figure = viz.success_grids_figure(
            {method: success_grid(rows, method, order, config) for method in methods},
            {"scans used": [f"1/{stride}" for stride in sorted(config.strides)]},
            {"range noise, px": [f"{noise:g}" for noise in config.noises_px]},
        )
        viz.save_figure(figure, folder / f"{order}.png")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
