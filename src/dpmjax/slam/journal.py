"""The journal of a run: one record a keyframe is appended to a file, so that a killed run goes on where it was.

A record holds what has changed since the one before. A record that was cut off is dropped, with what comes after it.
The local map is kept as numbers and poses of its scans: these are measured again, with the same result.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dpmjax.slam.columns import Arrays, from_columns, part_of, prefixed, to_columns
from dpmjax.slam.front_end import AnyScan, FrontEndState, corrected_points
from dpmjax.slam.keyframes import Keyframe, KeyframeMap, MapEdge
from dpmjax.slam.loop_state import LoopState
from dpmjax.slam.methods import SlamMethods
from dpmjax.slam.reports import Loop, ScanReport
from dpmjax.slam.system import SlamState, init_slam

MAGIC = b"dpmjax SLAM journal 2\n"
_HEAD = struct.Struct("<QI")

ReadScan = Callable[[int], AnyScan]


class JournalContent(NamedTuple):
    """What a journal holds.

    Attributes:
        state: after the last whole record.
        reports: of all scans until then.
        num_bytes: length of the whole records.
    """

    state: SlamState
    reports: tuple[ScanReport, ...]
    num_bytes: int


class Journal:
    """A journal that is open for writing.

    Args:
        path: the file.
        content: what it holds already, which is kept; None begins a new one.
        start: state before the first scan; None is an empty map.
    """

    def __init__(self, path: Path, content: JournalContent | None = None, start: SlamState | None = None) -> None:
        self._last = content.state if content else start or init_slam()
        self._file = path.open("r+b" if content else "wb", buffering=0)
        if content:
            self._file.truncate(content.num_bytes)
            self._file.seek(0, os.SEEK_END)
        else:
            self._file.write(MAGIC)

    def append(self, methods: SlamMethods, state: SlamState, reports: Sequence[ScanReport]) -> None:
        """Writes what has changed since the last record.

        Args:
            methods: turn their own records into arrays.
            state: after a scan.
            reports: of the scans since the last record.
        """
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **_changes(methods, self._last, state, reports))
        payload = buffer.getvalue()
        self._file.write(_HEAD.pack(len(payload), zlib.crc32(payload)) + payload)
        self._last = state

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def read_journal(
    path: Path, methods: SlamMethods, read_scan: ReadScan, start: SlamState | None = None
) -> JournalContent:
    """Reads a journal, and measures the scans of the local map again.

    Args:
        path: the file.
        methods: of the run that wrote it.
        read_scan: gives the points of a scan by its number.
        start: state before the first scan; None is an empty map.

    Returns:
        The state after the last whole record.

    Raises:
        ValueError: the file is missing or no journal, or its run had other weights.
    """
    content = path.read_bytes() if path.is_file() else b""
    if not content.startswith(MAGIC):
        raise ValueError(f"{path}: no journal of this version; start the run again without --resume")
    state, reports, num_bytes, record = start or init_slam(), [], len(MAGIC), None
    for record, end in _records(content):
        made_by, given = str(record["fingerprint"]), methods.matcher.fingerprint
        if made_by != given:
            raise ValueError(f"{path}: made with weights {made_by}, these are {given}; give those, or start again")
        state = _apply(methods, state, record)
        reports += from_columns(ScanReport, record, "report")
        num_bytes = end
    if record is not None and "local_map" in record:
        T_turn = {report.scan: report.T_turn for report in reports}

        def measure_again(number: int) -> Any:
            return methods.geometry.measure(corrected_points(read_scan(number), T_turn[number]))

        local_map = methods.geometry.unpack(part_of(record, "local_map"), measure_again)
        state = state._replace(front_end=state.front_end._replace(local_map=local_map))
    return JournalContent(state, tuple(reports), num_bytes)


def _records(content: bytes) -> Iterator[tuple[Arrays, int]]:
    """Yields whole records and where they end."""
    begin = len(MAGIC)
    while begin + _HEAD.size <= len(content):
        length, checksum = _HEAD.unpack_from(content, begin)
        payload = content[begin + _HEAD.size : begin + _HEAD.size + length]
        if len(payload) < length or zlib.crc32(payload) != checksum:
            return
        begin += _HEAD.size + length
        with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
            yield {name: archive[name] for name in archive.files}, begin


def _changes(methods: SlamMethods, before: SlamState, after: SlamState, reports: Sequence[ScanReport]) -> Arrays:
    old, new, front = before.slam_map, after.slam_map, after.front_end
    added = new.keyframes[len(old) :]
    arrays = {"fingerprint": np.array(methods.matcher.fingerprint), **to_columns(reports, "report")}
    arrays |= to_columns(added, "keyframe", without=("description",))
    for number, keyframe in enumerate(added):
        arrays |= prefixed(methods.matcher.pack(keyframe.description), f"description.{number}")
    is_grown = np.array_equal(new.T_world_keyframe[: len(old)], old.T_world_keyframe)
    arrays["num_poses_kept"] = np.array(len(old) if is_grown else 0)
    arrays["T_world_keyframe"] = new.T_world_keyframe[int(arrays["num_poses_kept"]) :]
    arrays["vectors"] = new.vectors[len(old) :]
    arrays |= _list_changes(old.edges, new.edges, "edge")
    arrays |= _list_changes(before.loops.loops, after.loops.loops, "loop")
    arrays |= to_columns([after.loops], "loops", without=("loops",))
    arrays |= to_columns([front], "front_end", without=("local_map", "scores"))
    arrays["scores"] = np.array(front.scores)
    if front.local_map is not None:
        arrays["local_map"] = np.array(1)
        arrays |= prefixed(methods.geometry.pack(front.local_map), "local_map")
    return arrays


def _apply(methods: SlamMethods, state: SlamState, record: Arrays) -> SlamState:
    old = state.slam_map
    keyframes = []
    for number, keyframe in enumerate(from_columns(Keyframe, record, "keyframe")):
        description = methods.matcher.unpack(part_of(record, f"description.{number}"))
        keyframes.append(keyframe._replace(description=description))
    kept = old.T_world_keyframe[: int(record["num_poses_kept"])]
    vectors = record["vectors"]
    slam_map = KeyframeMap(
        (*old.keyframes, *keyframes),
        np.concatenate([kept, record["T_world_keyframe"]]),
        np.concatenate([old.vectors, vectors]) if len(old) else vectors,
        _apply_list(old.edges, record, "edge", MapEdge),
        methods.origin if keyframes else old.origin,
    )
    (loops,) = from_columns(LoopState, record, "loops")
    (front,) = from_columns(FrontEndState, record, "front_end")
    return SlamState(
        front._replace(scores=tuple(record["scores"].tolist())),
        slam_map,
        loops._replace(loops=_apply_list(state.loops.loops, record, "loop", Loop)),
    )


def _list_changes(old: Sequence[Any], new: Sequence[Any], name: str) -> Arrays:
    """What makes one list of records of another: how many of the first stay, and the rows or records after them."""
    num_same = next(
        (row for row, (a, b) in enumerate(zip(old, new, strict=False)) if a is not b), min(len(old), len(new))
    )
    rows = {id(record): row for row, record in enumerate(old[num_same:], num_same)}
    order = np.array([rows.get(id(record), -1) for record in new[num_same:]], np.int64)
    fresh = [record for record, row in zip(new[num_same:], order, strict=True) if row < 0]
    return {f"{name}.num_same": np.array(num_same), f"{name}.order": order, **to_columns(fresh, f"{name}.fresh")}


def _apply_list(old: Sequence[Any], record: Arrays, name: str, record_type: type[Any]) -> tuple[Any, ...]:
    fresh = iter(from_columns(record_type, record, f"{name}.fresh"))
    rest = [old[row] if row >= 0 else next(fresh) for row in record[f"{name}.order"].tolist()]
    return (*old[: int(record[f"{name}.num_same"])], *rest)
