"""The folder of a run: finds it, refuses it before any work, links `latest` to it, and writes its files."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax import io

CONFIG, RESULTS = "config.json", Path("results")
# Options that do not change the result.
FREE_OPTIONS = frozenset(
    {"output", "resume", "force", "device", "coordinator", "num_processes", "process_id", "visualize"}
)


def load_options(path: Path, options_type: Any) -> Any:
    """Reads the options of an earlier run; missing options, and those such as `output`, get their defaults.

    Args:
        path: folder of the run.
        options_type: dataclass of the options.

    Returns:
        The options.

    Raises:
        ValueError: its `config.json` is no JSON, or has an option that `options_type` lacks.
    """
    from dpmjax.weights.config_json import config_from_json

    stored = {name: value for name, value in load_json(path / CONFIG).items() if name not in FREE_OPTIONS}
    try:
        return config_from_json(stored, options_type)
    except ValueError as error:
        raise ValueError(f"{path / CONFIG} holds options of another command or version: {error}") from error


def find_run(name: str, output: Path | None) -> Path:
    """Finds the folder of an earlier run.

    Args:
        name: name of the command.
        output: the folder, or None for the latest run of this command.

    Returns:
        The folder.

    Raises:
        ValueError: there is none.
    """
    path = output or RESULTS / name / "latest"
    if not (path / CONFIG).is_file():
        raise ValueError(f"{path} holds no {CONFIG}: it is no run of {name}; name one (--resume -o OUT)")
    return path if output else path.resolve()


def check_same_options(path: Path, options: Any) -> None:
    """Raises a ValueError if a resumed run would have other options than the earlier one."""
    if options.force:
        raise ValueError("--resume continues a run and --force starts it over: give one of them")
    stored, now = load_json(path / CONFIG), as_json(options)
    for name in sorted(stored.keys() & now.keys() - FREE_OPTIONS - options.may_change):
        if stored[name] != now[name]:
            was, is_now = ("not given" if value is None else value for value in (stored[name], now[name]))
            raise ValueError(
                f"--{name.replace('_', '-')} was {was} in {path} and is {is_now} now: a resumed run keeps its options; "
                "start a new run for others"
            )


def check_replaceable(path: Path, options: Any) -> None:
    """Raises a ValueError for a folder that is not writable or not empty, or that --force must not remove."""
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        reason = "permission denied" if existing.is_dir() else f"{existing} is a file"
        raise ValueError(f"cannot write to {path}: {reason}; name another folder with -o")
    if existing != path or not any(path.iterdir()):
        return
    if not (path / CONFIG).is_file() or "output" not in load_json(path / CONFIG):
        raise ValueError(f"{path} is not empty and holds no earlier run: name another folder with -o")
    if not options.force:
        resume = "--resume continues it, " if hasattr(options, "resume") else ""
        raise ValueError(f"{path} holds an earlier run: {resume}--force replaces it, -o names another")
    values = [value for name, value in vars(options).items() if name != "output"]
    for value in itertools.chain(*(value if isinstance(value, tuple) else (value,) for value in values)):
        inside = isinstance(value, str | Path) and str(value) and Path(value).resolve().is_relative_to(path.resolve())
        if inside and Path(value).exists():
            raise ValueError(f"--force would remove {value}, an input: name another folder with -o")


def make_latest(path: Path) -> Path:
    """Makes a new folder, and points the link `latest` beside it there."""
    while path.exists():  # a second run of the same second
        path = path.with_name(f"{path.name}_2")
    path.mkdir(parents=True)
    link = path.parent / f".latest_{path.name}"
    link.symlink_to(path.name, target_is_directory=True)
    link.replace(path.parent / "latest")
    return path


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
    """Writes these columns as CSV, atomically: numbers with six digits, truth values as 0 and 1, None as empty."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = (row[column] for column in columns)
        writer.writerow([f"{cell:.6g}" if isinstance(cell, float) else cell for cell in cells])
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
