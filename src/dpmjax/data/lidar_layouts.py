"""The public data sets of 3-D lidar, as they lie on disk after unpacking: one function for each layout.

Each takes the folder of one drive and returns its scans and, where the data set has them, poses in the lidar's frame.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.data import lidar_poses
from dpmjax.data.errors import InputError
from dpmjax.data.files import natural_key
from dpmjax.data.lidar_files import SCAN_SUFFIXES
from dpmjax.data.lidar_poses import (
    check_poses,
    from_first,
    homogeneous,
    interpolate_poses,
    read_kitti_calibration,
    read_poses,
    read_rigid_calibration,
    read_table,
    rigid_inverse,
)

# MulRan's published calibration: the Ouster in the car's frame; rotation about z by 179.6654 degrees.
_MULRAN_OUSTER_XYZ = (1.7042, -0.021, 1.8047)
_MULRAN_OUSTER_RPY_DEG = (0.0001, 0.0003, 179.6654)
_CARLA_POSES_PER_FRAME = 100  # KITTI-CARLA writes poses at 1000 Hz and frames at 10 Hz.
_POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
               "trajectory.npy", "gt_poses.txt", "groundtruth.txt")  # fmt: skip
_IN_LIDAR_FRAME = re.compile("lidar|velo")


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
    T_world_lidar: NDArray[np.float64] | None
    times: NDArray[np.float64] | None


def scan_files(folder: Path, suffixes: tuple[str, ...] = SCAN_SUFFIXES) -> list[Path]:
    """The scans of a folder in natural order: those of the most frequent ending, for other clouds may lie about.

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
        poses = lidar_poses.lidar_poses_from_camera(read_poses(path), T_cam0_lidar)
    return Drive3D(name, files, _one_each(poses, files, path), _times(folder / "times.txt", files))


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
        T_world_lidar = lidar_poses.poses_from_oxts(table) @ rigid_inverse(T_lidar_imu)
        # A drive may lack scans that have a record: they go by their numbers.
        poses = _one_each(check_poses(T_world_lidar, folder / "oxts"), files, folder / "oxts" / "data")
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
    poses = check_poses(homogeneous(rows[:, 1:]), path) @ T_imu_cam0 @ rigid_inverse(T_lidar_cam0)
    numbers = np.array([int(file.stem) for file in files], np.float64)
    kept = np.flatnonzero((numbers >= rows[0, 0]) & (numbers <= rows[-1, 0]))
    if not len(kept):
        raise InputError(path, "no scan has a pose", "give scans and poses of one drive")
    found = from_first(interpolate_poses(rows[:, 0], poses, numbers[kept]))
    return Drive3D(name, [files[i] for i in kept], found, None if stamps is None else stamps[kept])


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
            with np.load(file, allow_pickle=False) as table:
                turn, shift = table["ego_rotation"], table["ego_translation"]
            rows = np.column_stack([turn.reshape(3, 3), shift.reshape(3)]).astype(np.float64)
            poses.append(homogeneous(rows.reshape(1, 12))[0])
        except KeyError:
            return read_plain_folder(folder)
        except (OSError, ValueError, EOFError):  # The scan is bad too, and is named when it is read.
            poses.append(poses[-1] if poses else None)
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
    path = poses or next((h / n for h in homes for n in _POSE_FILES if (h / n).is_file()), None)
    found = None if path is None else _one_each(read_poses(path), files, path)
    times = next((_times(home / "times.txt", files) for home in homes if (home / "times.txt").is_file()), None)
    return Drive3D(folder.resolve().name, files, found, times)


def _one_each(poses: NDArray[np.float64] | None, files: list[Path], path: Path | None) -> NDArray[np.float64] | None:
    """The pose of each scan: in order if there are as many, else by the number that is the file's name."""
    if poses is None or len(poses) == len(files):
        return poses
    if all(file.stem.isdecimal() and int(file.stem) < len(poses) for file in files):
        return poses[[int(file.stem) for file in files]]
    raise InputError(
        path or "poses", f"{len(poses)} poses for {len(files)} scans", "give one pose a scan, in their order"
    )


def _times(path: Path, files: list[Path]) -> NDArray[np.float64] | None:
    """times.txt, if there is one that fits; a bad one is no reason to refuse the scans."""
    try:
        times = read_table(path)[:, 0]
    except InputError:
        return None
    if len(times) == len(files):
        return times
    numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
    fits = len(numbers) == len(files) and max(numbers, default=0) < len(times)
    return times[numbers] if fits else None


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
