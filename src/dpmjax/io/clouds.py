"""Point clouds in files: PLY, and PCD 0.7 of the Point Cloud Library (ascii, binary or compressed by LZF)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.files import refusing, to_float32, to_numbers, write_atomically
from dpmjax.sequences import FloatArray, require

# Names of columns of point times of lidar drivers and data sets.
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "time_offset", "offset_time", "gps_time")
_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
              "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
              "uint32": "u4", "float32": "f4", "float64": "f8"}  # fmt: skip
_PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
_PCD_ENCODINGS = ("ascii", "binary", "binary_compressed")
_DAMAGED = (KeyError, ValueError, IndexError, TypeError, ArithmeticError, StopIteration)


class TimedCloud(NamedTuple):
    """Points of a file and their times.

    Attributes:
        points: (m, 3) float32 x, y, z in the file's unit; NaN where the file has it.
        times: (m,) in the unit and from the origin of the file; None without a column of a known name.
    """

    points: NDArray[np.float32]
    times: FloatArray | None


class _Header(NamedTuple):
    """A header: names of fields, the record of a point, number of points, encoding, and length in bytes.

    The fields of the record are arrays called "0", "1" and so on, because a file may repeat a name.
    """

    names: list[str]
    record: np.dtype[np.void]
    num_points: int
    encoding: str
    size: int


def cloud_of(columns: Mapping[str, NDArray[Any]]) -> TimedCloud:
    """Makes a cloud of columns x, y, z, with the times of the first column of a known name."""
    time = next((name for name in columns if name.lower() in _TIME_FIELDS), None)
    points = np.stack([to_float32(columns[axis]) for axis in "xyz"], axis=1)
    return TimedCloud(points, None if time is None else np.asarray(columns[time], np.float64))


def parse_ply(content: bytes, source: str) -> TimedCloud:
    """Reads the points out of the bytes of a PLY file, ascii or binary: those of the vertex element.

    Args:
        content: the whole file.
        source: its name, for messages.

    Returns:
        The points, with their times where the file has them; NaN stays.

    Raises:
        InputError: a broken header, no x, y, z, or a truncated body.
    """
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header", 0, 65536)
    require(content.startswith(b"ply") and end >= 0, source, "no PLY header", advice)
    with refusing(source, "broken PLY header ({kind}: {error})", advice, _DAMAGED):
        rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
        encoding = next(row[1] for row in rows if row[0] == "format")
        first, stop = [*(i for i, row in enumerate(rows) if row[0] == "element"), len(rows)][:2]
        entries = [row for row in rows[first:stop] if row[0] == "property"]
        fields = [(f"{i}", _PLY_ORDERS[encoding] + _PLY_TYPES[kind], (1,)) for i, (_, kind, _) in enumerate(entries)]
        count, names = int(rows[first][2]), [row[2] for row in entries]
        header = _Header(names, np.dtype(fields), count, encoding, content.find(b"\n", end) + 1 or len(content))
        is_good = rows[first][1] == "vertex" and count >= 0
    require(is_good and {"x", "y", "z"} <= set(names), source, f"PLY properties {' '.join(names)}", advice)
    return cloud_of(_read_columns(content, header, source))


def parse_pcd(content: bytes, source: str) -> TimedCloud:
    """Reads the points out of the bytes of a PCD file (DATA ascii, binary, binary_compressed; fields in any order).

    Args:
        content: the whole file.
        source: its name, for messages.

    Returns:
        The points, with their times where the file has them; z is zero where it has none, and NaN stays.

    Raises:
        InputError: a broken header, no x or y column, a body that is truncated or does not unpack, or a word that is no
            number.
    """
    start = content.find(b"\nDATA", 0, 4096) + 1
    size = content.find(b"\n", start) + 1
    require(start > 0 and size > 0, source, "no PCD header", "give PCD files (VERSION, FIELDS, SIZE, TYPE, ..., DATA)")
    advice = f"write FIELDS, SIZE, TYPE, COUNT of one length, POINTS, and DATA as one of {' '.join(_PCD_ENCODINGS)}"
    with refusing(source, "broken PCD header ({kind}: {error})", advice, _DAMAGED):
        rows = (line.split() for line in content[:size].decode("latin-1").splitlines())
        entries = {row[0].upper(): row[1:] for row in rows if row}
        names, encoding = entries["FIELDS"], _PCD_ENCODINGS.index(entries["DATA"][0].lower())
        kinds = zip(names, entries["TYPE"], entries["SIZE"], entries.get("COUNT", ["1"] * len(names)), strict=True)
        fields = [(f"{i}", f"<{_PCD_TYPES[kind]}{size}", (int(n),)) for i, (_, kind, size, n) in enumerate(kinds)]
        count = math.prod(map(int, entries.get("POINTS") or [*entries["WIDTH"], *entries["HEIGHT"]]))
        header = _Header(names, np.dtype(fields), count, _PCD_ENCODINGS[encoding], size)
    require(count >= 0, source, f"broken PCD header ({count} points)", advice)
    columns = _read_columns(content, header, source)
    found = f"fields are {' '.join(names)}"
    require({"x", "y"} <= set(columns), source, found, "the file needs a column x and a column y")
    return cloud_of({"z": np.zeros(count), **columns})


def _read_columns(content: bytes, header: _Header, source: str) -> dict[str, NDArray[Any]]:
    """Reads the first number of each field by its name, without the padding."""
    # The Point Cloud Library counts some padding as 0; the places of the fields behind it are unknown.
    fields = [header.record[i] for i in range(len(header.names))]
    known = next((i for i, field in enumerate(fields) if field.itemsize == 0), len(fields))
    # The Point Cloud Library calls padding "_".
    kept = [i for i in range(known) if header.names[i] != "_"]
    if header.encoding == "ascii":
        return _read_text(content, header, kept, source)
    body, sizes = content[header.size :], [header.num_points * field.itemsize for field in fields]
    columns: dict[str, NDArray[Any]] = {}
    found = f"truncated or damaged, {header.num_points} points in {header.encoding} ({{error}})"
    with refusing(source, found, "copy the file again", _DAMAGED):
        if header.encoding != "binary_compressed":
            records = np.frombuffer(body, header.record, header.num_points)
            return {header.names[i]: records[f"{i}"][:, 0] for i in kept}
        packed, size = np.frombuffer(body, "<u4", 2).tolist()
        order = next(order for order in (range(len(sizes)), kept) if sum(sizes[i] for i in order) == size)
        values, start = unpack_lzf(body[8 : 8 + packed], size), 0
        for i in order:
            column = np.frombuffer(values, fields[i].base, sizes[i] // fields[i].base.itemsize, start)
            columns[header.names[i]] = column.reshape(header.num_points, -1)[:, 0]
            start += sizes[i]
    return columns


def _read_text(content: bytes, header: _Header, kept: list[int], source: str) -> dict[str, NDArray[Any]]:
    """Reads rows of numbers; rows may have numbers for the padding, or leave it out."""
    lines = [line.decode("latin-1") for line in content[header.size :].splitlines() if line.strip()]
    widths = [header.record[i].shape[0] for i in range(len(header.names))]
    table = to_numbers(lines[: header.num_points], source) if header.num_points else np.zeros((0, sum(widths)))
    if table.shape[1] == sum(widths[i] for i in kept):
        widths = [width * (i in kept) for i, width in enumerate(widths)]
    found = f"truncated: {table.shape} numbers, the header promises {header.num_points, sum(widths)}"
    require(table.shape == (header.num_points, sum(widths)), source, found, "copy the file again")
    starts = np.cumsum([0, *widths])
    return {header.names[i]: table[:, starts[i]] for i in kept}


def unpack_lzf(packed: bytes, size: int) -> bytes:
    """Unpacks a block of LZF.

    A control byte below 32 begins a run of that many literal bytes and one more. Any other begins a copy. Its upper
    three bits are the length less two; 7 adds the next byte. Its lower five bits and the next byte are the distance
    less one.

    Args:
        packed: the block.
        size: number of bytes that it holds.

    Returns:
        The bytes.

    Raises:
        ValueError: the block is damaged, or holds another number of bytes.
        IndexError: the block ends within a copy.
    """
    # Three bytes of LZF unpack to up to 264.
    if size > 88 * len(packed):
        raise ValueError(f"{len(packed)} bytes cannot unpack to {size}")
    out, at = bytearray(), 0
    while at < len(packed):
        control, at = packed[at], at + 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = (control >> 5) + 2
        if length == 9:
            length, at = length + packed[at], at + 1
        start, at = len(out) - ((control & 31) << 8) - packed[at] - 1, at + 1
        if start < 0:
            raise ValueError(f"a copy of bytes before the first one, at byte {at}")
        piece = out[start : start + length]
        out += (piece * -(-length // len(piece)))[:length]
    if at != len(packed) or len(out) != size:
        raise ValueError(f"unpacks to {len(out)} bytes, not to {size}")
    return bytes(out)


def write_ply(path: str | Path, points: ArrayLike, *, colors: ArrayLike | None = None) -> Path:
    """Writes points as binary little-endian PLY with float x, y, z, and colours where they are given.

    Args:
        path: file to write, atomically.
        points: (n, 3).
        colors: (n, 3) red, green, blue from 0 to 255; None for points without colour.

    Returns:
        The path.

    Raises:
        ValueError: another shape.
    """
    columns, axes = {"points": np.asarray(points, "<f4")}, [f"property float {axis}" for axis in "xyz"]
    if colors is not None:
        columns["colors"] = np.asarray(colors, np.uint8)
        axes += [f"property uchar {color}" for color in ("red", "green", "blue")]
    records = np.empty(len(columns["points"]), [(name, values.dtype, 3) for name, values in columns.items()])
    for name, values in columns.items():
        if values.shape != (len(records), 3):
            raise ValueError(f"{name} must be ({len(records)}, 3), got {values.shape}")
        records[name] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(records)}", *axes, "end_header", ""]
    return write_atomically(path, "\n".join(header).encode() + records.tobytes())
