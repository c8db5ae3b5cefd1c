"""Tables of methods by sets of scans: one row for each method and set."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dpmjax import cli
from experiments._deepmapping_methods import METHODS, SUCCESS_PX, Task, assess, choose

NOT_RUN = {
    "go-icp": "its packages on PyPI search the turns of 3-D clouds, which may turn a flat scan over; py-goicp does not "
    "build with today's setuptools, py-simple-go-icp-interface took 20 s for one pair of flat scans and gave up",
}
"""Baselines of the paper that have no column, and why."""
# A candidate whose ATE is larger than the least by no more than this is as good.
_AS_GOOD_PX = 0.1


@dataclass(frozen=True, kw_only=True)
class TableOptions(cli.RunOptions):
    """Options of a comparison of methods."""

    methods: tuple[str, ...] = tuple(METHODS)
    """Columns; of all of them, those whose package cannot be imported are left out and named."""
    steps: int | None = None
    """Steps of the fit; without it, the preset decides."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        cli.check_names("--methods", self.methods, METHODS)
        cli.check_least(self, steps=2)


def run_method(name: str, task: Task) -> cli.Row:
    """Returns one row: errors, time and assessment of the kept candidate, and the numbers of every candidate."""
    method = METHODS[name]
    begun, begun_cpu = time.perf_counter(), time.process_time()
    found = method.run(task)
    candidates = found if isinstance(found, dict) else {method.title: found}
    # The choice belongs to a method that has several candidates, and to its time.
    chosen = choose(task, candidates) if len(candidates) > 1 else None
    seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
    kept, measured = chosen or choose(task, candidates)
    return {
        **cli.planar_errors(task.sequence, candidates[kept]),
        "success": measured[kept]["ate_px"] < SUCCESS_PX,
        "seconds": seconds,
        "cpu_s": cpu_seconds,
        "kept": kept,
        "candidates": measured,
        **assess(task, candidates[kept]),
    }


def success_of_trusted(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns how many maps were trusted, and the share of these that are right."""
    trusted = [row["success"] for row in rows if row["is_trusted"]]
    return {"num_trusted": len(trusted), "success_of_trusted": float(np.mean(trusted)) if trusted else None}


def best_kept(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns how many rows have several candidates, and of how many the best one was kept, or one nearly as good."""
    regrets = [
        row["ate_px"] - min(numbers["ate_px"] for numbers in row["candidates"].values())
        for row in rows
        if len(row["candidates"]) > 1
    ]
    return {"num_choices": len(regrets), "num_best_kept": sum(regret <= _AS_GOOD_PX for regret in regrets)}


def run_methods(
    config: TableOptions,
    experiment: str,
    cells: Sequence[cli.Row],
    prepare: Callable[[cli.Row], tuple[Task, cli.Row]],
    report: Callable[[list[cli.Row], dict[str, str]], cli.Summary],
) -> list[cli.Row]:
    """Runs every method on every cell; what an earlier run has done is read from its files.

    Args:
        config: options.
        experiment: name of the experiment.
        cells: what identifies each set of scans.
        prepare: makes the task of a cell, and what its rows carry besides the results.
        report: summarises the rows, and names the methods that were not run, with the reasons.

    Returns:
        All rows.

    Raises:
        ValueError: the package of a chosen method cannot be imported.
    """
    packages = {name: package for name in config.methods if (package := METHODS[name].package) is not None}
    reasons = {name: cli.why_not_importable(package) for name, package in packages.items()}
    unusable = {name: reason for name, reason in reasons.items() if reason is not None}
    if unusable and set(config.methods) != set(METHODS):
        name, reason = next(iter(unusable.items()))
        raise ValueError(f"--methods {name}: {reason}")
    not_run = NOT_RUN | unusable
    # The scans are made once for all methods, and not at all where all rows exist.
    prepared = lru_cache(maxsize=1)(lambda *cell: prepare(dict(cell)))

    def work(_: cli.TableRun, method: str, **cell: Any) -> cli.Row:
        task, extra = prepared(*cell.items())
        return run_method(method, task) | extra

    cases = [{"method": method, **cell} for cell in cells for method in config.methods if method not in not_run]
    rows = cli.run_table(config, experiment, cases, work, lambda rows: report(rows, not_run))
    print(*(f"{name}: not run ({reason})" for name, reason in not_run.items()), sep="\n")
    return rows
