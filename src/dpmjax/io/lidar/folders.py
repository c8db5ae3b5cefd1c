"""Drives of 3-D lidar outside of the KITTI family: MulRan, folders of learned data, and plain folders of scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.errors import InputError
from dpmjax.io.lidar.drive import POSE_FILES, Drive3D, one_pose_each, scan_files, times_of
from dpmjax.io.lidar.files import read_npz
from dpmjax.io.poses.lidar_poses import (
    check_poses,
    from_first,
    homogeneous,
    interpolate_poses,
    read_poses,
    read_table,
)

# MulRan's published calibration: the Ouster in the car's frame; rotation about z by 179.6654 degrees.
_MULRAN_OUSTER_XYZ = (1.7042, -0.021, 1.8047)
_MULRAN_OUSTER_RPY_DEG = (0.0001, 0.0003, 179.6654)


def read_mulran(folder: Path) -> Drive3D:
    """MulRan: Ouster/STAMP.bin (nanoseconds) and global_pose.csv of the car at 100 Hz.

    Args:
        folder: the folder that holds Ouster/ or sensor_data/Ouster/.

    Returns:
        The drive; the world is the first lidar frame. Scans half a second or more outside of the poses are left out.

    Raises:
        InputError: broken files.
    """
    from scipy.spatial.transform import Rotation

    home = folder / "Ouster" if (folder / "Ouster").is_dir() else folder / "sensor_data" / "Ouster"
    files = scan_files(home, (".bin",))
    stamps = np.array([int(file.stem) for file in files], np.int64)
    times = (stamps - stamps[0]) * 1e-9 if len(stamps) else np.zeros(0)
    path = folder / "global_pose.csv"
    if not path.is_file() or not len(files):
        return Drive3D(folder.resolve().name, files, None, times)
    rows = read_table(path)
    if rows.shape[1] != 13:
        raise InputError(
            path, f"rows of {rows.shape[1]} numbers", "give MulRan's global_pose.csv: stamp and 12 numbers"
        )
    # In float64 a stamp of 1.5e18 ns is good to 256 ns.
    pose_times = (rows[:, 0] - float(stamps[0])) * 1e-9
    rows, pose_times = rows[np.argsort(pose_times)], np.sort(pose_times)
    T_car_lidar = np.eye(4)
    T_car_lidar[:3, 3] = _MULRAN_OUSTER_XYZ
    T_car_lidar[:3, :3] = Rotation.from_euler("xyz", _MULRAN_OUSTER_RPY_DEG, degrees=True).as_matrix()
    is_new = np.concatenate([[True], np.diff(pose_times) > 0])
    poses = check_poses(homogeneous(rows[is_new, 1:]), path) @ T_car_lidar
    kept = np.flatnonzero((times > pose_times[0] - 0.5) & (times < pose_times[-1] + 0.5))
    if not len(kept):
        raise InputError(path, "no scan lies within the times of the poses", "give scans and poses of one drive")
    found = from_first(interpolate_poses(pose_times[is_new], poses, times[kept]))
    return Drive3D(folder.resolve().name, [files[i] for i in kept], found, times[kept])


def read_learned_folder(folder: Path) -> Drive3D:
    """Folders of N.npz with lidar_pcd, ego_rotation and ego_translation (as DeepPointMap's published data).

    Args:
        folder: the agent's folder that holds the files.

    Returns:
        The drive; broken files get the pose of the file before. Where a readable file has none, it is a plain folder.

    Raises:
        InputError: a pose that is none.
    """
    files = scan_files(folder, (".npz",))
    poses: list[NDArray[np.float64] | None] = []
    for file in files:
        try:
            table = read_npz(file, ("ego_rotation", "ego_translation"))
        except InputError:  # The scan is bad too, and is named when it is read.
            poses.append(poses[-1] if poses else None)
            continue
        if len(table) < 2 or table["ego_rotation"].size != 9 or table["ego_translation"].size != 3:
            return read_plain_folder(folder)
        rows = np.column_stack([table["ego_rotation"].reshape(3, 3), table["ego_translation"].reshape(3)])
        poses.append(homogeneous(rows.astype(np.float64).reshape(1, 12))[0])
    known = next((pose for pose in poses if pose is not None), None)
    if known is None:
        return Drive3D(folder.resolve().name, files, None, None)
    stacked = np.stack([known if pose is None else pose for pose in poses])
    return Drive3D(folder.resolve().name, files, check_poses(stacked, folder), None)


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
    path = poses or next((h / n for h in homes for n in POSE_FILES if (h / n).is_file()), None)
    found = None if path is None else one_pose_each(read_poses(path), files, path)
    times = next((times_of(home / "times.txt", files) for home in homes if (home / "times.txt").is_file()), None)
    return Drive3D(folder.resolve().name, files, found, times)
