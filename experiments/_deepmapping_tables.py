"""Tables of methods by sets of scans: a file of its own for each row, so that a killed run goes on."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from tqdm import tqdm

from dpmjax.cli import (
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    check_names,
    do_row,
    open_run_folder,
    planar_errors,
    recording,
    why_not_importable,
)
from experiments._deepmapping_methods import METHODS, SUCCESS_PX, Task, assess, choose

NOT_RUN = {
    "go-icp": "its packages on PyPI search the turns of 3-D clouds, which may turn a flat scan over; py-goicp does not "
    "build with today's setuptools, py-simple-go-icp-interface took 20 s for one pair of flat scans and gave up",
}
"""Baselines of the paper that have no column, and why."""
# A candidate whose ATE is larger than the least by no more than this is as good.
_AS_GOOD_PX = 0.1


@dataclass(frozen=True, kw_only=True)
class TableOptions(RunOptions):
    """Options of a comparison of methods."""

    methods: tuple[str, ...] = tuple(METHODS)
    """Columns; of all of them, those whose package cannot be imported are left out and named."""
    steps: int | None = None
    """Steps of the fit; without it, the preset decides."""

    def __post_init__(self) -> None:
        """Checks names and ranges."""
        check_names("--methods", self.methods, METHODS)
        check_least(self, steps=2)


def unusable_methods(names: Sequence[str]) -> dict[str, str]:
    """Returns the methods whose package cannot be imported, and why."""
    packages = {name: package for name in names if (package := METHODS[name].package) is not None}
    reasons = {name: why_not_importable(package) for name, package in packages.items()}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def run_method(name: str, task: Task) -> dict[str, Any]:
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
        **planar_errors(task.sequence, candidates[kept]),
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


def run_table(
    config: TableOptions,
    experiment: str,
    cells: Sequence[dict[str, Any]],
    prepare: Callable[[dict[str, Any]], tuple[Task, dict[str, Any]]],
    write: Callable[[RunFolder, list[dict[str, Any]], dict[str, str]], str],
) -> list[dict[str, Any]]:
    """Runs every method on every cell; what an earlier run has done is read from its files.

    Args:
        config: options.
        experiment: name of the experiment.
        cells: what identifies each set of scans.
        prepare: makes the task of a cell, and what its rows carry besides the results.
        write: writes the rows so far, and why some methods were not run, after each cell; returns a summary to print.

    Returns:
        All rows.

    Raises:
        ValueError: the package of a chosen method cannot be imported.
    """
    unusable = unusable_methods(config.methods)
    if unusable and set(config.methods) != set(METHODS):
        name, reason = next(iter(unusable.items()))
        raise ValueError(f"--methods {name}: {reason}")
    not_run = NOT_RUN | unusable
    folder = open_run_folder(config, experiment)

    def work(method: str, prepared: Callable[[], tuple[Task, dict[str, Any]]]) -> dict[str, Any]:
        task, extra = prepared()
        return run_method(method, task) | extra

    rows: list[dict[str, Any]] = []
    summary = ""
    with recording(folder), StopFlag() as stop:
        for cell in tqdm(cells, unit=" sets"):
            # The scans are made once for all methods, and not at all where all rows exist.
            prepared = cache(partial(prepare, cell))
            for method in config.methods:
                if stop.is_requested:
                    return rows
                if method not in not_run:
                    case = {"method": method, **cell}
                    rows.append(do_row(folder.path, case, partial(work, method, prepared), seed=config.seed))
            summary = write(folder, rows, not_run)
    print(summary, *(f"{name}: not run ({reason})" for name, reason in not_run.items()), sep="\n")
    print(f"results in {folder.path}")
    return rows
