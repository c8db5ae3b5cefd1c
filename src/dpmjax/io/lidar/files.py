"""One 3-D scan out of one file, and the checks that every scan must pass before it is used."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import read_pcd, read_ply
from dpmjax.io.files import load_arrays, read_bytes, to_float32
from dpmjax.sequences import InputError

_log = logging.getLogger(__name__)
SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")
_NPZ_KEYS = ("lidar_pcd", "points", "xyz", "arr_0")
# No lidar on the ground measures outside of these, in metres; nearly all points of a scan lie within the usual range.
_NEAREST_M, _USUAL_M, _FARTHEST_M = 0.1, 120.0, 400.0
_LEAST_USUAL_SHARE = 0.05


def read_lidar_file(path: str | Path, *, bin_columns: int = 4) -> NDArray[np.float32]:
    """Reads one scan.

    A scan with hardly any point within 120 m is read, but a warning asks whether it is in millimetres.

    Args:
        path: `.bin` (float32 rows of x, y, z and more, as of KITTI), `.npy` (n, 3 or more), `.npz` (key `lidar_pcd`,
            `points`, `xyz` or `arr_0`), `.pcd` or `.ply`.
        bin_columns: numbers a point has in a `.bin` file: 4 with KITTI and MulRan, 3 or 5 elsewhere.

    Returns:
        (n, 3) float32 x, y, z in the lidar's frame, m, without the points at the origin, which stand for beams that
        met nothing (so do points of NaN in a `.pcd`).

    Raises:
        InputError: names the file and what is wrong: missing, truncated, wrong columns, NaN or infinite coordinates, no
            points, all of them out of range, or lengths that can only be millimetres.
    """
    points = read_points(path, bin_columns=bin_columns)
    warn_of_unit(points, path)
    return points


def read_points(path: str | Path, *, bin_columns: int = 4) -> NDArray[np.float32]:
    """What `read_lidar_file` reads, without the warning.

    Args:
        path: the file.
        bin_columns: numbers a point has in a `.bin` file.

    Returns:
        (n, 3) float32, m.

    Raises:
        InputError: see `read_lidar_file`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return _check_scan(_read_bin(path, bin_columns), path)
    if suffix == ".pcd":
        return _check_scan(read_pcd(path, drop_nan=True), path)
    if suffix == ".ply":
        return _check_scan(read_ply(path), path)
    if suffix not in SCAN_SUFFIXES:
        found = f"an unknown kind of scan, {suffix or 'without ending'}"
        raise InputError(path, found, f"give one of {' '.join(SCAN_SUFFIXES)}")
    table = load_arrays(path, None if suffix == ".npy" else _NPZ_KEYS)
    values = next((table[key] for key in _NPZ_KEYS if key in table), None)
    if values is None:
        raise InputError(path, "no array of points", "call it lidar_pcd or points")
    if values.ndim != 2 or values.shape[1] < 3 or values.dtype.kind not in "fiu":
        found = f"an array of {values.shape} {values.dtype}"
        raise InputError(path, found, "give points (n, 3): x, y and z in metres")
    return _check_scan(to_float32(values[:, :3]), path)


def warn_of_unit(points: NDArray[np.float32], source: str | Path) -> None:
    """Logs a warning where hardly any point is as near as lidars measure.

    Args:
        points: (n, 3), m.
        source: for the message.
    """
    share = float((np.linalg.norm(points.astype(np.float64), axis=1) < _USUAL_M).mean()) if len(points) else 1.0
    if share < _LEAST_USUAL_SHARE:
        _log.warning("%s: %.1f %% of the points lie within %g m; are these millimetres?", source, 100 * share, _USUAL_M)


def _check_scan(points: NDArray[np.float32], source: Path) -> NDArray[np.float32]:
    """Refuses what is no scan in metres, and takes points at the origin away."""
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        found = f"{bad.sum()} of {len(points)} points are NaN or infinite, the first is point {int(np.argmax(bad))}"
        raise InputError(source, found, "write beams that met nothing as 0 0 0, or leave them out")
    kept = np.ascontiguousarray(points[(points != 0).any(axis=1)], np.float32)
    if not len(kept):
        raise InputError(source, "no point in the scan", "remove the file, or copy it again")
    # In float64, for garbage reaches 1e38.
    ranges = np.linalg.norm(kept.astype(np.float64), axis=1)
    median = float(np.median(ranges))
    if median > _FARTHEST_M:
        advice = "convert millimetres to metres" if median < 1000 * _FARTHEST_M else "check the number of columns"
        raise InputError(source, f"the median range is {median:.4g} m", advice)
    if not ((ranges > _NEAREST_M) & (ranges < _FARTHEST_M)).any():
        raise InputError(source, f"all {len(kept)} points are out of range", "give metres in the lidar's own frame")
    return kept


def _read_bin(path: Path, columns: int) -> NDArray[np.float32]:
    content = read_bytes(path)
    if len(content) % (4 * columns):
        others = [str(n) for n in (3, 4, 5, 6) if n != columns and len(content) % (4 * n) == 0]
        found = f"{len(content)} bytes are no whole number of points of {columns} float32: truncated, or other columns"
        advice = "copy the file again" + (f", or say that it has {' or '.join(others)} columns" if others else "")
        raise InputError(path, found, advice)
    return np.frombuffer(content, "<f4").reshape(-1, columns)[:, :3]
