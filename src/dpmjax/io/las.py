"""LAS files and their compressed form, LAZ, by laspy (extra `las`)."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax.io.clouds import TimedCloud
from dpmjax.io.files import read_bytes, refusing, to_float32
from dpmjax.io.messages import import_for
from dpmjax.sequences import InputError, require

_ADVICE = "copy the file again, or save it anew as LAS 1.2 or 1.4"
# LAZ packs a point of 20 bytes or more to 3, and to less only where all points are alike.
_MOST_POINTS_PER_BYTE = 100
# The least length of a variable length record.
_RECORD_BYTES = 54
# Types of the compressed items of a point with fixed lengths, in bytes; byte items have any length.
_ITEM_BYTES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_BYTE_ITEMS = (0, 14)


def read_las(path: Path) -> TimedCloud:
    """Reads the points of a LAS or LAZ file.

    Args:
        path: the file.

    Returns:
        The points, with their GPS times where the point format has them.

    Raises:
        InputError: no such file, no laspy, or a damaged file.
        BaseException: an interruption.
    """
    content = read_bytes(path)
    laspy = import_for(path, "laspy", "las")
    require(content[:4] == b"LASF", path, "no LAS header", _ADVICE)
    try:
        # Damaged headers raise many kinds of errors.
        with refusing(path, "not a readable LAS file ({kind}: {error})", _ADVICE, (Exception,)):
            return _read(laspy, content)
    except BaseException as error:
        # A panic of the decompressor, which is written in Rust, is no Exception.
        if type(error).__name__ == "PanicException":
            raise InputError(path, f"not a readable LAS file ({error})", _ADVICE) from error
        raise


def _read(laspy: Any, content: bytes) -> TimedCloud:
    _require_room_for_records(content)
    options = {"laz_backend": (laspy.LazBackend.Lazrs,), "read_evlrs": False}
    with np.errstate(all="ignore"), laspy.open(io.BytesIO(content), **options) as reader:
        _require_whole(reader.header, content)
        cloud = reader.read()
        points = np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)
        has_times = "gps_time" in cloud.point_format.dimension_names
        return TimedCloud(to_float32(points), np.asarray(cloud.gps_time, np.float64) if has_times else None)


def _require_room_for_records(content: bytes) -> None:
    """Raises a ValueError where the header names more records before the points than fit."""
    header_size, start, num_records = struct.unpack_from("<HII", content, 94)
    if not header_size + num_records * _RECORD_BYTES <= start <= len(content):
        raise ValueError(f"{num_records} records before the points, which begin at byte {start} of {len(content)}")


def _require_whole(header: Any, content: bytes) -> None:
    """Raises a ValueError where a file is shorter than its header says."""
    count, size = int(header.point_count), len(content)
    start, width = int(header.offset_to_point_data), int(header.point_format.size)
    is_whole = count <= _MOST_POINTS_PER_BYTE * size if header.are_points_compressed else start + count * width <= size
    if not is_whole:
        raise ValueError(f"truncated: {count} points, {size} bytes are there")
    if header.are_points_compressed:
        _require_chunks(content, start)
        _require_items(header.vlrs.get("LasZipVlr")[0].record_data, width)


def _require_chunks(content: bytes, start: int) -> None:
    """Raises a ValueError where there is no table of the compressed chunks."""
    # The decompressor reserves memory by the number in the table, and ends the process where it fails.
    size = len(content)
    (place,) = struct.unpack_from("<q", content, start)
    (place,) = struct.unpack_from("<q", content, size - 8) if place == -1 else (place,)
    version, num_chunks = struct.unpack_from("<II", content, place) if 0 < place <= size - 8 else (1, 0)
    if version != 0 or num_chunks > size:
        raise ValueError("no table of its compressed chunks")


def _require_items(record: bytes, width: int) -> None:
    """Raises a ValueError where the items of a compressed point are unknown, or do not make a point."""
    (count,) = struct.unpack_from("<H", record, 32)
    items = [struct.unpack_from("<HH", record, 34 + 6 * i) for i in range(count)]
    is_known = all(size == _ITEM_BYTES[kind] if kind in _ITEM_BYTES else kind in _BYTE_ITEMS for kind, size in items)
    if not items or not is_known or sum(size for _, size in items) != width:
        raise ValueError(f"points of {width} bytes in compressed items {items}")
