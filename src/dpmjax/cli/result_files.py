"""Result files: atomically written JSON and CSV, notes on commits, and a table that grows row by row."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax import io

UNKNOWN = "unknown"


def write_json(path: Path, value: Any) -> None:
    """Writes dataclasses, paths and NumPy values as JSON, atomically."""
    io.write_atomically(path, json.dumps(as_json(value), indent=2, allow_nan=False) + "\n")


def load_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object.

    Args:
        path: the file.

    Returns:
        The object.

    Raises:
        ValueError: the file is no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def as_json(value: Any) -> Any:
    """Returns the same value made of JSON's types; NaN and infinity become null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return {str(name): as_json(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "__array__"):
        return as_json(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def named_initial(numbers: Mapping[str, float]) -> dict[str, float]:
    """Returns errors under their names for the initial poses, such as ate_initial_m for ate_m; counts are left out."""
    errors = {name: value for name, value in numbers.items() if not name.startswith("num_")}
    return {"_initial_".join(name.rsplit("_", 1)): value for name, value in errors.items()}


def commits_note(rows: Sequence[Mapping[str, Any]], commit: str | None) -> str | None:
    """Returns a note on rows of other commits than the one that writes the file.

    Args:
        rows: rows with `git_hash`, and `method` where there are several.
        commit: commit of the program that writes the file; None where it is unknown.

    Returns:
        One sentence, or None where all rows are of `commit`.
    """
    methods: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if row.get("git_hash", UNKNOWN) != commit:
            methods[row.get("git_hash", UNKNOWN)].append(row.get("method", ""))
    if not methods:
        return None

    def short(name: str) -> str:
        return name[:10] + ("+changes" if name.endswith("+changes") else "")

    parts = [
        f"{len(names)} of {short(made_by)}" + (f" ({', '.join(sorted(set(names)))})" if any(names) else "")
        for made_by, names in methods.items()
    ]
    count, own = sum(map(len, methods.values())), short(commit or UNKNOWN)
    return f"{count} of {len(rows)} rows were made by another commit than this file ({own}): {'; '.join(parts)}"


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes a CSV file atomically."""
    text = StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    io.write_atomically(path, text.getvalue())


def write_poses(folder: Path, poses: np.ndarray, name: str = "trajectory", **tum: Any) -> None:
    """Writes poses in the plane or in space as NAME.npy, NAME_tum.txt and NAME_kitti.txt.

    Args:
        folder: folder of the files.
        poses: poses of all scans.
        name: beginning of the names of the files.
        **tum: options of `io.write_tum`, such as the times.
    """
    io.write_poses_npy(folder / f"{name}.npy", poses)
    io.write_tum(folder / f"{name}_tum.txt", poses, **tum)
    io.write_kitti(folder / f"{name}_kitti.txt", poses)


class HistoryFile:
    """The table of a run, one row for each record, written at once.

    Args:
        path: the CSV file; it is replaced, except for the rows to keep.
        columns: names of the columns, the first counts steps.
        keep_until: in a resumed run, rows with a larger first column are dropped; they will be computed again.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, keep_until: int | None = None) -> None:
        earlier = read_history(path) if keep_until is not None and path.exists() else []
        write_table(path, columns, [row for row in earlier if int(row[columns[0]]) <= (keep_until or 0)])
        self._file = path.open("a", newline="", encoding="utf-8", errors="surrogateescape")
        self._writer = csv.DictWriter(self._file, columns, lineterminator="\n")

    def append(self, **row: object) -> None:
        """Adds a row; a column that is not given stays empty."""
        self._writer.writerow(row)
        self._file.flush()

    def __enter__(self) -> HistoryFile:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


def read_history(path: Path) -> list[dict[str, str]]:
    """Returns the rows of the table, without a last line that a crash has cut off."""
    text = path.read_text(encoding="utf-8", errors="surrogateescape")
    return list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
