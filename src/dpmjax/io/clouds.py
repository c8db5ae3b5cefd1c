"""Point clouds in files: PLY, and PCD 0.7 of the Point Cloud Library (ascii, binary or compressed by LZF)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.files import refusing, to_float32, to_numbers, write_atomically
from dpmjax.sequences import FloatArray, InputError, require

# (n,) values of the points by the name of the field.
Columns = Mapping[str, NDArray[np.generic]]
# Name of padding fields of the Point Cloud Library.
_PADDING = "_"
# Names of columns of point times of lidar drivers and data sets.
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "time_stamp", "time_offset", "offset_time", "gps_time")
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Largest ratio of unpacked to packed size: three packed bytes unpack to up to 264.
_MOST_EXPANSION = 88
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
_PCD_ENCODINGS = ("ascii", "binary", "binary_compressed")
# A field of one byte is a number or, by the Point Cloud Library, the character of this code, a line feed too.
_MOST_COLUMNS = 100
_CHARACTER, _NUMBER = rb"(?:-?\d{1,3}(?=[ \t\r\n]|\Z)|.)", rb"(\S+)"


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
        return [i for i, width in enumerate(self.widths) if width > 0 and self.fields[i] != _PADDING]


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
    header = _parse_ply_header(content, source)
    body = content[header.size :]
    if header.encoding != "ascii":
        return cloud_of(unpack_columns(body, header, source))
    table = split_rows(body, header, len(header.fields), source)
    return cloud_of(dict(zip(header.fields, table.T, strict=True)))


def _parse_ply_header(content: bytes, source: str) -> CloudLayout:
    advice = "give a PLY file with float x, y, z in its first element, vertex"
    end = content.find(b"end_header")
    require(content.startswith(b"ply") and 0 <= end <= 65536, source, "no PLY header", advice)
    size = content.find(b"\n", end) + 1 or len(content)
    rows = [line.split() for line in content[:end].decode("latin-1").splitlines() if line.strip()]
    encoding = next((row[1] for row in rows if row[0] == "format" and len(row) > 1), "")
    elements = [index for index, row in enumerate(rows) if row[0] == "element"]
    is_good = encoding in _PLY_ORDERS and elements and rows[elements[0]][1:2] == ["vertex"]
    require(bool(is_good), source, f"PLY format {encoding or 'unknown'}, or no vertex element in front", advice)
    first, stop = [*elements, len(rows)][:2]
    kinds = (KeyError, ValueError, IndexError, TypeError)
    with refusing(source, "broken PLY header ({kind}: {error})", advice, kinds):
        num_vertices = int(rows[first][2])
        entries = [row for row in rows[first:stop] if row[0] == "property"]
        properties = [(name, _PLY_ORDERS[encoding] + _PLY_TYPES[kind]) for _, kind, name in entries]
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
    out, at, end = bytearray(), 0, len(packed)
    while at < end and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        start = len(out) - ((control & 31) << 8) - packed[at] - 1
        at, length = at + 1, length + 2
        if start < 0:
            raise ValueError(f"a copy of bytes before the first one, at byte {at}")
        piece = out[start : start + length]
        out += (piece * -(-length // len(piece)))[:length]
    if at != end or len(out) != size:
        raise ValueError(f"unpacks to {len(out)} bytes, not to {size}")
    return bytes(out)


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
    header = _parse_pcd_header(content, source)
    for name in ("x", "y"):
        found = f"fields are {' '.join(header.fields)}"
        require(name in header.fields, source, found, f"the file needs a column {name}")
    found = f"DATA {header.encoding} is not supported"
    require(header.encoding in _PCD_ENCODINGS, source, found, f"save the cloud as one of {' '.join(_PCD_ENCODINGS)}")
    read = {"ascii": _ascii_columns, "binary": unpack_columns, "binary_compressed": _compressed_columns}
    columns = read[header.encoding](content[header.size :], header, source)
    return cloud_of({"z": np.zeros(header.num_points), **columns})


def _parse_pcd_header(content: bytes, source: str) -> CloudLayout:
    entries: dict[str, list[str]] = {}
    size = num_lines = 0
    while "DATA" not in entries:
        end = content.find(b"\n", size)
        is_header = end >= 0 and size <= 4096
        require(is_header, source, "no PCD header", "give PCD files (VERSION, FIELDS, SIZE, TYPE, ..., DATA)")
        words = content[size:end].decode("latin-1").split()
        size, num_lines = end + 1, num_lines + 1
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
        if not len(fields) == len(types) == len(counts) or min(counts) < 0 or num_points < 0:
            raise ValueError("lengths differ, or a number is negative")
        if any(counts[fields.index(name)] < 1 for name in "xyz" if name in fields):
            raise ValueError("a coordinate without a number")
        encoding = entries["DATA"][0].lower()
        layout = np.dtype([(f"{i}", t, (c,)) for i, (t, c) in enumerate(zip(types, counts, strict=True))])
        if encoding == "binary":
            layout = _aligned(layout, fields)
        return CloudLayout(fields, layout, num_points, encoding, size, num_lines)


def _aligned(layout: np.dtype[np.void], fields: list[str]) -> np.dtype[np.void]:
    """Returns the layout with corrected padding, where fields are aligned under it and not under the header's."""
    held = [i for i, name in enumerate(fields) if name != _PADDING]
    starts = [layout.fields[f"{i}"][1] for i in held]  # type: ignore[index]
    sizes, units = [layout[i].itemsize for i in held], [layout[i].base.itemsize for i in held]
    offsets = list(starts)
    for k in range(1, len(held)):
        if held[k] > held[k - 1] + 1:
            # The Point Cloud Library counts the padding before a field as if the field before the padding had its size.
            wrong = sizes[k - 1] // units[k - 1] * (units[k] - units[k - 1])
            offsets[k] = offsets[k - 1] + starts[k] - starts[k - 1] + wrong

    def is_aligned(offsets: list[int]) -> bool:
        ends = [offset + size for offset, size in zip(offsets, sizes, strict=True)]
        is_apart = all(end <= after for end, after in zip(ends, [*offsets[1:], layout.itemsize], strict=True))
        return is_apart and not any(offset % unit for offset, unit in zip(offsets, units, strict=True))

    if not held or is_aligned(starts) or not is_aligned(offsets):
        return layout
    place_of = dict(zip(held, offsets, strict=True))
    everything = range(len(fields))
    formats = [layout[i] if i in place_of else np.dtype(("u1", (0,))) for i in everything]
    places = [place_of.get(i, 0) for i in everything]
    names = [f"{i}" for i in everything]
    return np.dtype({"names": names, "formats": formats, "offsets": places, "itemsize": layout.itemsize})


def _ascii_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Parses the first number of each field; rows may have numbers for the padding, or leave it out."""
    first = next((line.split() for line in body.split(b"\n") if line.strip()), [])
    is_padded = len(first) == sum(header.widths) or _PADDING not in header.fields
    places = [i for i in (range(len(header.fields)) if is_padded else header.wanted) for _ in range(header.widths[i])]
    try:
        table = split_rows(body, header, len(places), source)
    except InputError:
        if (found := _rows_with_characters(body, header, places)) is None:
            raise
        places, table = found
    return {header.fields[i]: table[:, places.index(i)] for i in dict.fromkeys(places) if i in header.wanted}


def _rows_with_characters(
    body: bytes, header: CloudLayout, places: list[int]
) -> tuple[list[int], NDArray[np.float64]] | None:
    """Parses the fields of more than one byte, of rows whose other fields are characters; None for other rows."""
    is_wide = [header.layout[place].base.itemsize > 1 for place in places]
    if all(is_wide) or len(places) > _MOST_COLUMNS:
        return None
    words = (_NUMBER if is_number else _CHARACTER for is_number in is_wide)
    row = re.compile(rb"[ \t\r\n]*?" + rb"[ \t]+".join(words) + rb"[ \t]*(?:\r?\n|\Z)", re.DOTALL)
    rows: list[tuple[bytes | None, ...]] = []
    at = 0
    while len(rows) < header.num_points and (match := row.match(body, at)):
        rows.append(match.groups())
        at = match.end()
    if len(rows) < header.num_points:
        return None
    try:
        table = np.array(rows, np.float64).reshape(len(rows), sum(is_wide))
    except ValueError:
        return None
    return [place for place, is_number in zip(places, is_wide, strict=True) if is_number], table


def _compressed_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Reads the first number of each field from compressed columns, with or without the padding."""
    require(len(body) >= 8, source, "truncated: no sizes of the compressed body", "copy the file again")
    packed_size, size = np.frombuffer(body, "<u4", 2).tolist()
    found = f"truncated: the compressed body has {packed_size} bytes, {len(body) - 8} are there"
    require(len(body) - 8 >= packed_size, source, found, "copy the file again")
    sizes = [header.num_points * header.layout[place].itemsize for place in range(len(header.fields))]
    choices = (list(range(len(sizes))), header.wanted)
    places = next((places for places in choices if size == sum(sizes[place] for place in places)), None)
    if places is None:
        found = f"{header.num_points} points in {size} unpacked bytes do not fit the fields"
        raise InputError(source, found, "copy the file again, or save it anew")
    found = f"{packed_size} bytes cannot unpack to {size}"
    require(size <= _MOST_EXPANSION * packed_size, source, found, "copy the file again")
    with refusing(source, "the compressed body is damaged ({error})", "copy the file again", (ValueError, IndexError)):
        values = unpack_lzf(body[8 : 8 + packed_size], size)
    columns: dict[str, NDArray[np.generic]] = {}
    at = 0
    for place in places:
        if place in header.wanted:
            width = header.widths[place]
            column = np.frombuffer(values, header.layout[place].base, header.num_points * width, at)
            columns[header.fields[place]] = column[::width]
        at += sizes[place]
    return columns
