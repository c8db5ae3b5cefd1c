"""Times a function as its user meets it: the first call apart from the others, results waited for."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import jax

from benchmarks.rows import Row


class Timing(NamedTuple):
    """How long calls took, in seconds.

    Attributes:
        compile_s: the first call minus the median of the others: compilation and first allocation. Zero where nothing
            was left to compile.
        median_s: of the calls after the first.
        min_s: of the calls after the first.
    """

    compile_s: float
    median_s: float
    min_s: float

    def rows(self, case: str) -> list[Row]:
        """The timing as rows of the table."""
        return [
            Row(case, "compile", self.compile_s, "s"),
            Row(case, "median", 1e3 * self.median_s, "ms"),
            Row(case, "min", 1e3 * self.min_s, "ms"),
        ]


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
