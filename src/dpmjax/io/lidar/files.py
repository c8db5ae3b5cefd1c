"""One 3-D scan out of one file, and the checks that every scan must pass before it is used."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.errors import InputError
from dpmjax.io.pcd import read_pcd
from dpmjax.io.ply import read_ply

SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")
_NPZ_KEYS = ("lidar_pcd", "points", "xyz", "arr_0")
# Nothing that a lidar measures on the ground is outside of these, in metres.
_NEAREST_M, _FARTHEST_M = 0.1, 400.0


def read_lidar_file(path: str | Path, *, bin_columns: int = 4) -> NDArray[np.float32]:
    """Reads one scan.

    Args:
        path: `.bin` (float32 rows of x, y, z and more, as of KITTI), `.npy` (n, 3 or more), `.npz` (key `lidar_pcd`,
            `points`, `xyz` or `arr_0`), `.pcd` or `.ply`.
        bin_columns: numbers a point has in a `.bin` file: 4 with KITTI and MulRan, 3 or 5 elsewhere.

    Returns:
        (n, 3) float32 x, y, z in the lidar's frame, m, without the points at the origin, which stand for beams that
        met nothing (so do points of NaN in a `.pcd`).

    Raises:
        InputError: names the file and what is wrong: missing, cut off, wrong columns, NaN or infinite coordinates, no
            points, all of them out of range, or lengths that can only be millimetres.
    """
    path = Path(path)
    read = {".bin": _read_bin, ".npy": _read_npy, ".npz": _read_npz}.get(path.suffix.lower())
    if path.suffix.lower() == ".pcd":
        points = read_pcd(path, drop_nan=True)
    elif path.suffix.lower() == ".ply":
        points = read_ply(path)
    elif read is None:
        raise InputError(path, f"an unknown kind of scan, {path.suffix or 'without ending'}", _advise())
    else:
        points = read(path, bin_columns)
    return checked_scan(points, str(path))


def checked_scan(points: NDArray[np.float32], source: str) -> NDArray[np.float32]:
    """Refuses what is no scan in metres, and takes points at the origin away.

    Args:
        points: (n, 3).
        source: for messages.

    Returns:
        (m, 3) float32.

    Raises:
        InputError: see `read_lidar_file`.
    """
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


def _advise() -> str:
    return f"give one of {' '.join(SCAN_SUFFIXES)}"


def _read_bin(path: Path, columns: int) -> NDArray[np.float32]:
    try:
        size = path.stat().st_size
        if size % (4 * columns):
            others = [str(n) for n in (3, 4, 5, 6) if n != columns and size % (4 * n) == 0]
            found = f"{size} bytes are no whole number of points of {columns} float32: cut off, or other columns"
            advice = "copy the file again" + (f", or say that it has {' or '.join(others)} columns" if others else "")
            raise InputError(path, found, advice)
        return np.fromfile(path, "<f4").reshape(-1, columns)[:, :3]
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path") from error


def _read_npy(path: Path, _: int) -> NDArray[np.float32]:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(path, f"not a readable NumPy file ({error})", "save it again with numpy.save") from error
    return _as_points(values, path)


def _read_npz(path: Path, _: int) -> NDArray[np.float32]:
    table = read_npz(path, _NPZ_KEYS)
    key = next((key for key in _NPZ_KEYS if key in table), None)
    if key is None:
        raise InputError(path, "no array of points", "call it lidar_pcd or points")
    return _as_points(table[key], path)


def read_npz(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Reads some arrays of a NumPy archive.

    Args:
        path: the file.
        keys: the arrays that are wanted.

    Returns:
        Those of them that are there.

    Raises:
        InputError: no such file, no archive, or a damaged one.
    """
    try:
        # An opened file, for numpy.load leaves one open that is no archive.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as table:
            return {key: table[key] for key in keys if key in table.files}
    except (OSError, ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(path, f"not a readable NumPy archive ({error})", "save it again with numpy.savez") from error


def _as_points(values: NDArray[np.generic], path: Path) -> NDArray[np.float32]:
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.shape[1] < 3 or values.dtype.kind not in "fiu":
        found = f"an array of {getattr(values, 'shape', '?')} {getattr(values, 'dtype', '?')}"
        raise InputError(path, found, "give points (n, 3): x, y and z in metres")
    return np.asarray(values[:, :3], np.float32)
