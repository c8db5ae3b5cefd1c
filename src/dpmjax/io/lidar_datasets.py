"""Drives of data sets in their published layouts: KITTI odometry, KITTI raw, KITTI-360, KITTI-CARLA, MulRan."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.io.drives import Drive3D, find_pose_file, read_camera_calibration, read_labelled_numbers, scan_files
from dpmjax.io.files import natural_key, read_lines, read_table
from dpmjax.io.poses import check_poses, from_rows, homogeneous, interpolate_poses, read_stamped_poses
from dpmjax.io.references import match_poses, match_reference, match_rows, match_times, numbers_of
from dpmjax.sequences import FloatArray, InputError, require

_CARLA_POSES_PER_FRAME = 100  # KITTI-CARLA writes poses at 1000 Hz and frames at 10 Hz.
_EARTH_RADIUS_M = 6378137.0
# MulRan's published calibration: the Ouster in the car's frame; rotation about z by 179.6654 degrees.
_MULRAN_OUSTER_XYZ = (1.7042, -0.021, 1.8047)
_MULRAN_OUSTER_RPY_DEG = (0.0001, 0.0003, 179.6654)


def read_kitti_odometry(folder: Path) -> Drive3D:
    """Lists a sequence of KITTI odometry.

    Poses in the lidar's frame are searched in poses_lidar.txt. Poses in the left camera's frame are searched in
    poses.txt beside velodyne/ (SemanticKITTI) and in poses/NN.txt two folders up. Last come files of other usual names,
    in the lidar's frame. Rows of TUM are matched by time, others by the numbers of the scans.

    Args:
        folder: the folder that holds velodyne/.

    Returns:
        The drive; poses in the lidar's frame, world = first lidar frame where the first camera pose is the identity.

    Raises:
        InputError: camera poses without `Tr` in calib.txt, or broken files.
    """
    files = scan_files(folder / "velodyne")
    in_lidar, name = folder / "poses_lidar.txt", folder.resolve().name
    in_camera = [folder / "poses.txt", folder.resolve().parents[1] / "poses" / f"{name}.txt"]
    drive = Drive3D(name, files, times=match_times(folder / "times.txt", files))
    path = next((p for p in (in_lidar, *in_camera) if p.is_file()), find_pose_file(folder))
    if path is None or not files:
        return drive
    found = read_stamped_poses(path)
    if path in in_camera:
        T_cam0_lidar = read_camera_calibration(folder / "calib.txt")
        found = found._replace(poses=rigid.inverse(T_cam0_lidar) @ found.poses @ T_cam0_lidar)
    if found.stamps is None:
        return drive._replace(T_world_lidar=match_poses(found.poses, files, path))
    T, notes = match_reference(found, drive.times, len(files), path)
    return drive._replace(T_world_lidar=T, notes=notes)


def read_kitti_raw(folder: Path) -> Drive3D:
    """Lists a drive of KITTI raw: velodyne_points/data, oxts/data, and calib_imu_to_velo.txt in the folder of the day.

    Args:
        folder: DAY_drive_NNNN_sync.

    Returns:
        The drive; the world is the first lidar frame.

    Raises:
        InputError: GPS/IMU records without calibration, or broken files.
    """
    files = scan_files(folder / "velodyne_points" / "data")
    stamps = _read_stamps(folder / "velodyne_points" / "timestamps.txt", files)
    home = folder / "oxts" / "data"
    records = sorted(home.glob("*.txt"), key=lambda record: natural_key(record.name))
    if not records or not files:
        return Drive3D(folder.resolve().name, files, times=stamps)
    candidates = [parent / "calib_imu_to_velo.txt" for parent in (folder, folder.resolve().parent)]
    calibration = next((path for path in candidates if path.is_file()), None)
    if calibration is None:
        advice = "put the calibration of the day (calib_imu_to_velo.txt) into the folder above"
        raise InputError(folder, "GPS/IMU records but no calib_imu_to_velo.txt", advice)
    table = np.vstack([_first_row(record, 6) for record in records])
    T_world_lidar = _poses_from_oxts(table, home) @ rigid.inverse(_read_imu_calibration(calibration))
    # A drive may lack scans that have a record: poses are matched by number.
    poses = match_poses(T_world_lidar, files, home)
    return Drive3D(folder.resolve().name, files, rigid.inverse(poses[0]) @ poses, stamps)


def read_kitti_360(folder: Path) -> Drive3D:
    """Lists a drive of KITTI-360: data_3d_raw/DRIVE/velodyne_points/data, data_poses/DRIVE/poses.txt, calibration/.

    The data set has no poses where the car stands; poses of such scans are interpolated. Scans before the first and
    after the last pose are left out.

    Args:
        folder: the drive's folder in data_3d_raw.

    Returns:
        The drive; the world is the first lidar frame.

    Raises:
        InputError: poses without calibration, or broken files.
    """
    files = scan_files(folder / "velodyne_points" / "data")
    stamps = _read_stamps(folder / "velodyne_points" / "timestamps.txt", files)
    name, root = folder.resolve().name, folder.resolve().parents[1]
    path = root / "data_poses" / name / "poses.txt"
    if not path.is_file():
        return Drive3D(name, files, times=stamps)
    rows = _read_rows(path, "KITTI-360's poses.txt: frame and 12 numbers")
    calibration = root / "calibration" / "calib_cam_to_pose.txt"
    numbers = read_labelled_numbers(calibration).get("image_00", np.zeros(0))
    require(len(numbers) == 12, calibration, "no line 'image_00:' of 12 numbers", "take KITTI-360's calibration folder")
    T_imu_cam0 = from_rows(numbers, calibration)
    calibration = root / "calibration" / "calib_cam_to_velo.txt"
    T_lidar_cam0 = from_rows(_first_row(calibration, 12), calibration)
    T_world_lidar = from_rows(rows[:, 1:], path) @ T_imu_cam0 @ rigid.inverse(T_lidar_cam0)
    frames = np.array(_require_numbers(files), np.float64)
    return _interpolate(Drive3D(name, files, times=stamps), frames, rows[:, 0], T_world_lidar, path)


def read_kitti_carla(folder: Path) -> Drive3D:
    """Lists a drive of KITTI-CARLA: TownNN/generated with frames/frame_NNNN.ply and full_poses_lidar.txt.

    Args:
        folder: TownNN, or its generated/.

    Returns:
        The drive. Frame i has pose 100 i; a row of poses has 12 numbers and a time. Frames are not corrected for the
        motion of the car during a turn.

    Raises:
        InputError: broken files, or fewer poses than frames.
    """
    home = folder / "generated" if (folder / "generated").is_dir() else folder
    files = scan_files(home / "frames", (".ply",))
    name = home.resolve().parent.name if home.resolve().name == "generated" else home.resolve().name
    path = home / "full_poses_lidar.txt"
    if not path.is_file():
        return Drive3D(name, files)
    rows = _read_rows(path, "KITTI-CARLA's full_poses_lidar.txt: 12 numbers and a time")
    endings = [(re.findall(r"\d+", file.stem) or [str(index)])[-1] for index, file in enumerate(files)]
    at = [_CARLA_POSES_PER_FRAME * int(ending[-9:]) for ending in endings]
    require(max(at, default=0) < len(rows), path, f"{len(rows)} rows for {len(files)} frames", "give 100 rows a frame")
    return Drive3D(name, files, from_rows(rows[at, :12], path), rows[at, 12])


def read_mulran(folder: Path) -> Drive3D:
    """Lists a drive of MulRan: Ouster/STAMP.bin (nanoseconds) and global_pose.csv of the car at 100 Hz.

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
    stamps = np.array(_require_numbers(files), np.int64)
    times = (stamps - stamps[:1]).astype(np.float64) * 1e-9
    drive = Drive3D(folder.resolve().name, files, times=times)
    path = folder / "global_pose.csv"
    if not path.is_file() or not len(files):
        return drive
    rows = _read_rows(path, "MulRan's global_pose.csv: stamp and 12 numbers")
    # In float64 a stamp of 1.5e18 ns is good to 256 ns.
    pose_times = (rows[:, 0] - float(stamps[0])) * 1e-9
    R_car_lidar = Rotation.from_euler("xyz", _MULRAN_OUSTER_RPY_DEG, degrees=True).as_matrix()
    T_car_lidar = homogeneous(R_car_lidar, np.array(_MULRAN_OUSTER_XYZ))
    T_world_lidar = from_rows(rows[:, 1:], path) @ T_car_lidar
    return _interpolate(drive, times, pose_times, T_world_lidar, path, slack=0.5)


def _interpolate(
    drive: Drive3D, wanted: FloatArray, times: FloatArray, poses: FloatArray, path: Path, *, slack: float = 0.0
) -> Drive3D:
    """Selects the scans within `slack` of the times of the poses, with interpolated poses relative to the first."""
    times, first = np.unique(times, return_index=True)
    kept = np.flatnonzero((wanted >= times[0] - slack) & (wanted <= times[-1] + slack))
    require(len(kept) > 0, path, "no scan lies within the times of the poses", "give scans and poses of one drive")
    found = interpolate_poses(times, poses[first], wanted[kept])
    stamps = None if drive.times is None else drive.times[kept]
    # In the frame of the first, without the 1e6 m of national grids.
    return Drive3D(drive.name, [drive.files[i] for i in kept], rigid.inverse(found[0]) @ found, stamps)


def _require_numbers(files: list[Path]) -> list[int]:
    numbers = numbers_of(files)
    if numbers is None:
        raise InputError(files[0].parent, "a file name that is no number", "keep the names of the data set")
    return numbers


def _first_row(path: Path, width: int) -> FloatArray:
    """Reads the first numbers (1, width) of a file."""
    rows = read_table(path)
    require(rows.shape[1] >= width, path, f"rows of {rows.shape[1]} numbers", f"give {width} numbers or more")
    return rows[:1, :width]


def _read_rows(path: Path, layout: str) -> FloatArray:
    """Reads the finite numbers (n, 13) of a pose file."""
    rows = read_table(path)
    is_good = rows.shape[1] == 13 and np.isfinite(rows).all()
    require(is_good, path, f"rows of {rows.shape[1]} numbers, or some not finite", f"give {layout}")
    return rows


def _read_stamps(path: Path, files: list[Path]) -> FloatArray | None:
    """Reads KITTI raw's timestamps.txt (2011-09-26 13:02:25.951199337), s from the first; None if it does not fit."""
    try:
        lines = [line.strip() for line in read_lines(path) if line.strip()]
        if not all(re.fullmatch(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?", line) for line in lines):
            return None
        stamps = np.array([line.replace(" ", "T") for line in lines], "datetime64[ns]")
    except ValueError:
        return None
    matched = match_rows(stamps, files)
    return None if matched is None or not len(matched) else (matched - matched[0]).astype(np.float64) * 1e-9


def _read_imu_calibration(path: Path) -> FloatArray:
    """Reads a matrix (4, 4) from KITTI raw's `R:` and `T:` lines."""
    entries = read_labelled_numbers(path)
    turn, shift = entries.get("R", np.zeros(0)), entries.get("T", np.zeros(0))
    is_good = len(turn) == 9 and len(shift) == 3
    require(is_good, path, "no lines 'R:' of 9 and 'T:' of 3 numbers", "take KITTI's calibration file")
    return check_poses(homogeneous(turn.reshape(1, 3, 3), shift[None]), path)[0]


def _poses_from_oxts(records: FloatArray, source: Path) -> FloatArray:
    """Converts GPS/IMU records to poses by the Mercator projection (Geiger et al. 2013, section III).

    Args:
        records: (n, 6) latitude, longitude (degrees), altitude (m), roll, pitch, yaw (radians).
        source: source for messages.

    Returns:
        (n, 4, 4) `T_world_imu`, world in metres, x east, y north, z up.

    Raises:
        InputError: records that are not finite, or too near to a pole.
    """
    from scipy.spatial.transform import Rotation

    is_good = np.isfinite(records).all() and (np.abs(records[:, :3]) < (89.0, 361.0, 1e6)).all()
    found = "records that are not finite, or beyond 89 degrees of latitude, 361 of longitude, or 1000 km of height"
    require(is_good, source, found, "copy them again")
    latitude, longitude = np.radians(records[:, 0]), np.radians(records[:, 1])
    scale = np.cos(latitude[0]) * _EARTH_RADIUS_M
    east, north = scale * longitude, scale * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    rotations = Rotation.from_euler("ZYX", records[:, [5, 4, 3]]).as_matrix()
    return homogeneous(rotations, np.column_stack([east, north, records[:, 2]]))
