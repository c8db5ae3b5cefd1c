"""PLY files: the points of their vertex element, ascii or binary."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.files import read_bytes, split_rows, to_float32, unpack_rows, write_atomically
from dpmjax.sequences import InputError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Header(NamedTuple):
    """Encoding, number of vertices, their properties as one NumPy type, and the header's length in bytes."""

    encoding: str
    num_vertices: int
    layout: np.dtype[np.void]
    size: int


def read_ply(path: str | Path) -> NDArray[np.float32]:
    """Reads the points of a PLY file.

    Args:
        path: the file; the vertex element must come first, other elements and properties are ignored.

    Returns:
        (n, 3) float32 x, y, z in the file's unit; NaN is left as it is.

    Raises:
        InputError: the file is missing, has a broken header or no x, y, z, or is truncated.
    """
    content = read_bytes(path)
    header = _parse_header(content, str(path))
    body, names = content[header.size :], list(header.layout.names or ())
    if header.encoding == "ascii":
        columns = [names.index(axis) for axis in "xyz"]
        return to_float32(split_rows(body, len(names), header.num_vertices, path)[:, columns])
    table = unpack_rows(body, header.layout, header.num_vertices, path)
    return np.stack([to_float32(table[axis]) for axis in "xyz"], axis=1)


def write_ply(path: str | Path, points: ArrayLike) -> Path:
    """Writes points as binary little-endian PLY with float x, y, z.

    Args:
        path: file to write, atomically.
        points: (n, 3).

    Returns:
        The path.

    Raises:
        ValueError: another shape.
    """
    values = np.asarray(points, "<f4")
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"points must be (n, 3), got {values.shape}")
    properties = "".join(f"property float {name}\n" for name in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(values)}\n{properties}end_header\n"
    return write_atomically(path, header.encode("ascii") + values.tobytes())


def _parse_header(content: bytes, source: str) -> _Header:
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header")
    if not content.startswith(b"ply") or end < 0 or end > 65536:
        raise InputError(source, "no PLY header", advice)
    size = content.find(b"\n", end) + 1 or len(content)
    rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
    encoding = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    elements = [row for row in rows if row[0] == "element"]
    if encoding not in _ORDERS or not elements or elements[0][1:2] != ["vertex"]:
        raise InputError(source, f"PLY format {encoding or 'unknown'}, or no vertex element in front", advice)
    first = rows.index(elements[0]) + 1
    stop = rows.index(elements[1]) if len(elements) > 1 else len(rows)
    try:
        num_vertices = int(elements[0][2])
        properties = [
            (name, _ORDERS[encoding] + _TYPES[kind]) for word, kind, name in rows[first:stop] if word == "property"
        ]
        layout = np.dtype(properties)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(source, f"broken PLY header ({type(error).__name__}: {error})", advice) from error
    if num_vertices < 0 or not {"x", "y", "z"} <= {name for name, _ in properties}:
        raise InputError(source, f"PLY properties {' '.join(name for name, _ in properties)}", advice)
    return _Header(encoding, num_vertices, layout, size)
