"""The rows that a benchmark returns, how they are printed, and the times among them.

The first call of a function is timed apart from later ones, and timing includes the wait for results.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import jax

COLUMNS = ("name", "case", "metric", "value", "unit")


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


def format_table(named_rows: Iterable[tuple[str, Row]]) -> str:
    """Lays rows out under `COLUMNS`, numbers aligned to the right."""
    cells = [COLUMNS, *((name, row.case, row.metric, f"{row.value:.4g}", row.unit) for name, row in named_rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(COLUMNS))]
    lines = [_format_line(line, widths) for line in cells]
    return "\n".join([lines[0], "-" * len(lines[0].rstrip()), *lines[1:]])


def _format_line(cells: Sequence[str], widths: Sequence[int]) -> str:
    name, case, metric, value, unit = (
        cell.rjust(width) if column == COLUMNS.index("value") else cell.ljust(width)
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return f"{name}  {case}  {metric}  {value}  {unit}".rstrip()


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
