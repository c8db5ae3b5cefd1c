"""LAS files and their compressed form, LAZ, by laspy (extra `las`)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from dpmjax.io.clouds import TimedCloud
from dpmjax.io.extras import import_for
from dpmjax.io.files import read_bytes, refusing, to_float32
from dpmjax.sequences import require

# LAZ packs a point of 20 bytes or more to 3, and to less only where all points are alike.
_MOST_POINTS_PER_BYTE = 100


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
        with laspy.open(io.BytesIO(content)) as reader:
            _require_whole(int(reader.header.point_count), len(content))
            cloud = reader.read()
        points = np.stack([np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)], axis=1)
        has_times = "gps_time" in cloud.point_format.dimension_names
        times = np.asarray(cloud.gps_time, np.float64) if has_times else None
        return TimedCloud(to_float32(points), times)


def _require_whole(count: int, size: int) -> None:
    if count > _MOST_POINTS_PER_BYTE * size:
        raise ValueError(f"truncated: {count} points, {size} bytes are there")
