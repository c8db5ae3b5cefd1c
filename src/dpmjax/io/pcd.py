"""PCD 0.7 files, the format of the Point Cloud Library: ascii, binary or compressed by LZF, with padding."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.clouds import PADDING, CloudLayout, TimedCloud, times_of, unpack_columns
from dpmjax.io.files import refusing, split_rows, to_float32, write_atomically
from dpmjax.sequences import InputError, require

MOST_EXPANSION = 88
"""Largest ratio of unpacked to packed size: three packed bytes unpack to up to 264."""


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
        out += piece if len(piece) == length else (piece * (length // len(piece) + 1))[:length]
    if at != end or len(out) != size:
        raise ValueError(f"unpacks to {len(out)} bytes, not to {size}")
    return bytes(out)


_TYPES = {"F": "f", "I": "i", "U": "u"}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
# A field of one byte is a number or, by the Point Cloud Library, the character of this code, a line feed too.
_MOST_COLUMNS = 100
_CHARACTER, _NUMBER = rb"(?:-?\d{1,3}(?=[ \t\r\n]|\Z)|.)", rb"(\S+)"


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
    header = _parse_header(content, source)
    for name in ("x", "y"):
        found = f"fields are {' '.join(header.fields)}"
        require(name in header.fields, source, found, f"the file needs a column {name}")
    found = f"DATA {header.encoding} is not supported"
    require(header.encoding in _ENCODINGS, source, found, f"save the cloud as one of {' '.join(_ENCODINGS)}")
    body = content[header.size :]
    read = {"ascii": _ascii_columns, "binary": unpack_columns, "binary_compressed": _compressed_columns}
    columns = read[header.encoding](body, header, source)
    zeros = np.zeros(header.num_points, np.float32)
    return TimedCloud(
        np.stack([to_float32(columns.get(name, zeros)) for name in "xyz"], axis=1),
        times_of(columns),
    )


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


def _parse_header(content: bytes, source: str) -> CloudLayout:
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
        types = ["<" + _TYPES[t] + s for t, s in zip(entries["TYPE"], entries["SIZE"], strict=True)]
        counts = [int(count) for count in entries.get("COUNT", ["1"] * len(fields))]
        sizes = entries.get("POINTS") or [entries["WIDTH"][0], entries["HEIGHT"][0]]
        num_points = int(sizes[0]) * int(sizes[1] if len(sizes) > 1 else 1)
        if not len(fields) == len(types) == len(counts) or min(counts) < 0 or num_points < 0:
            raise ValueError("lengths differ, or a number is negative")
        if any(counts[fields.index(name)] < 1 for name in "xyz" if name in fields):
            raise ValueError("a coordinate without a number")
        encoding = entries["DATA"][0].lower()
        layout = np.dtype([(f"{i}", t, (c,)) for i, (t, c) in enumerate(zip(types, counts, strict=True))])
        if encoding == "binary" and PADDING in fields:
            layout = _aligned(layout, fields)
        return CloudLayout(fields, layout, num_points, encoding, size, num_lines)


def _aligned(layout: np.dtype[np.void], fields: list[str]) -> np.dtype[np.void]:
    """Returns the layout with corrected padding, where fields are aligned under it and not under the header's."""
    # The Point Cloud Library counts the padding before a field as if the field before the padding had its size.
    names = [f"{i}" for i in range(len(fields))]
    kinds, starts = [layout[name] for name in names], [layout.fields[name][1] for name in names]  # type: ignore[index]
    offsets, before = list(starts), None
    for i, name in enumerate(fields):
        if name == PADDING:
            continue
        if before is not None and i > before + 1:
            wrong_size = math.prod(kinds[before].shape) * kinds[i].base.itemsize
            offsets[i] = offsets[before] + wrong_size + starts[i] - starts[before] - kinds[before].itemsize
        before = i
    held = [i for i, name in enumerate(fields) if name != PADDING]

    def is_aligned(offsets: list[int]) -> bool:
        ends = [offsets[i] + kinds[i].itemsize for i in held]
        is_apart = (
            all(end <= offsets[i] for end, i in zip(ends, held[1:], strict=False)) and ends[-1] <= layout.itemsize
        )
        return is_apart and all(offsets[i] % kinds[i].base.itemsize == 0 for i in held)

    if not held or is_aligned(starts) or not is_aligned(offsets):
        return layout
    formats = [kind if i in held else np.dtype(("u1", (0,))) for i, kind in enumerate(kinds)]
    places = [offsets[i] if i in held else 0 for i in range(len(fields))]
    return np.dtype({"names": names, "formats": formats, "offsets": places, "itemsize": layout.itemsize})


def _ascii_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Parses the first number of each field; rows may have numbers for the padding, or leave it out."""
    first = next((line.split() for line in body.split(b"\n") if line.strip()), [])
    is_padded = len(first) == sum(header.widths) or PADDING not in header.fields
    places = range(len(header.fields)) if is_padded else header.wanted
    widths = [header.widths[place] for place in places]
    characters = [place for place in places if header.layout[place].base.itemsize == 1]
    try:
        table = split_rows(body, sum(widths), header.num_points, source, num_lines_before=header.num_lines)
    except InputError:
        if not characters:
            raise
        found = _rows_with_characters(body, header, list(places))
        if found is None:
            raise
        return found
    columns = table[:, np.cumsum([0, *widths[:-1]])] if len(widths) else table
    return {header.fields[p]: columns[:, i] for i, p in enumerate(places) if p in header.wanted}


def _rows_with_characters(body: bytes, header: CloudLayout, places: list[int]) -> dict[str, NDArray[np.generic]] | None:
    """Parses the fields of more than one byte, of rows whose other fields are characters; None for other rows."""
    if sum(header.widths) > _MOST_COLUMNS:
        return None
    is_number = [header.layout[place].base.itemsize > 1 for place in places for _ in range(header.widths[place])]
    names = [header.fields[place] for place in places for _ in range(header.widths[place])]
    words = (_NUMBER if is_wide else _CHARACTER for is_wide in is_number)
    row = re.compile(rb"[ \t\r\n]*?" + rb"[ \t]+".join(words) + rb"[ \t]*(?:\r?\n|\Z)", re.DOTALL)
    rows, at = [], 0
    for _ in range(header.num_points):
        match = row.match(body, at)
        if match is None:
            return None
        rows.append(match.groups())
        at = match.end()
    try:
        table = np.array(rows, np.float64).reshape(len(rows), sum(is_number))
    except ValueError:
        return None
    kept = [name for name, is_wide in zip(names, is_number, strict=True) if is_wide]
    return {name: table[:, kept.index(name)] for name in dict.fromkeys(kept) if name != PADDING}


def _compressed_columns(body: bytes, header: CloudLayout, source: str) -> dict[str, NDArray[np.generic]]:
    """Reads the first number of each field from compressed columns, with or without the padding."""
    require(len(body) >= 8, source, "truncated: no sizes of the compressed body", "copy the file again")
    packed_size, size = np.frombuffer(body, "<u4", 2).tolist()
    found = f"truncated: the compressed body has {packed_size} bytes, {len(body) - 8} are there"
    require(len(body) - 8 >= packed_size, source, found, "copy the file again")
    itemsizes = [header.layout[place].itemsize for place in range(len(header.fields))]
    for places in (list(range(len(itemsizes))), header.wanted):
        if size == header.num_points * sum(itemsizes[place] for place in places):
            break
    else:
        found = f"{header.num_points} points in {size} unpacked bytes do not fit the fields"
        raise InputError(source, found, "copy the file again, or save it anew")
    found = f"{packed_size} bytes cannot unpack to {size}"
    require(size <= MOST_EXPANSION * packed_size, source, found, "copy the file again")
    with refusing(source, "the compressed body is damaged ({error})", "copy the file again", (ValueError, IndexError)):
        values = unpack_lzf(body[8 : 8 + packed_size], size)
    columns: dict[str, NDArray[np.generic]] = {}
    at = 0
    for place in places:
        if place in header.wanted:
            kind, width = header.layout[place].base, header.widths[place]
            column = np.frombuffer(values, kind, header.num_points * width, at)
            columns[header.fields[place]] = column.reshape(header.num_points, width)[:, 0]
        at += header.num_points * itemsizes[place]
    return columns
