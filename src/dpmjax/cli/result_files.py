"""Files of a run in formats that several commands write: JSON, tables, trajectories; and the bar of its progress."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from dpmjax import io


def write_json(path: Path, value: Any) -> None:
    """Writes dataclasses, paths and NumPy values as JSON, atomically."""
    io.write_atomically(path, json.dumps(as_json(value), indent=2, allow_nan=False) + "\n")


def load_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object; a file that holds something else is a ValueError."""
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


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes a CSV file atomically: these columns, numbers with six digits, truth values as 0 and 1, None as empty."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(row[column]) for column in columns] for row in rows)
    io.write_atomically(path, text.getvalue())


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}"
    return int(value) if isinstance(value, bool) else value


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


@contextmanager
def progress_bar(description: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Shows a bar while the block runs; yields a callback with the number of finished items and of all.

    Args:
        description: shown before the bar.
        unit: unit of the numbers, with a space before it.

    Yields:
        The callback.
    """
    with tqdm(desc=description, unit=unit, dynamic_ncols=True) as bar:

        def on_progress(num_done: int, num_all: int) -> None:
            bar.total = num_all
            bar.update(num_done - bar.n)

        yield on_progress
