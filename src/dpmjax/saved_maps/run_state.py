"""The state of a SLAM run in one file: the map, and the states of odometry and loop closure.

It is written after a keyframe. A killed run continues from the file and repeats the scans since that keyframe.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dpmjax.io.files import load_arrays, refusing, write_atomically
from dpmjax.saved_maps.map_file import map_arrays, map_of_arrays
from dpmjax.sequences import InputError, require
from dpmjax.slam.front_end import FrontEndState, ScanReport
from dpmjax.slam.local_map import PlacedElements
from dpmjax.slam.loops import Loop, LoopState
from dpmjax.slam.system import SlamState

Arrays = dict[str, np.ndarray]


def to_columns(records: Sequence[Any], name: str, *, without: Collection[str] = ()) -> Arrays:
    """Turns records of one type into one array a field.

    Args:
        records: named tuples of numbers, texts, arrays of one shape or of many rows, or None.
        name: prefix of the names of the arrays.
        without: fields that are left out.

    Returns:
        The arrays. A mask marks each None, which takes no space.
    """
    columns = {name: np.array(len(records))}
    for field in [field for field in records[0]._fields if field not in without] if records else ():
        values = [getattr(record, field) for record in records]
        found = [value for value in values if value is not None]
        if len({np.shape(value) for value in found}) > 1:
            columns[f"{name}.{field}"] = np.concatenate(found)
            columns[f"{name}.{field}.lengths"] = np.array([len(value) for value in found])
        elif found:
            columns[f"{name}.{field}"] = np.array(found)
        if len(found) < len(values):
            columns[f"{name}.{field}.is_there"] = np.array([value is not None for value in values])
    return columns


def from_columns(
    record_type: Any, columns: Mapping[str, np.ndarray], name: str, *, without: Collection[str] = ()
) -> list[Any]:
    """Turns columns back into records.

    Args:
        record_type: the named tuple.
        columns: columns from `to_columns`; others may be among them.
        name: name given there.
        without: fields that were left out there.

    Returns:
        The records: numbers and texts of Python, arrays of NumPy; None for a field that was left out.

    Raises:
        ValueError: if a field is missing.
    """
    num, fields = int(columns[name]), []
    for field in record_type._fields:
        key = f"{name}.{field}"
        is_there = columns.get(f"{key}.is_there", np.full(num, key in columns))
        if num and field not in without and not (key in columns or f"{key}.is_there" in columns):
            raise ValueError(f"{key} is missing")
        column = columns.get(key, np.zeros(0))
        found: Any = column.tolist() if column.ndim == 1 else column
        if f"{key}.lengths" in columns:
            found = np.split(column, np.cumsum(columns[f"{key}.lengths"])[:-1])
        rest = iter(found)
        fields.append([next(rest) if there else None for there in is_there])
    return [record_type(*values) for values in zip(*fields, strict=True)] if num else []


def part_of(columns: Mapping[str, np.ndarray], name: str) -> Arrays:
    """Returns the arrays whose names begin with `name` and a dot, and removes this prefix."""
    return {key.removeprefix(f"{name}."): value for key, value in columns.items() if key.startswith(f"{name}.")}


def prefixed(columns: Mapping[str, np.ndarray], name: str) -> Arrays:
    """Returns the same arrays with `name` and a dot before their names."""
    return {f"{name}.{key}": value for key, value in columns.items()}


ADVICE = "start the run again without --resume"
OF_LOOPS = ("loops",)
# Fields that are stored separately, or computed from the map.
OF_FRONT_END = ("local_map", "recent", "lost", "scores")


class RunState(NamedTuple):
    """A run after a keyframe.

    Attributes:
        state: state after the keyframe.
        reports: reports of all scans of the run until then.
    """

    state: SlamState
    reports: tuple[ScanReport, ...]


def save_state(path: str | Path, state: SlamState, reports: Sequence[ScanReport]) -> Path:
    """Writes the state of a run; an interruption never leaves half a file.

    Args:
        path: an existing file is replaced.
        state: state after a keyframe.
        reports: reports of all scans of the run until then.

    Returns:
        The path.

    Raises:
        ValueError: if the map is empty, or the last scan is not the one of a keyframe.
    """
    front_end, slam_map, loops = state
    if front_end.local_map is not None:
        raise ValueError("state: expected the state after a keyframe, got scans since the last one")
    arrays = prefixed(map_arrays(slam_map, "float32"), "map") | to_columns(reports, "report")
    arrays |= to_columns(loops.loops, "loop") | to_columns([loops], "loops", without=OF_LOOPS)
    arrays |= to_columns(front_end.recent, "recent") | to_columns([front_end], "front_end", without=OF_FRONT_END)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, scores=np.array(front_end.scores), **arrays)
    return write_atomically(path, content.getvalue())


def load_state(path: str | Path) -> RunState:
    """Reads the state that `save_state` wrote.

    Args:
        path: the file.

    Returns:
        The state, bit for bit, and the reports.

    Raises:
        InputError: no such file, or one that cannot be read.
    """
    try:
        arrays = load_arrays(path)
        require("front_end" in arrays, path, "no state of a run", ADVICE)
        slam_map = map_of_arrays(path, part_of(arrays, "map"))
    except InputError as error:
        raise InputError(path, error.found, ADVICE) from error
    with refusing(path, "damaged: {error}", ADVICE, (Exception,)):
        (loops,) = from_columns(LoopState, arrays, "loops", without=OF_LOOPS)
        (front_end,) = from_columns(FrontEndState, arrays, "front_end", without=OF_FRONT_END)
        recent = tuple(from_columns(PlacedElements, arrays, "recent"))
        front_end = front_end._replace(scores=tuple(arrays["scores"].tolist()), recent=recent, lost=())
        loops = loops._replace(loops=tuple(from_columns(Loop, arrays, "loop")))
        return RunState(SlamState(front_end, slam_map, loops), tuple(from_columns(ScanReport, arrays, "report")))
