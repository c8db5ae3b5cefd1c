"""Where each method works: success over the distance of the scans, the range noise, and with or without their order.

    python -m experiments.deepmapping_limits --limit 3       three trajectories a cell
    python -m experiments.deepmapping_limits --resume        go on where the last run stopped

Trajectories of 256 poses in the built-in worlds, thinned to every 1st, 2nd, 4th, 8th and 16th scan, with range noise of
0, 1, 3 and 10 px, in order and shuffled. The hard cells come first. Results: metrics.json, ordered.png, shuffled.png.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from tyro.conf import arg

from dpmjax import simulation, viz
from experiments import _deepmapping_methods as shared
from experiments import _deepmapping_tables as tables
from experiments._command import check_least, check_names, run_command
from experiments._deepmapping_methods import Task
from experiments._run_folder import RunFolder, write_metrics

EXPERIMENT = "deepmapping_limits"
COLUMNS = (
    "icp-plane", "icp-refined", "lnet-zero", "lnet-icp", "direct-adam", "search", "search-refined",
    "global-deepmapping", "refined-deepmapping",
)  # fmt: skip
ORDERS = ("ordered", "shuffled")
NUM_SCANS, NUM_WORLDS = 256, 3


@dataclass(frozen=True, kw_only=True)
class Config(tables.TableOptions):
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

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        super().__post_init__()
        check_names("--orders", self.orders, ORDERS)
        check_least(self, limit=1, strides=1, noises_px=0)
        if max(self.strides) > NUM_SCANS // 4:
            raise ValueError(f"--strides: expected at most {NUM_SCANS // 4}, got {max(self.strides)}")


def main(config: Config) -> list[dict[str, Any]]:
    """Runs what is missing, cell by cell."""
    grid = itertools.product(config.strides, range(config.limit), config.noises_px, config.orders)
    cells = [{"stride": stride, "noise_px": noise, "order": order, "walk": walk} for stride, walk, noise, order in grid]
    return tables.run_table(config, EXPERIMENT, cells, partial(_prepare, config), partial(_write, config))


def _prepare(config: Config, cell: dict[str, Any]) -> tuple[Task, dict[str, Any]]:
    walk = cell["walk"]
    sequence = simulation.simulate_sequence(
        walk % NUM_WORLDS, NUM_SCANS, seed=200 + walk, range_noise_px=cell["noise_px"]
    )
    scans = sequence.take(slice(None, None, cell["stride"]))
    return shared.make_task(scans, is_ordered=cell["order"] == "ordered", steps=config.steps, seed=config.seed), {}


def success_grid(rows: list[dict[str, Any]], method: str, order: str, config: Config) -> NDArray[np.float64]:
    """Returns (strides, noises) success rates, smallest stride first; NaN where nothing was run."""
    cells: dict[tuple[Any, ...], list[bool]] = defaultdict(list)
    for row in rows:
        cells[row["method"], row["order"], row["stride"], row["noise_px"]].append(row["success"])
    means = {cell: np.mean(successes) for cell, successes in cells.items()}
    strides = sorted(config.strides)
    return np.array([[means.get((method, order, i, j), np.nan) for j in config.noises_px] for i in strides])


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Returns one line for each order and method: mean success of all cells that were run, and at every 8th scan."""
    lines = []
    for order, method in dict.fromkeys((row["order"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["order"], row["method"]) == (order, method)]
        eighth = [row["success"] for row in mine if row["stride"] == 8]
        at_eighth = f", at every 8th scan {np.mean(eighth):.0%} of {len(eighth)}" if eighth else ""
        lines.append(f"{order}, {method}: {np.mean([row['success'] for row in mine]):.0%} of {len(mine)}{at_eighth}")
    return lines


def _write(config: Config, folder: RunFolder, rows: list[dict[str, Any]], not_run: dict[str, str]) -> str:
    """Writes metrics.json and one picture an order; returns the summary."""
    lines = summary(rows)
    metrics = {"success_threshold_px": shared.SUCCESS_PX, "summary": lines, "not_run": not_run}
    write_metrics(folder, metrics | tables.success_of_trusted(rows), seed=config.seed, rows=rows)
    methods = dict.fromkeys(row["method"] for row in rows)
    for order in config.orders:
        figure = viz.success_grids_figure(
            {method: success_grid(rows, method, order, config) for method in methods},
            {"scans used": [f"1/{stride}" for stride in sorted(config.strides)]},
            {"range noise, px": [f"{noise:g}" for noise in config.noises_px]},
        )
        viz.save_figure(figure, folder / f"{order}.png")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
