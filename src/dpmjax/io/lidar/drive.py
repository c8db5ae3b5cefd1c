"""The files of a drive of 3-D scans, in order, with the poses and times that belong to them; plain folders of scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.io.files import load_arrays, natural_key, read_table
from dpmjax.io.lidar.files import SCAN_SUFFIXES
from dpmjax.io.poses import check_poses, read_poses, to_homogeneous
from dpmjax.sequences import FloatArray, InputError

_POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
               "trajectory.npy", "gt_poses.txt", "groundtruth.txt")  # fmt: skip


class Drive3D(NamedTuple):
    """The files of a drive, one a scan in order, with poses and times where there are any.

    Attributes:
        name: for titles.
        files: the scans.
        T_world_lidar: (n, 4, 4), or None.
        times: (n,) s, or None.
    """

    name: str
    files: list[Path]
    T_world_lidar: FloatArray | None
    times: FloatArray | None


def scan_files(folder: Path, suffixes: tuple[str, ...] = SCAN_SUFFIXES) -> list[Path]:
    """Lists the scans of a folder in natural order: the files of the most frequent ending.

    Args:
        folder: where to look, not deeper.
        suffixes: endings of scans.

    Returns:
        The files; none where there is no such folder.
    """
    if not folder.is_dir():
        return []
    found = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file() and f.name[0] != "."]
    found = [f for f in found if f.name not in _POSE_FILES]
    counts = {suffix: sum(f.suffix.lower() == suffix for f in found) for suffix in suffixes}
    kept = max(suffixes, key=lambda suffix: counts[suffix])
    return sorted((f for f in found if f.suffix.lower() == kept), key=lambda f: natural_key(f.name))


def numbers_of(files: Sequence[Path], largest: float = 2.0**62) -> list[int] | None:
    """The numbers that are the names of files.

    Args:
        files: the scans.
        largest: no number may be above this.

    Returns:
        One number a file, or None where a name is no number or too large.
    """
    names = [file.stem for file in files]
    if not all(name.isascii() and name.isdecimal() and len(name) < 20 and int(name) <= largest for name in names):
        return None
    return [int(name) for name in names]


def match_poses(poses: FloatArray, files: list[Path], path: Path) -> FloatArray:
    """The pose of each scan: in order if there are as many, else by the number that is the file's name.

    Args:
        poses: (m, 4, 4).
        files: the scans.
        path: of the poses, for messages.

    Returns:
        (n, 4, 4).

    Raises:
        InputError: another number of poses, and names that are no numbers.
    """
    if len(poses) == len(files):
        return poses
    numbers = numbers_of(files, len(poses) - 1)
    if numbers is None:
        found = f"{len(poses)} poses for {len(files)} scans"
        raise InputError(path, found, "give one pose a scan, in their order")
    return poses[numbers]


def match_times(path: Path, files: list[Path]) -> FloatArray | None:
    """The times of the scans out of times.txt; a file that does not fit is ignored.

    Args:
        path: of times.txt.
        files: the scans.

    Returns:
        (n,) s, or None.
    """
    try:
        times = read_table(path)[:, 0]
    except InputError:
        return None
    if len(times) != len(files):
        numbers = numbers_of(files, len(times) - 1)
        if numbers is None:
            return None
        times = times[numbers]
    return times if np.isfinite(times).all() else None


def from_first(poses: FloatArray) -> FloatArray:
    """Poses in the frame of the first one, without the 1e6 m of national grids.

    Args:
        poses: (n, 4, 4).

    Returns:
        (n, 4, 4), the first the identity.
    """
    return rigid.inverse(poses[0]) @ poses


def read_plain_folder(folder: Path, *, poses: Path | None = None) -> Drive3D:
    """A folder of scans in natural order, with a pose file and times.txt beside or above them.

    Args:
        folder: the scans.
        poses: the pose file in the lidar's frame; None looks for the usual names in the folder and the one above.

    Returns:
        The drive.

    Raises:
        InputError: broken files, or another number of poses than of scans.
    """
    files = scan_files(folder)
    homes = [folder, folder.resolve().parent] if folder.name in ("data", "scans", "lidar", "velodyne") else [folder]
    path = poses or next((h / n for h in homes for n in _POSE_FILES if (h / n).is_file()), None)
    found = None if path is None else match_poses(read_poses(path), files, path)
    times = next((match_times(home / "times.txt", files) for home in homes if (home / "times.txt").is_file()), None)
    return Drive3D(folder.resolve().name, files, found, times)


def read_learned_folder(folder: Path) -> Drive3D:
    """Folders of N.npz with lidar_pcd, ego_rotation and ego_translation (as DeepPointMap's published data).

    Args:
        folder: the agent's folder that holds the files.

    Returns:
        The drive; broken files get the pose of the file before. Where a readable file has no pose, it is a plain
        folder.

    Raises:
        InputError: a pose that is no rigid motion.
    """
    files = scan_files(folder, (".npz",))
    poses: list[FloatArray | None] = []
    for file in files:
        try:
            table = load_arrays(file, ("ego_rotation", "ego_translation"))
        except InputError:  # The scan is bad too, and is named when it is read.
            poses.append(poses[-1] if poses else None)
            continue
        parts = [table.get(key, np.zeros(0)) for key in ("ego_rotation", "ego_translation")]
        if [part.size for part in parts] != [9, 3] or any(part.dtype.kind not in "fiu" for part in parts):
            return read_plain_folder(folder)
        rows = np.column_stack([parts[0].reshape(3, 3), parts[1].reshape(3)])
        poses.append(to_homogeneous(rows.astype(np.float64).reshape(1, 12))[0])
    known = next((pose for pose in poses if pose is not None), None)
    if known is None:
        return Drive3D(folder.resolve().name, files, None, None)
    stacked = np.stack([known if pose is None else pose for pose in poses])
    return Drive3D(folder.resolve().name, files, check_poses(stacked, folder), None)
