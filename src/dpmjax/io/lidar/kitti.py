"""The KITTI family of 3-D lidar drives as they lie on disk: odometry and SemanticKITTI, raw, KITTI-360, KITTI-CARLA."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.io.errors import InputError
from dpmjax.io.files import natural_key
from dpmjax.io.lidar.drive import Drive3D, one_pose_each, scan_files, times_of
from dpmjax.io.poses.lidar_poses import (
    check_poses,
    from_first,
    homogeneous,
    interpolate_poses,
    lidar_poses_from_camera,
    poses_from_oxts,
    read_kitti_calibration,
    read_poses,
    read_rigid_calibration,
    read_table,
)

_CARLA_POSES_PER_FRAME = 100  # KITTI-CARLA writes poses at 1000 Hz and frames at 10 Hz.


def read_kitti_odometry(folder: Path) -> Drive3D:
    """KITTI odometry, SemanticKITTI, and whatever copies them: velodyne/, calib.txt, times.txt, poses.

    Poses are looked for in poses_lidar.txt (already in the lidar's frame), poses.txt beside velodyne/ (SemanticKITTI's)
    and poses/NN.txt two folders up, both in the left camera's frame.

    Args:
        folder: the folder that holds velodyne/.

    Returns:
        The drive.

    Raises:
        InputError: camera poses without `Tr` in calib.txt, or broken files.
    """
    files = scan_files(folder / "velodyne")
    in_lidar, name = folder / "poses_lidar.txt", folder.resolve().name
    in_camera = [folder / "poses.txt", folder.resolve().parents[1] / "poses" / f"{name}.txt"]
    path = next((p for p in in_camera if p.is_file()), None)
    poses = None
    if in_lidar.is_file():
        path, poses = in_lidar, read_poses(in_lidar)
    elif path is not None:
        T_cam0_lidar = read_kitti_calibration(folder / "calib.txt")
        poses = lidar_poses_from_camera(read_poses(path), T_cam0_lidar)
    return Drive3D(name, files, one_pose_each(poses, files, path), times_of(folder / "times.txt", files))


def read_kitti_raw(folder: Path) -> Drive3D:
    """KITTI raw: velodyne_points/data, oxts/data, and calib_imu_to_velo.txt in the folder of the day.

    Args:
        folder: DAY_drive_NNNN_sync.

    Returns:
        The drive; the world is the first lidar frame.

    Raises:
        InputError: GPS/IMU records without calibration, or broken files.
    """
    files = scan_files(folder / "velodyne_points" / "data")
    records = sorted((folder / "oxts" / "data").glob("*.txt"), key=lambda f: natural_key(f.name))
    poses = None
    if records:
        homes = [folder, folder.resolve().parent]
        calibration = next(
            (h / "calib_imu_to_velo.txt" for h in homes if (h / "calib_imu_to_velo.txt").is_file()), None
        )
        if calibration is None:
            advice = "put the calibration of the day (calib_imu_to_velo.txt) into the folder above"
            raise InputError(folder, "GPS/IMU records but no calib_imu_to_velo.txt", advice)
        T_lidar_imu = read_rigid_calibration(calibration)
        table = np.vstack([read_table(record)[:1, :6] for record in records])
        T_world_lidar = poses_from_oxts(table) @ rigid.inverse(T_lidar_imu)
        # A drive may lack scans that have a record: they go by their numbers.
        poses = one_pose_each(check_poses(T_world_lidar, folder / "oxts"), files, folder / "oxts" / "data")
    stamps = _stamps(folder / "velodyne_points" / "timestamps.txt", files)
    return Drive3D(folder.resolve().name, files, None if poses is None else from_first(poses), stamps)


def read_kitti_360(folder: Path) -> Drive3D:
    """KITTI-360: data_3d_raw/DRIVE/velodyne_points/data, data_poses/DRIVE/poses.txt and calibration/.

    The car has no pose where it stands: such scans are interpolated; scans before the first and after the last pose are
    left out.

    Args:
        folder: the drive's folder in data_3d_raw.

    Returns:
        The drive; the world is the first lidar frame.

    Raises:
        InputError: poses without calibration, or broken files.
    """
    files = scan_files(folder / "velodyne_points" / "data")
    stamps = _stamps(folder / "velodyne_points" / "timestamps.txt", files)
    name, root = folder.resolve().name, folder.resolve().parents[1]
    path = root / "data_poses" / name / "poses.txt"
    if not path.is_file():
        return Drive3D(name, files, None, stamps)
    rows = read_table(path)
    if rows.shape[1] != 13:
        raise InputError(path, f"rows of {rows.shape[1]} numbers", "give KITTI-360's poses.txt: frame and 12 numbers")
    T_imu_cam0 = _kitti_360_camera(root / "calibration" / "calib_cam_to_pose.txt")
    T_lidar_cam0 = homogeneous(read_table(root / "calibration" / "calib_cam_to_velo.txt")[:1, :12])[0]
    poses = check_poses(homogeneous(rows[:, 1:]), path) @ T_imu_cam0 @ rigid.inverse(T_lidar_cam0)
    numbers = np.array([int(file.stem) for file in files], np.float64)
    kept = np.flatnonzero((numbers >= rows[0, 0]) & (numbers <= rows[-1, 0]))
    if not len(kept):
        raise InputError(path, "no scan has a pose", "give scans and poses of one drive")
    found = from_first(interpolate_poses(rows[:, 0], poses, numbers[kept]))
    return Drive3D(name, [files[i] for i in kept], found, None if stamps is None else stamps[kept])


def read_kitti_carla(folder: Path) -> Drive3D:
    """KITTI-CARLA: TownNN/generated with frames/frame_NNNN.ply and full_poses_lidar.txt (12 numbers and a time).

    Args:
        folder: TownNN, or its generated/.

    Returns:
        The drive. Frame i has pose 100 i. Frames keep the motion of the car during a turn.

    Raises:
        InputError: broken files, or fewer poses than frames.
    """
    home = folder / "generated" if (folder / "generated").is_dir() else folder
    files = scan_files(home / "frames", (".ply",))
    name = home.resolve().parent.name if home.resolve().name == "generated" else home.resolve().name
    path = home / "full_poses_lidar.txt"
    if not path.is_file():
        return Drive3D(name, files, None, None)
    rows = read_table(path)
    numbers = [int("".join(re.findall(r"\d+", file.stem)[-1:]) or index) for index, file in enumerate(files)]
    at = np.array(numbers, np.int64) * _CARLA_POSES_PER_FRAME
    if rows.shape[1] != 13 or (len(at) and at.max() >= len(rows)):
        found = f"{len(rows)} rows of {rows.shape[1]} numbers for {len(files)} frames"
        raise InputError(path, found, "give KITTI-CARLA's full_poses_lidar.txt: 100 rows of 13 numbers a frame")
    return Drive3D(name, files, check_poses(homogeneous(rows[at, :12]), path), rows[at, 12])


def _stamps(path: Path, files: list[Path]) -> NDArray[np.float64] | None:
    """KITTI raw's timestamps.txt (2011-09-26 13:02:25.951199337) as seconds from the first."""
    try:
        lines = [line.strip() for line in path.read_text().splitlines() if line.strip()]
        stamps = np.array([line.replace(" ", "T") for line in lines], "datetime64[ns]")
    except (OSError, ValueError):
        return None
    if len(stamps) != len(files):
        numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
        if len(numbers) != len(files) or max(numbers, default=0) >= len(stamps):
            return None
        stamps = stamps[numbers]
    return (stamps - stamps[0]).astype(np.float64) * 1e-9 if len(stamps) else None


def _kitti_360_camera(path: Path) -> NDArray[np.float64]:
    """`T_imu_cam0` out of KITTI-360's calib_cam_to_pose.txt."""
    try:
        lines = path.read_text().splitlines()
        numbers = next(line.partition(":")[2].split() for line in lines if line.startswith("image_00"))
        return check_poses(homogeneous(np.array(numbers, np.float64).reshape(1, 12)), path)[0]
    except (OSError, StopIteration, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "no line 'image_00:' of 12 numbers", "take KITTI-360's calibration folder") from error
