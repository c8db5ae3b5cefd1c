"""Speed, memory and accuracy, measured side by side with peers in one run; compile time apart from run time.

A benchmark is a function `run(quick: bool) -> list[Row]`; `__main__.py` lists them. The first call of a
function is timed apart from later ones, and timing includes the wait for results.
"""

from __future__ import annotations

import importlib
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import jax

from dpmjax.cli import environment

# Folder of recorded data; without it the cases that need them are left out.
DATA = Path(os.environ.get("DPMJAX_DATA", "../shared/data"))


class Row(NamedTuple):
    """One measured number.

    Attributes:
        case: measured case and program ("k_nearest 4096x4096: dpmjax").
        metric: kind of the number ("median", "compile", "ate").
        value: the number.
        unit: its unit; "" for a pure number.
    """

    case: str
    metric: str
    value: float
    unit: str


def in_new_process(function: Callable[..., Any], *arguments: object, **environment: str) -> Any:
    """Returns what a function of a module returns in a fresh process, whose peak memory is its own.

    Args:
        function: the function.
        *arguments: its arguments.
        **environment: variables of the environment of that process.

    Returns:
        Its result.
    """
    with patch.dict(os.environ, environment), ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run_benchmark(name: str, quick: bool) -> tuple[list[Row], dict[str, Any]]:
    """Returns the rows of a benchmark, with the peak memory of this process, and the machine."""
    rows = importlib.import_module(f"benchmarks.{name}").run(quick)
    machine = environment()
    return [*rows, Row("whole process", "peak memory", machine.pop("peak_rss_gb"), "GB")], machine


class Timing(NamedTuple):
    """Seconds of calls.

    Attributes:
        compile_s: the first call minus the median of later ones: compilation and first allocation. Zero where nothing
            was left to compile.
        median_s: of the calls after the first.
        min_s: of the calls after the first.
    """

    compile_s: float
    median_s: float
    min_s: float

    def rows(self, case: str, *, is_compiled: bool = True) -> list[Row]:
        """Returns the timing as rows of the table, that of the compilation first, where there is one."""
        compiling = [Row(case, "compile", self.compile_s, "s")] if is_compiled else []
        calls = {"median": self.median_s, "min": self.min_s}
        return compiling + [Row(case, name, 1e3 * seconds, "ms") for name, seconds in calls.items()]


def measure(function: Callable[..., object], *args: object, repeats: int = 20) -> Timing:
    """Calls `function(*args)` once and then `repeats` times, each time until its arrays are there.

    Raises:
        ValueError: `repeats` is less than one.
    """
    if repeats < 1:
        raise ValueError(f"repeats: expected at least 1, got {repeats}")
    first_s, *later_s = (_seconds(function, *args) for _ in range(repeats + 1))
    median_s = statistics.median(later_s)
    return Timing(max(0.0, first_s - median_s), median_s, min(later_s))


def _seconds(function: Callable[..., object], *args: object) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*args))
    return time.perf_counter() - start
