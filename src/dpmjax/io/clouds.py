"""Point cloud files: PCD 0.7 and PLY, ascii or binary."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.files import read_bytes, refusing, split_rows, to_float32, unpack_rows, write_atomically
from dpmjax.sequences import InputError, require

_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Columns in which lidar drivers and data sets write when a point was measured.
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "time_offset", "offset_time")


class _Header(NamedTuple):
    """Names of the fields, their layout as one NumPy type, number of points, encoding, and the header's length."""

    fields: list[str]
    layout: np.dtype[np.void]
    num_points: int
    encoding: str
    size: int


class TimedCloud(NamedTuple):
    """The points of a file, and when each was measured.

    Attributes:
        points: (m, 3) float32 x, y, z in the file's unit.
        times: (m,) in the unit and from the start that the file has; None where it has no column of a known name.
    """

    points: NDArray[np.float32]
    times: NDArray[np.float64] | None


def read_pcd(path: str | Path, *, drop_nan: bool = False) -> NDArray[np.float32]:
    """Reads the points of a PCD file.

    Args:
        path: the file.
        drop_nan: leaves out points of NaN, by which organised clouds mark beams that met nothing.

    Returns:
        (m, 3) float32 x, y, z in the file's unit; z is zero where the file has none.

    Raises:
        InputError: the file is missing, or `parse_pcd` refuses it.
    """
    return parse_pcd(read_bytes(path), str(path), drop_nan=drop_nan).points


def parse_pcd(content: bytes, source: str, *, drop_nan: bool = False) -> TimedCloud:
    """Reads the points out of the bytes of a PCD file (DATA ascii or binary, fields in any order).

    Args:
        content: the whole file.
        source: its name, for messages.
        drop_nan: leaves out points whose coordinates are all NaN.

    Returns:
        The points, with their times where the file has them; z is zero where it has none.

    Raises:
        InputError: a broken header, no x or y column, a truncated body, NaN or infinite coordinates, or the compressed
            encoding, which is not supported.
    """
    header = _parse_pcd_header(content, source)
    for name in ("x", "y"):
        found = f"fields are {' '.join(header.fields)}"
        require(name in header.fields, source, found, f"the file needs a column {name}")
    found = f"DATA {header.encoding} is not supported"
    require(header.encoding in ("ascii", "binary"), source, found, "save the cloud as ascii or binary PCD")
    columns = _read_columns(content, header, source)
    zeros = np.zeros(header.num_points, np.float32)
    points, times = np.stack([to_float32(columns.get(name, zeros)) for name in "xyz"], axis=1), _times(columns)
    if drop_nan:
        is_there = ~np.isnan(points).all(axis=1)
        points, times = points[is_there], None if times is None else times[is_there]
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        found = f"{bad.sum()} of {len(points)} points are NaN or infinite, the first at row {int(np.argmax(bad))}"
        raise InputError(source, found, "write invalid beams as 0 0 0")
    return TimedCloud(points, times)


def write_pcd(path: str | Path, points: ArrayLike) -> Path:
    """Writes points in the layout of the DeepMapping authors: fields x y z, float32, binary, one row of points.

    Args:
        path: file to write, atomically.
        points: (m, 2) or (m, 3); z is zero where there is none.

    Returns:
        The path.

    Raises:
        ValueError: another shape.
    """
    values = np.asarray(points, "<f4")
    if values.ndim != 2 or values.shape[1] not in (2, 3):
        raise ValueError(f"points must be (m, 2) or (m, 3), got {values.shape}")
    cloud = np.zeros((len(values), 3), "<f4")
    cloud[:, : values.shape[1]] = values
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    return write_atomically(path, header.encode("ascii") + cloud.tobytes())


def _parse_pcd_header(content: bytes, source: str) -> _Header:
    entries: dict[str, list[str]] = {}
    size = 0
    while "DATA" not in entries:
        end = content.find(b"\n", size)
        is_header = end >= 0 and size <= 4096
        require(is_header, source, "no PCD header", "give PCD files (VERSION, FIELDS, SIZE, TYPE, ..., DATA)")
        words = content[size:end].decode("latin-1").split()
        size = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    found = "broken PCD header ({kind}: {error})"
    advice = "write FIELDS, SIZE, TYPE, COUNT of one length, POINTS and DATA"
    with refusing(source, found, advice, (KeyError, ValueError, IndexError, TypeError, OverflowError)):
        fields = entries["FIELDS"]
        types = ["<" + _PCD_TYPES[t] + s for t, s in zip(entries["TYPE"], entries["SIZE"], strict=True)]
        counts = [int(count) for count in entries.get("COUNT", ["1"] * len(fields))]
        sizes = entries.get("POINTS") or [entries["WIDTH"][0], entries["HEIGHT"][0]]
        num_points = int(sizes[0]) * int(sizes[1] if len(sizes) > 1 else 1)
        if not len(fields) == len(types) == len(counts) or min(counts) < 1 or num_points < 0:
            raise ValueError("lengths differ, or a number is below one")
        layout = np.dtype([(f"{i}", t, (c,)) for i, (t, c) in enumerate(zip(types, counts, strict=True))])
        return _Header(fields, layout, num_points, entries["DATA"][0].lower(), size)


def _read_columns(content: bytes, header: _Header, source: str) -> dict[str, NDArray[np.generic]]:
    """The first number of each field, of all points."""
    body = content[header.size :]
    if header.encoding == "ascii":
        widths = [math.prod(header.layout[index].shape) for index in range(len(header.fields))]
        table = split_rows(body, sum(widths), header.num_points, source)
        return dict(zip(header.fields, table[:, np.cumsum([0, *widths[:-1]])].T, strict=True))
    records = unpack_rows(body, header.layout, header.num_points, source)
    columns = [np.atleast_2d(records[name].T)[0] for name in header.layout.names or ()]
    return dict(zip(header.fields, columns, strict=True))


def _times(columns: dict[str, NDArray[np.generic]]) -> NDArray[np.float64] | None:
    """The column of times, if there is one."""
    name = next((name for name in columns if name.lower() in _TIME_FIELDS), None)
    return None if name is None else np.asarray(columns[name], np.float64)


def read_ply(path: str | Path) -> NDArray[np.float32]:
    """Reads the points of a PLY file.

    Args:
        path: the file; the vertex element must come first, other elements and properties are ignored.

    Returns:
        (n, 3) float32 x, y, z in the file's unit; NaN is left as it is.

    Raises:
        InputError: the file is missing, has a broken header or no x, y, z, or is truncated.
    """
    return parse_ply(read_bytes(path), str(path)).points


def parse_ply(content: bytes, source: str) -> TimedCloud:
    """Reads the points out of the bytes of a PLY file.

    Args:
        content: the whole file.
        source: its name, for messages.

    Returns:
        The points, with their times where the file has them; NaN is left as it is.

    Raises:
        InputError: see `read_ply`.
    """
    columns = _read_columns(content, _parse_ply_header(content, source), source)
    return TimedCloud(np.stack([to_float32(columns[axis]) for axis in "xyz"], axis=1), _times(columns))


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


def _parse_ply_header(content: bytes, source: str) -> _Header:
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header")
    require(content.startswith(b"ply") and 0 <= end <= 65536, source, "no PLY header", advice)
    size = content.find(b"\n", end) + 1 or len(content)
    rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
    encoding = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    elements = [row for row in rows if row[0] == "element"]
    is_good = encoding in _PLY_ORDERS and elements[:1] and elements[0][1:2] == ["vertex"]
    require(bool(is_good), source, f"PLY format {encoding or 'unknown'}, or no vertex element in front", advice)
    first = rows.index(elements[0]) + 1
    stop = rows.index(elements[1]) if len(elements) > 1 else len(rows)
    kinds = (KeyError, ValueError, IndexError, TypeError)
    with refusing(source, "broken PLY header ({kind}: {error})", advice, kinds):
        num_vertices = int(elements[0][2])
        order, entries = _PLY_ORDERS[encoding], [row for row in rows[first:stop] if row[0] == "property"]
        properties = [(name, order + _PLY_TYPES[kind]) for _, kind, name in entries]
        layout = np.dtype(properties)
    names = [name for name, _ in properties]
    require(num_vertices >= 0 and {"x", "y", "z"} <= set(names), source, f"PLY properties {' '.join(names)}", advice)
    return _Header(names, layout, num_vertices, encoding, size)
