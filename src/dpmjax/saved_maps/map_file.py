"""Saved maps, and states of runs: one `.npz` file of plain arrays, checked on load.

Ragged arrays are concatenated, with the number of rows of each keyframe. `header` is JSON in UTF-8: format, version,
precision, fingerprint of the weights, and the settings of SLAM. The state of a run is the map, and the states of
odometry and loop closure. It is written after a keyframe, and a killed run continues from the file.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from dpmjax.checks import require_one_of
from dpmjax.io.files import load_arrays, refusing, write_atomically
from dpmjax.saved_maps.map_arrays import Arrays, Precision, pack_map, unpack_map
from dpmjax.sequences import InputError, require
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.keyframe_map import KeyframeMap, MapOrigin, thin_map
from dpmjax.slam.local_map import PlacedElements
from dpmjax.slam.loops import Loop, LoopState
from dpmjax.slam.system import SlamState
from dpmjax.slam.track import FrontEndState, ScanReport
from dpmjax.weights.config_json import config_from_json

FORMAT, VERSION = "dpmjax map", 3

ADVICE, RESUME_ADVICE = "save it again with dpmjax.save_map", "start the run again without --resume"

# Prefix of the arrays of the map in the file of a state.
MAP = "map."
NOT_IN_LOOPS = ("loops",)
# Fields that are stored separately, or computed from the map.
NOT_IN_FRONT_END = ("local_map", "recent", "lost", "scores", "dropped")


def save_map(path: str | Path, slam_map: KeyframeMap, precision: Precision = "float32") -> Path:
    """Writes a map to a file that `load_map` reads; an interruption never leaves half a file.

    Args:
        path: must end in `.npz`; an existing file is replaced.
        slam_map: map of a run, `result.map`, with at least one keyframe.
        precision: with "float32" the loaded map equals the saved one. With "int8" the file is smallest, for
            localisation: it rounds features and elements to codes, keeps 256 elements a keyframe, and omits keyframes
            that those of other laps cover (`slam.thin_map`).

    Returns:
        The path.

    Raises:
        ValueError: if the path has another ending, the precision is unknown, or the map is empty.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"path: expected a file that ends in .npz, got {str(path)!r}")
    return write_atomically(path, map_bytes(slam_map, precision))


def map_bytes(slam_map: KeyframeMap, precision: Precision = "float32") -> bytes:
    """Makes the content of the file of a map; its length is the cost of the map.

    Args:
        slam_map: see `save_map`.
        precision: see `save_map`.

    Returns:
        The bytes.

    Raises:
        ValueError: if the precision is unknown or the map is empty.
    """
    require_one_of("precision", precision, get_args(Precision))
    if precision == "int8":
        # Smaller than the spacing of consecutive keyframes, so that only keyframes of other laps are left out.
        slam_map = thin_map(slam_map, spacing_share=0.2)
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in map_arrays(slam_map, precision).items():
            # LZMA makes codes a sixth smaller, but is slow; a mask of equal values would look like a ZIP bomb.
            is_code = precision == "int8" and array.dtype != bool
            stored = io.BytesIO()
            np.save(stored, array, allow_pickle=False)
            # A `ZipInfo` has no time of writing: equal maps are equal files.
            member = zipfile.ZipInfo(f"{name}.npy")
            archive.writestr(member, stored.getvalue(), zipfile.ZIP_LZMA if is_code else zipfile.ZIP_DEFLATED)
    return content.getvalue()


def map_arrays(slam_map: KeyframeMap, precision: Precision) -> Arrays:
    """Makes the arrays of the file of a map.

    Args:
        slam_map: map with at least one keyframe.
        precision: see `save_map`.

    Returns:
        The arrays by name, the header among them.

    Raises:
        ValueError: if the map is empty.
    """
    origin = slam_map.origin
    if origin is None:
        raise ValueError("slam_map: expected keyframes, got an empty map")
    header = {
        "format": FORMAT,
        "version": VERSION,
        "precision": precision,
        "fingerprint": origin.fingerprint,
        "weights": origin.weights,
        "config": dataclasses.asdict(origin.config),
    }
    named: Arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    return named | pack_map(slam_map, precision)


def load_map(path: str | Path) -> KeyframeMap:
    """Reads a map that `save_map` wrote.

    Args:
        path: the file.

    Returns:
        The map.

    Raises:
        InputError: no such file, no map, one of a newer version, or a damaged one.
    """
    try:
        arrays = load_arrays(path)
    except InputError as error:
        advice = "give a file of dpmjax.save_map" if Path(path).exists() else error.advice
        raise InputError(path, error.found, advice) from error
    return map_of_arrays(path, arrays)


def map_of_arrays(path: str | Path, arrays: Arrays) -> KeyframeMap:
    """Makes a map of the arrays of a file.

    Args:
        path: path of the file, for messages.
        arrays: arrays from `map_arrays`; others may be among them.

    Returns:
        The map.

    Raises:
        InputError: no map, one of another version, or a damaged one.
    """
    require("header" in arrays, path, "a NumPy file, but not one of a dpmjax map", "give a file of dpmjax.save_map")
    with refusing(path, "its header cannot be read ({error})", ADVICE, (Exception,)):
        header = json.loads(arrays["header"].tobytes())
        found, version, precision = header["format"], header["version"], header["precision"]
        fingerprint, weights = str(header["fingerprint"]), str(header["weights"])
    require(found == FORMAT, path, "not a dpmjax map", "give a file of dpmjax.save_map")
    advice = "update dpmjax" if version > VERSION else "map the drive again"
    require(version == VERSION, path, f"format version {version}, this dpmjax reads {VERSION}", advice)
    require(precision in get_args(Precision), path, f"precision {precision}", ADVICE)
    with refusing(path, "{error}", ADVICE, (ValueError, TypeError)):
        origin = MapOrigin(fingerprint, config_from_json(header["config"], SlamConfig, file=path), weights)
    for name, array in arrays.items():
        is_good = array.dtype.kind in "iub" or (array.dtype.kind == "f" and bool(np.isfinite(array).all()))
        require(is_good, path, f"{name} holds values that are not finite numbers", ADVICE)
    with refusing(path, "damaged: {error}", ADVICE, (Exception,)):
        return unpack_map(arrays, precision, origin)


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
    front_end, slam_map, loops, _ = state
    if front_end.local_map is not None or front_end.dropped:
        raise ValueError("state: expected the state after a keyframe, got scans since the last one")
    arrays = {f"{MAP}{name}": array for name, array in map_arrays(slam_map, "float32").items()}
    arrays |= to_columns(reports, "report") | to_columns(loops.loops, "loop")
    arrays |= to_columns([loops], "loops", without=NOT_IN_LOOPS)
    arrays |= to_columns(front_end.recent, "recent") | to_columns([front_end], "front_end", without=NOT_IN_FRONT_END)
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
        require("front_end" in arrays, path, "no state of a run", RESUME_ADVICE)
        of_map = {name.removeprefix(MAP): array for name, array in arrays.items() if name.startswith(MAP)}
        slam_map = map_of_arrays(path, of_map)
    except InputError as error:
        raise InputError(path, error.found, RESUME_ADVICE) from error
    with refusing(path, "damaged: {error}", RESUME_ADVICE, (Exception,)):
        (loops,) = from_columns(LoopState, arrays, "loops", without=NOT_IN_LOOPS)
        (front_end,) = from_columns(FrontEndState, arrays, "front_end", without=NOT_IN_FRONT_END)
        recent = tuple(from_columns(PlacedElements, arrays, "recent"))
        front_end = front_end._replace(scores=tuple(arrays["scores"].tolist()), recent=recent, lost=(), dropped=())
        loops = loops._replace(loops=tuple(from_columns(Loop, arrays, "loop")))
        return RunState(SlamState(front_end, slam_map, loops), tuple(from_columns(ScanReport, arrays, "report")))


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
        remaining = iter(found)
        fields.append([next(remaining) if there else None for there in is_there])
    return [record_type(*values) for values in zip(*fields, strict=True)] if num else []
