"""Limits of each method: success over the distance of the scans and the range noise, with and without their order.

    python -m experiments.deepmapping_limits --limit 3       three trajectories a cell
    python -m experiments.deepmapping_limits --resume        go on where the last run stopped

Trajectories of 256 poses in the built-in worlds are thinned to every 1st, 2nd, 4th, 8th and 16th scan. Range noise is
0, 1, 3 and 10 px; the scans are taken in order and shuffled. The hard cells come first. With --worlds grove crowd they
lead through worlds without straight walls, and through offices in which people walk. Results: metrics.json, table.md
(every candidate, and how often the best one was kept or one within 0.1 px).
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from tyro.conf import arg

from dpmjax import cli, simulation
from experiments import _deepmapping_methods as shared
from experiments._deepmapping_methods import Task

EXPERIMENT = "deepmapping_limits"
COLUMNS = (
    "icp-plane", "icp-refined", "lnet-zero", "lnet-icp", "direct-adam", "search", "search-refined",
    "global-deepmapping", "refined-deepmapping",
)  # fmt: skip
ORDERS = ("ordered", "shuffled")
WORLDS = ("rooms", "grove", "crowd")
NUM_SCANS, NUM_ROOMS = 256, 3


@dataclass(frozen=True, kw_only=True)
class Config(shared.TableOptions):
    """Options of the grid."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "methods", "strides", "noises_px", "orders", "worlds"})

    limit: Annotated[int, arg(metavar="N")] = 3
    """Trajectories in a cell."""
    strides: tuple[int, ...] = (8, 16, 4, 2, 1)
    """Every stride-th scan is used."""
    noises_px: tuple[float, ...] = (0.0, 1.0, 3.0, 10.0)
    """Standard deviations of the range noise."""
    worlds: tuple[str, ...] = WORLDS[:1]
    """rooms: the three built-in worlds in turn; grove, crowd: a world of that kind for each walk."""
    orders: tuple[str, ...] = ORDERS
    """With the order of time, or without."""
    methods: tuple[str, ...] = COLUMNS
    """Methods to compare."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        super().__post_init__()
        cli.check_names("--orders", self.orders, ORDERS)
        cli.check_names("--worlds", self.worlds, WORLDS)
        cli.check_least(self, limit=1, strides=1, noises_px=0)
        if max(self.strides) > NUM_SCANS // 4:
            raise ValueError(f"--strides: expected at most {NUM_SCANS // 4}, got {max(self.strides)}")


def main(config: Config) -> list[cli.Row]:
    """Runs the missing cases, cell by cell."""
    axes = {
        "world": config.worlds,
        "stride": config.strides,
        "walk": range(config.limit),
        "noise_px": config.noises_px,
        "order": config.orders,
    }
    cells = [dict(zip(axes, cell, strict=True)) for cell in itertools.product(*axes.values())]
    return shared.run_methods(config, EXPERIMENT, cells, partial(_prepare, config), partial(report, config))


def _prepare(config: Config, cell: cli.Row) -> tuple[Task, cli.Row]:
    walk, kind = cell["walk"], cell["world"]
    world = walk % NUM_ROOMS if kind == "rooms" else f"{kind}-{walk}"
    sequence = simulation.simulate_sequence(world, NUM_SCANS, seed=200 + walk, range_noise_px=cell["noise_px"])
    scans = sequence.take(slice(None, None, cell["stride"]))
    return shared.make_task(scans, is_ordered=cell["order"] == "ordered", steps=config.steps, seed=config.seed), {}


def summary(rows: list[cli.Row]) -> list[str]:
    """Returns a line for each world, order and method: mean success of all cells run, and at every 8th scan."""
    lines = []
    for (world, order, method), mine in cli.group_rows(rows, "world", "order", "method").items():
        eighth = [row["success"] for row in mine if row["stride"] == 8]
        at_eighth = f", at every 8th scan {np.mean(eighth):.0%} of {len(eighth)}" if eighth else ""
        success = np.mean([row["success"] for row in mine])
        lines.append(f"{world}, {order}, {method}: {success:.0%} of {len(mine)}{at_eighth}")
    return lines


def table(rows: list[cli.Row]) -> str:
    """Returns the median ATE of every method and candidate in every cell, as Markdown."""
    columns = dict.fromkeys(_column(row, name) for row in rows for name in row["candidates"])
    lines = []
    for cell, mine in cli.group_rows(rows, "world", "order", "stride", "noise_px").items():
        ates: dict[str, list[float]] = defaultdict(list)
        for row in mine:
            for name, numbers in row["candidates"].items():
                ates[_column(row, name)].append(numbers["ate_px"])
        medians = (f"{np.median(ates[column]):.3g}" if column in ates else "" for column in columns)
        kept = shared.best_kept(mine)
        lines.append([*map(str, cell), *medians, f"{kept['num_best_kept']} of {kept['num_choices']}"])
    return cli.markdown(("world", "order", "every", "noise, px", *columns, "best kept"), lines)


def _column(row: cli.Row, candidate: str) -> str:
    """Returns the heading of a candidate: that of its method where it is the only one."""
    return row["method"] if len(row["candidates"]) == 1 else f"{row['method']}: {candidate}"


def report(config: Config, rows: list[cli.Row], not_run: dict[str, str]) -> cli.Summary:
    """Returns the successes and the table."""
    lines = summary(rows)

    numbers = {"success_threshold_px": shared.SUCCESS_PX, "summary": lines, "not_run": not_run}
    numbers |= shared.success_of_trusted(rows) | shared.best_kept(rows)
    return cli.Summary(numbers, "\n\n".join(["\n".join(lines), table(rows)]))


if __name__ == "__main__":
    cli.end_process(cli.run_command(main, Config, name=EXPERIMENT, description=__doc__))
