"""PLY files, ascii or binary: the points of the vertex element."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.clouds import CloudLayout, TimedCloud, times_of, unpack_columns
from dpmjax.io.files import refusing, split_rows, to_float32, write_atomically
from dpmjax.sequences import require

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def parse_ply(content: bytes, source: str) -> TimedCloud:
    """Reads the points out of the bytes of a PLY file.

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
    if header.encoding == "ascii":
        width, lines = len(header.fields), header.num_lines
        table = split_rows(body, width, header.num_points, source, num_lines_before=lines)
        columns: dict[str, NDArray[np.generic]] = dict(zip(header.fields, table.T, strict=True))
    else:
        columns = unpack_columns(body, header, source)
    return TimedCloud(np.stack([to_float32(columns[axis]) for axis in "xyz"], axis=1), times_of(columns))


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


def _parse_header(content: bytes, source: str) -> CloudLayout:
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header")
    require(content.startswith(b"ply") and 0 <= end <= 65536, source, "no PLY header", advice)
    size = content.find(b"\n", end) + 1 or len(content)
    rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
    encoding = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    elements = [row for row in rows if row[0] == "element"]
    is_good = encoding in _ORDERS and elements[:1] and elements[0][1:2] == ["vertex"]
    require(bool(is_good), source, f"PLY format {encoding or 'unknown'}, or no vertex element in front", advice)
    first = rows.index(elements[0]) + 1
    stop = rows.index(elements[1]) if len(elements) > 1 else len(rows)
    kinds = (KeyError, ValueError, IndexError, TypeError)
    with refusing(source, "broken PLY header ({kind}: {error})", advice, kinds):
        num_vertices = int(elements[0][2])
        order, entries = _ORDERS[encoding], [row for row in rows[first:stop] if row[0] == "property"]
        properties = [(name, order + _TYPES[kind]) for _, kind, name in entries]
        layout = np.dtype([(f"{i}", kind) for i, (_, kind) in enumerate(properties)])
    names = [name for name, _ in properties]
    require(num_vertices >= 0 and {"x", "y", "z"} <= set(names), source, f"PLY properties {' '.join(names)}", advice)
    return CloudLayout(names, layout, num_vertices, encoding, size, content[:size].count(b"\n"))
