"""The entrance for 3-D scans: one file with its checks, and folders of any known layout, opened to be read lazily."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.clouds import TimedCloud, parse_pcd, parse_ply
from dpmjax.io.drives import SCAN_SUFFIXES, Drive3D, read_learned_folder, read_plain_folder, scan_files
from dpmjax.io.files import load_arrays, natural_key, read_bytes, to_float32
from dpmjax.io.lidar_datasets import read_kitti_360, read_kitti_carla, read_kitti_odometry, read_kitti_raw, read_mulran
from dpmjax.sequences import EmptyScanError, InputError, LidarSequence, require

_log = logging.getLogger(__name__)
_NPZ_KEYS = ("lidar_pcd", "points", "xyz", "arr_0")
_NPZ_TIMES = "times"
# No lidar on the ground measures outside of these, in metres; nearly all points of a scan lie within the usual range.
_NEAREST_M, _USUAL_M, _FARTHEST_M = 0.1, 120.0, 400.0
_LEAST_USUAL_SHARE = 0.05
_FORMATS = (
    "a KITTI sequence (velodyne/, calib.txt), a KITTI raw or KITTI-360 drive (velodyne_points/data), a MulRan folder "
    "(Ouster/), a KITTI-CARLA town (generated/frames), or a folder of .bin .npy .npz .pcd .ply scans"
)


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
    return _read_scan_file(Path(path), bin_columns).points


def read_point_times(path: str | Path) -> NDArray[np.float64] | None:
    """Reads when each point of a scan was measured.

    Args:
        path: a `.pcd` or `.ply` with a column t, time, timestamp, timestamps, time_stamp, time_offset or offset_time,
            or a `.npz` with an array `times`.

    Returns:
        (n,) one for each point of `read_points`, in the unit and from the start that the file has; None where it has
        none, as all other kinds of files.

    Raises:
        InputError: see `read_lidar_file`.
    """
    path = Path(path)
    return _read_scan_file(path, 4).times if path.suffix.lower() in (".pcd", ".ply", ".npz") else None


def _read_scan_file(path: Path, bin_columns: int) -> TimedCloud:
    """Points and times of any kind of scan, checked."""
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return _check_scan(TimedCloud(_read_bin(path, bin_columns), None), path)
    if suffix in (".pcd", ".ply"):
        content, source = read_bytes(path), str(path)
        is_pcd = suffix == ".pcd"
        return _check_scan(parse_pcd(content, source, drop_nan=True) if is_pcd else parse_ply(content, source), path)
    found = f"an unknown kind of scan, {suffix or 'without ending'}"
    require(suffix in SCAN_SUFFIXES, path, found, f"give one of {' '.join(SCAN_SUFFIXES)}")
    table = load_arrays(path, None if suffix == ".npy" else (*_NPZ_KEYS, _NPZ_TIMES))
    values = next((table[key] for key in _NPZ_KEYS if key in table), None)
    if values is None:
        raise InputError(path, "no array of points", "call it lidar_pcd or points")
    is_good = values.ndim == 2 and values.shape[1] >= 3 and values.dtype.kind in "fiu"
    found = f"an array of {values.shape} {values.dtype}"
    require(is_good, path, found, "give points (n, 3): x, y and z in metres")
    times = None
    if _NPZ_TIMES in table:
        column = table[_NPZ_TIMES]
        found = f"times {column.shape} {column.dtype} of {len(values)} points"
        require(column.shape == values.shape[:1] and column.dtype.kind in "fiu", path, found, "give one time a point")
        times = np.asarray(column, np.float64)
    return _check_scan(TimedCloud(to_float32(values[:, :3]), times), path)


def warn_of_unit(points: NDArray[np.float32], source: str | Path) -> None:
    """Logs a warning where hardly any point is as near as lidars measure.

    Args:
        points: (n, 3), m.
        source: for the message.
    """
    share = float((np.linalg.norm(points.astype(np.float64), axis=1) < _USUAL_M).mean()) if len(points) else 1.0
    if share < _LEAST_USUAL_SHARE:
        _log.warning("%s: %.1f %% of the points lie within %g m; are these millimetres?", source, 100 * share, _USUAL_M)


def _check_scan(cloud: TimedCloud, source: Path) -> TimedCloud:
    """Refuses what is no scan in metres, and takes points at the origin away."""
    points, times = cloud
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        found = f"{bad.sum()} of {len(points)} points are NaN or infinite, the first is point {int(np.argmax(bad))}"
        raise InputError(source, found, "write beams that met nothing as 0 0 0, or leave them out")
    is_kept = (points != 0).any(axis=1)
    kept = np.ascontiguousarray(points[is_kept], np.float32)
    if not len(kept):
        raise EmptyScanError(source, "no point in the scan", "remove the file, or copy it again")
    # In float64, for garbage reaches 1e38.
    ranges = np.linalg.norm(kept.astype(np.float64), axis=1)
    median = float(np.median(ranges))
    advice = "convert millimetres to metres" if median < 1000 * _FARTHEST_M else "check the number of columns"
    require(median <= _FARTHEST_M, source, f"the median range is {median:.4g} m", advice)
    is_near = ((ranges > _NEAREST_M) & (ranges < _FARTHEST_M)).any()
    require(is_near, source, f"all {len(kept)} points are out of range", "give metres in the lidar's own frame")
    return TimedCloud(kept, None if times is None else times[is_kept])


def _read_bin(path: Path, columns: int) -> NDArray[np.float32]:
    content = read_bytes(path)
    others = [str(n) for n in (3, 4, 5, 6) if n != columns and len(content) % (4 * n) == 0]
    found = f"{len(content)} bytes are no whole number of points of {columns} float32: truncated, or other columns"
    advice = "copy the file again" + (f", or say that it has {' or '.join(others)} columns" if others else "")
    require(len(content) % (4 * columns) == 0, path, found, advice)
    return np.frombuffer(content, "<f4").reshape(-1, columns)[:, :3]


def open_lidar_sequence(
    path: str | Path,
    *,
    sequence: str | None = None,
    poses: str | Path | None = None,
    selection: slice = slice(None),
    bin_columns: int = 4,
) -> LidarSequence:
    """Opens a drive of 3-D scans, whatever of the known layouts it is in; no scan is read yet.

    Args:
        path: the folder of a drive, or the root of a data set that holds several.
        sequence: which drive of a root, like "00"; may be left out where there is only one.
        poses: a pose file in the lidar's frame (KITTI or TUM rows, `.npy`) instead of the data set's own.
        selection: start, stop and stride in scans.
        bin_columns: numbers a point has in `.bin` files.

    Returns:
        The sequence, with poses in the lidar's frame and times where the source has them.

    Raises:
        InputError: one line with the file, what was found and what to do: no such folder, an unknown layout, no scan,
            poses that cannot be brought into the lidar's frame, or a selection of no scan.
    """
    path = Path(path)
    require(bin_columns >= 3, path, f"bin_columns is {bin_columns}", "a point has x, y and z at least")
    drive = _read(_choose(path, sequence), None if poses is None else Path(poses))
    require(len(drive.files) > 0, path, "a folder without scans", f"give {_FORMATS}")
    sources, read_scan = tuple(map(str, drive.files)), partial(_read_scan, drive.files, bin_columns)
    whole = LidarSequence(
        drive.name, sources, read_scan, drive.T_world_lidar, drive.times, lambda index: read_point_times(sources[index])
    )
    part = whole.take(selection)
    require(part.num_scans > 0, path, f"{selection} chooses 0 of {whole.num_scans} scans", "choose others")
    return part


def list_lidar_sequences(path: str | Path) -> list[str]:
    """The drives below the root of a data set.

    Args:
        path: a folder with sequences/NN, data_3d_raw/DRIVE, scene/agent/N.npz, or drives right in it.

    Returns:
        Names for `open_lidar_sequence(path, sequence=name)`, in natural order; none where the path is a drive itself.
    """
    path = Path(path)
    return [] if not path.is_dir() or _kind(path) is not None else sorted(_drives(path), key=natural_key)


def _read_scan(files: list[Path], bin_columns: int, index: int) -> NDArray[np.float32]:
    """Scan `index`; the first one stands for all in the warning of a wrong unit."""
    points = read_points(files[index], bin_columns=bin_columns)
    if index == 0:
        warn_of_unit(points, files[index])
    return points


def _choose(path: Path, sequence: str | None) -> Path:
    """The folder of the drive that is meant."""
    require(path.exists(), path, "no such folder", "check the path")
    require(not path.is_file(), path, "a single file", "give the folder that holds all scans of the drive")
    is_drive = _kind(path) is not None
    if sequence is None and is_drive:
        return path
    drives = _drives(path)
    known = ", ".join(sorted(drives, key=natural_key)[:30])
    if sequence is not None:
        if sequence not in drives and is_drive and path.resolve().name == sequence:
            return path
        held = f"it has {known}" if drives else "it is one drive without a name" if is_drive else "it has no scans"
        advice = "name one of those" if drives else "leave the name out, or give another folder"
        require(sequence in drives, path, f"no sequence {sequence}, {held}", advice)
        return drives[sequence]
    require(len(drives) > 0, path, "a folder without scans", f"give {_FORMATS}")
    require(len(drives) == 1, path, f"{len(drives)} sequences: {known}", "name one of them, or give its folder")
    return next(iter(drives.values()))


def _drives(path: Path) -> dict[str, Path]:
    """Drives below a root, by name: two levels at most."""
    for below in ("sequences", "dataset/sequences", "data_3d_raw"):
        if (path / below).is_dir():
            return _drives(path / below)
    children = [child for child in sorted(path.iterdir()) if child.is_dir()]
    deeper = (folder for child in children for folder in sorted(child.iterdir()) if folder.is_dir())
    found = {child.name: child for child in children if _kind(child) is not None}
    return found or {f"{folder.parent.name}/{folder.name}": folder for folder in deeper if _kind(folder) is not None}


# How a kind of drive is read, and which of its folders holds the scans.
_LAYOUTS: dict[str, tuple[Callable[[Path], Drive3D], str]] = {
    "kitti_carla": (read_kitti_carla, "generated/frames"),
    "mulran": (read_mulran, "Ouster"),
    "kitti_360": (read_kitti_360, "velodyne_points/data"),
    "kitti_raw": (read_kitti_raw, "velodyne_points/data"),
    "kitti_odometry": (read_kitti_odometry, "velodyne"),
    "learned": (read_learned_folder, ""),
    "plain": (read_plain_folder, ""),
    "plain_data": (lambda path: _read_plain(path, "data", None), "data"),
}


def _read_plain(path: Path, scans: str, poses: Path | None) -> Drive3D:
    """A plain folder of scans below that of the drive."""
    return read_plain_folder(path / scans, poses=poses)._replace(name=path.resolve().name)


def _kind(path: Path) -> str | None:
    """Which layout a folder has, judged by what lies in it; None for none."""
    if (path / "generated" / "frames").is_dir() or (path / "full_poses_lidar.txt").is_file():
        return "kitti_carla"
    if (path / "Ouster").is_dir() or (path / "sensor_data" / "Ouster").is_dir():
        return "mulran"
    if (path / "velodyne_points").is_dir():
        return "kitti_360" if path.resolve().parent.name == "data_3d_raw" else "kitti_raw"
    if (path / "velodyne").is_dir():
        return "kitti_odometry"
    if files := scan_files(path):
        return "learned" if files[0].suffix.lower() == ".npz" else "plain"
    return "plain_data" if scan_files(path / "data") else None


def _read(path: Path, poses: Path | None) -> Drive3D:
    """The drive in a folder; a given pose file replaces that of the data set."""
    read, scans = _LAYOUTS[_kind(path) or "plain"]
    return read(path) if poses is None else _read_plain(path, scans, poses)
