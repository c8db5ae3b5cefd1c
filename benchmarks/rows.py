"""The rows that a benchmark returns, and how they are printed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

COLUMNS = ("name", "case", "metric", "value", "unit")


class Row(NamedTuple):
    """One measured number.

    Attributes:
        case: what was measured, by which program ("k_nearest 4096x4096: dpmjax").
        metric: what the number is ("median", "compile", "ate").
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
