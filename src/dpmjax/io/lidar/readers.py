"""The entrance for 3-D scans: finds out what a folder holds, and opens it as a sequence that reads lazily."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import natural_key
from dpmjax.io.lidar.datasets import read_kitti_360, read_kitti_carla, read_kitti_raw, read_mulran
from dpmjax.io.lidar.drive import Drive3D, read_learned_folder, read_plain_folder, scan_files
from dpmjax.io.lidar.files import read_points, warn_of_unit
from dpmjax.io.lidar.kitti import read_kitti_odometry
from dpmjax.sequences import InputError, LidarSequence

_FORMATS = (
    "a KITTI sequence (velodyne/, calib.txt), a KITTI raw or KITTI-360 drive (velodyne_points/data), a MulRan folder "
    "(Ouster/), a KITTI-CARLA town (generated/frames), or a folder of .bin .npy .npz .pcd .ply scans"
)


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
    if bin_columns < 3:
        raise InputError(path, f"bin_columns is {bin_columns}", "a point has x, y and z at least")
    drive = _read(_choose(path, sequence), None if poses is None else Path(poses))
    if not drive.files:
        raise InputError(path, "a folder without scans", f"give {_FORMATS}")
    whole = LidarSequence(
        name=drive.name,
        sources=tuple(str(file) for file in drive.files),
        read_scan=partial(_read_scan, drive.files, bin_columns),
        T_world_lidar=drive.T_world_lidar,
        times=drive.times,
    )
    part = whole.take(selection)
    if not part.num_scans:
        raise InputError(path, f"{selection} chooses 0 of {whole.num_scans} scans", "choose others")
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
    if not path.exists():
        raise InputError(path, "no such folder", "check the path")
    if path.is_file():
        raise InputError(path, "a single file", "give the folder that holds all scans of the drive")
    if sequence is None and _kind(path) is not None:
        return path
    drives = _drives(path)
    if sequence is not None:
        if sequence in drives:
            return drives[sequence]
        if path.resolve().name == sequence and _kind(path) is not None:
            return path
        known = ", ".join(sorted(drives, key=natural_key)[:30]) or "none"
        raise InputError(path, f"no sequence {sequence}; there are: {known}", "name one of those")
    if len(drives) == 1:
        return next(iter(drives.values()))
    if drives:
        known = ", ".join(sorted(drives, key=natural_key)[:30])
        raise InputError(path, f"{len(drives)} sequences: {known}", "name one of them, or give its folder")
    raise InputError(path, "a folder without scans", f"give {_FORMATS}")


def _drives(path: Path) -> dict[str, Path]:
    """Drives below a root, by name: two levels at most."""
    for below in ("sequences", "dataset/sequences", "data_3d_raw"):
        if (path / below).is_dir():
            return _drives(path / below)
    children = [child for child in sorted(path.iterdir()) if child.is_dir()]
    found = {child.name: child for child in children if _kind(child) is not None}
    if not found:
        found = {
            f"{child.name}/{deeper.name}": deeper
            for child in children
            for deeper in sorted(child.iterdir())
            if deeper.is_dir() and _kind(deeper) is not None
        }
    return found


_READERS = {
    "kitti_carla": read_kitti_carla,
    "mulran": read_mulran,
    "kitti_360": read_kitti_360,
    "kitti_raw": read_kitti_raw,
    "kitti_odometry": read_kitti_odometry,
    "learned": read_learned_folder,
}
_SCAN_FOLDERS = {
    "kitti_carla": "generated/frames",
    "mulran": "Ouster",
    "kitti_360": "velodyne_points/data",
    "kitti_raw": "velodyne_points/data",
    "kitti_odometry": "velodyne",
    "plain_data": "data",
}


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
    if scan_files(path):
        return "learned" if scan_files(path)[0].suffix.lower() == ".npz" else "plain"
    if scan_files(path / "data"):
        return "plain_data"
    return None


def _read(path: Path, poses: Path | None) -> Drive3D:
    """The drive in a folder; a given pose file replaces that of the data set."""
    kind = _kind(path) or "plain"
    if poses is None and kind in _READERS:
        return _READERS[kind](path)
    drive = read_plain_folder(path / _SCAN_FOLDERS.get(kind, ""), poses=poses)
    return drive._replace(name=path.resolve().name)
