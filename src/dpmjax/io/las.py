"""LAS files and their compressed form, LAZ, by laspy (extra `las`)."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np

from dpmjax.io.clouds import TimedCloud
from dpmjax.io.extras import import_for
from dpmjax.io.files import read_bytes, refusing, to_float32
from dpmjax.sequences import require

# LAZ packs a point of 20 bytes or more to 3, and to less only where all points are alike.
_MOST_POINTS_PER_BYTE = 100
# The least length of a variable length record.
_RECORD_BYTES = 54


def read_las(path: Path) -> TimedCloud:
    """Reads the points of a LAS or LAZ file.

    Args:
        path: the file.

    Returns:
        The points, with their GPS times where the point format has them.

    Raises:
        InputError: no such file, no laspy, or a damaged file.
    """
    content = read_bytes(path)
    laspy = import_for(path, "laspy", "las")
    advice = "copy the file again, or save it anew as LAS 1.2 or 1.4"
    require(content[:4] == b"LASF", path, "no LAS header", advice)
    # Damaged headers raise many kinds of errors, those of the decompressor, too.
    with refusing(path, "not a readable LAS file ({kind}: {error})", advice, (Exception,)):
        _require_room_for_records(content)
        backend = (laspy.LazBackend.Lazrs,)
        with (
            np.errstate(all="ignore"),
            laspy.open(io.BytesIO(content), laz_backend=backend, read_evlrs=False) as reader,
        ):
            _require_whole(reader.header, content)
            cloud = reader.read()
        points = np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)
        has_times = "gps_time" in cloud.point_format.dimension_names
        times = np.asarray(cloud.gps_time, np.float64) if has_times else None
        return TimedCloud(to_float32(points), times)


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
        # The decompressor makes room for as many chunks as the table names, and ends the process where it cannot.
        (place,) = struct.unpack_from("<q", content, start)
        (place,) = struct.unpack_from("<q", content, size - 8) if place == -1 else (place,)
        version, num_chunks = struct.unpack_from("<II", content, place) if 0 < place <= size - 8 else (1, 0)
        if version != 0 or num_chunks > size:
            raise ValueError("no table of its compressed chunks")
