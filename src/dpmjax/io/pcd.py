"""PCD 0.7 files, the format of the Point Cloud Library: ascii, binary or compressed by LZF, with padding."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import PADDING, CloudLayout, TimedCloud, cloud_of, split_rows, unpack_columns
from dpmjax.io.files import refusing
from dpmjax.sequences import InputError, require

# Largest ratio of unpacked to packed size: three packed bytes unpack to up to 264.
_MOST_EXPANSION = 88
_TYPES = {"F": "f", "I": "i", "U": "u"}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
# A field of one byte is a number or, by the Point Cloud Library, the character of this code, a line feed too.
_MOST_COLUMNS = 100
_CHARACTER, _NUMBER = rb"(?:-?\d{1,3}(?=[ \t\r\n]|\Z)|.)", rb"(\S+)"


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
    header = _parse_header(content, source)
    for name in ("x", "y"):
        found = f"fields are {' '.join(header.fields)}"
        require(name in header.fields, source, found, f"the file needs a column {name}")
    found = f"DATA {header.encoding} is not supported"
    require(header.encoding in _ENCODINGS, source, found, f"save the cloud as one of {' '.join(_ENCODINGS)}")
    read = {"ascii": _ascii_columns, "binary": unpack_columns, "binary_compressed": _compressed_columns}
    columns = read[header.encoding](content[header.size :], header, source)
    return cloud_of({"z": np.zeros(header.num_points), **columns})


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
        if encoding == "binary":
            layout = _aligned(layout, fields)
        return CloudLayout(fields, layout, num_points, encoding, size, num_lines)


def _aligned(layout: np.dtype[np.void], fields: list[str]) -> np.dtype[np.void]:
    """Returns the layout with corrected padding, where fields are aligned under it and not under the header's."""
    held = [i for i, name in enumerate(fields) if name != PADDING]
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
    is_padded = len(first) == sum(header.widths) or PADDING not in header.fields
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
