"""Tables of results: one resumable row and file for each case; then table.md, metrics.json and the pictures."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from tqdm import tqdm

from dpmjax.cli.command import StopFlag
from dpmjax.cli.info import git_hash, versions
from dpmjax.cli.result_files import UNKNOWN, load_json, write_json
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics
from dpmjax.io.files import write_atomically

Row = dict[str, Any]
Item = TypeVar("Item")


class RowStopped(Exception):
    """A signal has stopped the work on a row, which is left out."""


class TableRun(NamedTuple):
    """An open table.

    Attributes:
        folder: folder of the run.
        is_stopped: returns True after a signal; the work on a row then ends by `RowStopped`.
    """

    folder: RunFolder
    is_stopped: Callable[[], bool]

    def check_stop(self) -> None:
        """Raises `RowStopped` after a signal; a callback of the work on a row."""
        if self.is_stopped():
            raise RowStopped

    def until_stopped(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yields the items of the work on a row, and raises `RowStopped` after a signal."""
        for item in items:
            self.check_stop()
            yield item


class Summary(NamedTuple):
    """Summary of the rows.

    Attributes:
        numbers: entries of metrics.json beside the rows.
        text: content of table.md, also printed.
        write_more: writes pictures and further files into the folder; None for none.
        rows: rows of metrics.json; None for the rows of the cases.
    """

    numbers: Row
    text: str
    write_more: Callable[[RunFolder], None] | None = None
    rows: Sequence[Row] | None = None


def run_table(
    config: RunOptions,
    name: str,
    cases: Iterable[Row],
    work: Callable[..., Row],
    report: Callable[[list[Row]], Summary],
) -> list[Row]:
    """Computes the missing rows of the run folder, and writes table.md, metrics.json and the pictures.

    Args:
        config: options of the run.
        name: name of the command.
        cases: entries that identify each row.
        work: makes the remaining entries of a row, from the open table and the entries of its case as keywords.
        report: summarises all rows.

    Returns:
        The rows; after a signal, those until then.
    """
    folder = open_run_folder(config, name)
    with recording(folder), StopFlag() as stop:
        table, rows = TableRun(folder, lambda: stop.is_requested), list[Row]()
        with suppress(RowStopped):
            for case in table.until_stopped(tqdm(list(cases), unit=" rows")):
                rows.append(do_row(folder.path, case, partial(work, table, **case), seed=config.seed))
        summary = report(rows) if rows else Summary({}, "no row is finished")
        # Numbers come before pictures, so that they are written even if a picture fails.
        metrics = {**summary.numbers, "status": stop.status}
        note = write_metrics(folder, metrics, seed=config.seed, rows=rows, table=summary.rows)
        write_atomically(folder / "table.md", summary.text + (f"\n\n{note}.\n" if note else "\n"))
        print(summary.text)
        if summary.write_more is not None:
            summary.write_more(folder)
    print(f"results in {folder.path}")
    return rows


def group_rows(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Returns the rows by the values of some keys, in the order in which they first appear."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def markdown(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Returns a table as Markdown; floats have two decimals, None and floats that are not finite a dash."""
    lines = [columns, *([cell_text(cell) for cell in row] for row in rows)]
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, "|" + "---|" * len(columns), *body])


def cell_text(value: object, decimals: int = 2) -> str:
    """Returns the text of a cell: a float with its decimals, a dash for None, NaN and infinity, else the text."""
    if isinstance(value, float):
        return f"{value:.{decimals}f}" if math.isfinite(value) else "-"
    return "-" if value is None else str(value)


def do_row(folder: Path, case: Row, work: Callable[[], Row], *, seed: int) -> Row:
    """Computes one row of results, or reads it from an earlier run.

    Each row is a file of its own below `rows/`, written whole, and carries the commit, the versions and the seed that
    made it.

    Args:
        folder: folder of the run.
        case: identifies the row and becomes part of it.
        work: makes the remaining entries of the row.
        seed: seed of the run.

    Returns:
        The row. The commit of a row without one is "unknown".
    """
    path = row_path(folder, case)
    if path.exists():
        return {"git_hash": UNKNOWN, **load_json(path)}
    row = {**case, **work(), "git_hash": git_hash() or UNKNOWN, "seed": seed}
    row["versions"] = ", ".join(f"{name} {version}" for name, version in versions().items())
    write_json(path, row)
    return row


def row_path(folder: Path, case: Mapping[str, Any]) -> Path:
    """Returns the file of a row, under a readable name that no other case has."""
    text = "_".join(f"{key}-{value}" for key, value in case.items())
    digest = hashlib.sha256(text.encode()).hexdigest()[:6]
    return folder / "rows" / f"{text.replace('.', 'p').replace('/', '-')[:120]}_{digest}.json"
