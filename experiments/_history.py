"""The history of a run: a CSV file that grows by the row and survives a crash and a resume."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self


class HistoryFile:
    """The table of a run, one row a record, each on disk as soon as it is known.

    Args:
        path: the file; it is replaced, but for the rows to keep.
        columns: names of the columns, the first counts steps.
        keep_until: in a resumed run, rows with a larger first column are dropped; they will be computed again.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, keep_until: int | None = None) -> None:
        kept: list[dict[str, str]] = []
        if keep_until is not None and path.exists():
            kept = [row for row in read_history(path) if int(row[columns[0]]) <= keep_until]
        unfinished = path.with_name(f".{path.name}.tmp")
        with unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(kept)
        os.replace(unfinished, path)
        self._file = path.open("a", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, columns, lineterminator="\n")

    def append(self, **row: object) -> None:
        """Adds a row; a column that is not given stays empty."""
        self._writer.writerow(row)
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()


def read_history(path: Path) -> list[dict[str, str]]:
    """Returns the rows of the table; a last line that a crash cut off is left out."""
    text = path.read_text(encoding="utf-8")
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
