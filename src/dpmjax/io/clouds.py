"""Point clouds in files: their columns, records of binary and text bodies, and PLY."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.array_files import to_float32
from dpmjax.io.files import refusing, to_numbers, write_atomically
from dpmjax.sequences import FloatArray, require

# (n,) values of the points by the name of the field.
Columns = Mapping[str, NDArray[np.generic]]
# Name of padding fields of the Point Cloud Library.
PADDING = "_"
# Names of columns of point times of lidar drivers and data sets.
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "time_offset", "offset_time", "gps_time")
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class TimedCloud(NamedTuple):
    """Points of a file and their times.

    Attributes:
        points: (m, 3) float32 x, y, z in the file's unit; NaN where the file has it.
        times: (m,) in the unit and from the origin of the file; None without a column of a known name.
    """

    points: NDArray[np.float32]
    times: FloatArray | None


class CloudLayout(NamedTuple):
    """The header of a file of points.

    Attributes:
        fields: names of the fields; a name may occur twice.
        layout: one record; its fields are called "0", "1" and so on, and are arrays.
        num_points: number of records.
        encoding: encoding of the body, as the header names it.
        size: bytes of the header.
        num_lines: lines of the header.
    """

    fields: list[str]
    layout: np.dtype[np.void]
    num_points: int
    encoding: str
    size: int
    num_lines: int

    @property
    def widths(self) -> list[int]:
        """Number of values of each field."""
        return [math.prod(self.layout[index].shape) for index in range(len(self.fields))]

    @property
    def wanted(self) -> list[int]:
        """Indices of the fields with values."""
        return [i for i, width in enumerate(self.widths) if width > 0 and self.fields[i] != PADDING]


def cloud_of(columns: Columns) -> TimedCloud:
    """Makes a cloud of columns x, y, z, with the times of the first column of a known name."""
    time = next((name for name in columns if name.lower() in _TIME_FIELDS), None)
    points = np.stack([to_float32(columns[axis]) for axis in "xyz"], axis=1)
    return TimedCloud(points, None if time is None else np.asarray(columns[time], np.float64))


def unpack_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Reads the first number of each field out of binary records.

    Args:
        body: the records.
        header: their layout.
        source: name of the file, for messages.

    Returns:
        (num_points,) values by name; padding is left out.

    Raises:
        InputError: there are fewer records.
    """
    expected = header.num_points * header.layout.itemsize
    found = f"truncated: {header.num_points} points need {expected} bytes, {len(body)} are there"
    require(len(body) >= expected, source, found, "copy the file again")
    records = np.frombuffer(body, header.layout, count=header.num_points)
    return {header.fields[i]: records[f"{i}"].reshape(len(records), header.widths[i])[:, 0] for i in header.wanted}


def split_rows(body: bytes, header: CloudLayout, width: int, source: str) -> FloatArray:
    """Reads rows of numbers as text.

    Args:
        body: the rows; those after the last point are ignored.
        header: header of the file.
        width: numbers in a row.
        source: name of the file, for messages.

    Returns:
        (num_points, width).

    Raises:
        InputError: there are fewer rows, a row of another width, or a word that is no number; the line is named.
    """
    words = [line.decode("latin-1").split() for line in body.splitlines()]
    rows = {number: row for number, row in enumerate(words, 1 + header.num_lines) if row}
    lines = list(rows)[: header.num_points]
    found = f"truncated: the header promises {header.num_points} points, {len(lines)} are there"
    require(len(lines) >= header.num_points, source, found, "copy the file again")
    for line in lines:
        found = f"line {line} has {len(rows[line])} columns, the header promises {width}"
        require(len(rows[line]) == width, source, found, "write one number per field in each row")
    return to_numbers([rows[line] for line in lines], lines, source) if lines else np.zeros((0, width))


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
    header = _parse_header(content, source)
    body = content[header.size :]
    if header.encoding != "ascii":
        return cloud_of(unpack_columns(body, header, source))
    table = split_rows(body, header, len(header.fields), source)
    return cloud_of(dict(zip(header.fields, table.T, strict=True)))


def _parse_header(content: bytes, source: str) -> CloudLayout:
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header")
    require(content.startswith(b"ply") and 0 <= end <= 65536, source, "no PLY header", advice)
    size = content.find(b"\n", end) + 1 or len(content)
    rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
    encoding = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    elements = [index for index, row in enumerate(rows) if row[0] == "element"]
    is_good = encoding in _ORDERS and elements and rows[elements[0]][1:2] == ["vertex"]
    require(bool(is_good), source, f"PLY format {encoding or 'unknown'}, or no vertex element in front", advice)
    first, stop = [*elements, len(rows)][:2]
    kinds = (KeyError, ValueError, IndexError, TypeError)
    with refusing(source, "broken PLY header ({kind}: {error})", advice, kinds):
        num_vertices = int(rows[first][2])
        entries = [row for row in rows[first:stop] if row[0] == "property"]
        properties = [(name, _ORDERS[encoding] + _TYPES[kind]) for _, kind, name in entries]
        layout = np.dtype([(f"{i}", kind) for i, (_, kind) in enumerate(properties)])
    names = [name for name, _ in properties]
    require(num_vertices >= 0 and {"x", "y", "z"} <= set(names), source, f"PLY properties {' '.join(names)}", advice)
    return CloudLayout(names, layout, num_vertices, encoding, size, content[:size].count(b"\n"))


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
    values = np.asarray(points, "<f4")
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"points must be (n, 3), got {values.shape}")
    properties = "".join(f"property float {name}\n" for name in "xyz")
    content: NDArray[Any] = values
    if colors is not None:
        rgb = np.asarray(colors, np.uint8)
        if rgb.shape != values.shape:
            raise ValueError(f"colors must be {values.shape}, got {rgb.shape}")
        properties += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        content = np.empty(len(values), [("points", "<f4", 3), ("colors", "u1", 3)])
        content["points"], content["colors"] = values, rgb
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(values)}\n{properties}end_header\n"
    return write_atomically(path, header.encode("ascii") + content.tobytes())
