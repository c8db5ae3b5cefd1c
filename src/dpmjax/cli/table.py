"""The table of an experiment: a row for each case in a CSV file, resumable row by row, and a summary of the rows.

rows = fill_table(run, cases, work)
return write_summary(run, summarize(rows, ("method",), ("ate_px", "success")))
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

from tqdm import tqdm

from dpmjax import io
from dpmjax.cli.info import git_hash
from dpmjax.cli.run import Run

Row = dict[str, Any]


def fill_table(run: Run, cases: Iterable[Row], work: Callable[..., Row | None], name: str = "rows.csv") -> list[Row]:
    """Computes the missing rows of a table, and writes each row at once.

    Args:
        run: the open run.
        cases: entries that identify each row, the same names in each.
        work: called with the entries of a case as keywords. It returns the remaining entries of the row, with the same
            names in each row; or None after a signal.
        name: the file.

    Returns:
        The rows of the cases in their order, with the commit that made each of them; an empty cell is None. After a
        signal, the rows until then.
    """
    cases, commit = list(cases), git_hash() or "unknown"

    def key(row: Row) -> tuple[str, ...]:
        """Returns the identity of a row, in the form of the file."""
        return tuple(str(row[column]) for column in cases[0])

    done = {key(row) for row in run.continue_table(name)}
    for case in tqdm([case for case in cases if key(case) not in done], unit=" rows", dynamic_ncols=True):
        row = None if run.is_stopped else work(**case)
        if row is None:
            break
        run.append_row(name, **case, **row, commit=commit)
    found = {key(row): row for row in run.read_table(name)}
    rows = (found[key(case)] for case in cases if key(case) in found)
    return [{column: _parse(text) for column, text in row.items()} for row in rows]


def summarize(rows: Iterable[Row], by: Sequence[str], columns: Sequence[str]) -> list[Row]:
    """Summarizes the rows that are equal in some columns, in the order in which they first appear.

    Args:
        rows: from `fill_table`.
        by: columns whose values make the groups.
        columns: columns to summarize, without their empty cells.

    Returns:
        A row for each group: its values, the number of its rows, medians of numbers, and shares of truth values with
        their 95 % intervals (Wilson).
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return [
        dict(zip(by, key, strict=True)) | {"num_rows": len(group)} | _summary(group, columns)
        for key, group in groups.items()
    ]


def _summary(rows: list[Row], columns: Sequence[str]) -> Row:
    from scipy import stats

    found: Row = {}
    for name in columns:
        values = [row[name] for row in rows if row.get(name) is not None]
        if values and all(isinstance(value, bool) for value in values):
            interval = stats.binomtest(sum(values), len(values)).proportion_ci(method="wilson")
            found[name] = sum(values) / len(values)
            found |= {f"{name}_low": float(interval.low), f"{name}_high": float(interval.high)}
        else:
            found[name] = statistics.median(values) if values else None
    return found


def write_summary(run: Run, summary: Sequence[Row], *notes: str, name: str = "table") -> Row:
    """Prints a summary and writes it as NAME.md.

    Args:
        run: the open run.
        summary: from `summarize`.
        *notes: sentences below the table.
        name: name of the table.

    Returns:
        The entry of `metrics.json`: the summary under `name`.
    """
    text = "\n\n".join([format_table(summary), *notes])
    io.write_atomically(run / f"{name}.md", f"{text}\n")
    print(text)
    return {name: list(summary)}


def format_table(rows: Sequence[Row]) -> str:
    """Returns rows as Markdown. Numbers have four digits, a share has its interval, None is a dash."""
    if not rows:
        return "no row is finished"
    columns = [name for name in rows[0] if not name.endswith(("_low", "_high"))]
    lines = [columns, ["---"] * len(columns), *([_cell(row, column) for column in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(row: Row, column: str) -> str:
    value = row.get(column)
    if value is None:
        return "-"
    if f"{column}_low" in row and row["num_rows"] > 1:
        return f"{value:.2f} ({row[f'{column}_low']:.2f} to {row[f'{column}_high']:.2f})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _parse(text: str) -> Any:
    """Returns the value of a cell: None for an empty one and for NaN, else a number if Python writes it so, or text."""
    if text in ("", "nan", "True", "False"):
        return {"True": True, "False": False}.get(text)
    for kind in (int, float):
        with suppress(ValueError):
            if str(kind(text)) == text:
                return kind(text)
    return text
