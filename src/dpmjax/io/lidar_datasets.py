"""Drives of 3-D scans in files: plain folders, and data sets in their published layouts."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.io.files import load_arrays, log_notes, natural_key, read_lines, read_table
from dpmjax.io.poses import check_poses, from_rows, interpolate_poses, read_stamped_poses
from dpmjax.io.references import camera_note, match_poses, match_reference, match_times, matching_note, scan_times
from dpmjax.io.scan_names import POSE_FILES, match_rows, numbers_of, scan_files
from dpmjax.sequences import FloatArray, InputError, Note, homogeneous, require

_CARLA_POSES_PER_FRAME = 100  # KITTI-CARLA writes poses at 1000 Hz and frames at 10 Hz.
_EARTH_RADIUS_M = 6378137.0
# MulRan's published calibration: the Ouster in the car's frame; rotation about z by 179.6654 degrees.
_MULRAN_OUSTER_XYZ = (1.7042, -0.021, 1.8047)
_MULRAN_OUSTER_RPY_DEG = (0.0001, 0.0003, 179.6654)
_MULRAN_SLACK_S = 0.5


class Drive3D(NamedTuple):
    """The files of a drive, one a scan in order, with poses and times where there are any.

    Attributes:
        name: name for titles.
        files: the scans.
        T_world_lidar: (n, 4, 4), NaN for scans without a pose; or None.
        times: (n,) s, or None.
        notes: decisions about the files, and doubts.
    """

    name: str
    files: list[Path]
    T_world_lidar: FloatArray | None = None
    times: FloatArray | None = None
    notes: tuple[Note, ...] = ()


def find_pose_file(*homes: Path) -> Path | None:
    """Returns the first file of reference poses in these folders by the usual names; None where there is none."""
    return next((home / name for home in homes for name in POSE_FILES if (home / name).is_file()), None)


def read_plain_folder(folder: Path, *, poses: Path | None = None) -> Drive3D:
    """Lists a folder of scans in the order of their numbers, with a pose file and times.txt beside or above them.

    Args:
        folder: the scans.
        poses: the pose file; None looks for the usual names in the folder and the one above. Poses that move as those
            of a camera come into the lidar's frame where a calib.txt with `Tr` lies beside.

    Returns:
        The drive.

    Raises:
        InputError: broken files, or poses that match the scans neither by time nor by number.
    """
    files = scan_files(folder)
    homes = [folder, folder.resolve().parent] if folder.name in ("data", "scans", "lidar", "velodyne") else [folder]
    path = poses or find_pose_file(*homes)
    times, notes = scan_times(homes, files)
    drive = Drive3D(folder.resolve().name, files, None, times, notes)
    if path is None:
        return drive
    try:
        T, pose_notes = match_reference(read_stamped_poses(path), times, len(files), path)
    except InputError:
        log_notes(notes)  # times.txt may be the reason
        raise
    calibration = next((home / "calib.txt" for home in homes if (home / "calib.txt").is_file()), None)
    if calibration is not None and camera_note(T, path) is not None:
        T_cam0_lidar = _read_camera_calibration(calibration)
        T = rigid.inverse(T_cam0_lidar) @ T @ T_cam0_lidar
    return drive._replace(T_world_lidar=T, notes=(*drive.notes, *pose_notes))


def read_learned_folder(folder: Path) -> Drive3D:
    """Lists a folder of N.npz with lidar_pcd, ego_rotation and ego_translation (DeepPointMap's published data).

    Broken files get the pose of the file before. Where a readable file has no pose, it is a plain folder.

    Returns:
        The drive.
    """
    files = scan_files(folder, (".npz",))
    keys = ("ego_rotation", "ego_translation")
    poses: list[FloatArray | None] = []
    for file in files:
        try:
            table = load_arrays(file, keys)
        except InputError:  # The scan is damaged, too, and a warning names it when it is read.
            poses.append(poses[-1] if poses else None)
            continue
        parts = [table.get(key, np.zeros(0)) for key in keys]
        if [part.size for part in parts] != [9, 3] or any(part.dtype.kind not in "fiu" for part in parts):
            return read_plain_folder(folder)
        poses.append(homogeneous(*(part.astype(np.float64).reshape(3, -1).squeeze() for part in parts)))
    drive = Drive3D(folder.resolve().name, files)
    known = next((pose for pose in poses if pose is not None), None)
    if known is None:
        return drive
    stacked = np.stack([known if pose is None else pose for pose in poses])
    return drive._replace(T_world_lidar=check_poses(stacked, folder))


def read_kitti_odometry(folder: Path, scans: Path) -> Drive3D:
    """Lists a sequence of KITTI odometry: velodyne/, times.txt, and poses.

    Poses in the lidar's frame are searched in poses_lidar.txt. Poses in the left camera's frame are searched in
    poses.txt beside velodyne/ (SemanticKITTI) and in poses/NN.txt two folders up; they need `Tr` in calib.txt. Last
    come files of other usual names, in the lidar's frame. Rows of TUM are matched by time, others by the numbers of the
    scans.

    Returns:
        The drive.
    """
    files = scan_files(scans)
    # As it was given: the folder may be a link, and the poses lie beside the link.
    in_lidar, given = folder / "poses_lidar.txt", Path(os.path.abspath(folder))
    name = given.name
    in_camera = [folder / "poses.txt", given.parent.parent / "poses" / f"{name}.txt"]
    drive = Drive3D(name, files, times=match_times(folder / "times.txt", files))
    path = next((p for p in (in_lidar, *in_camera) if p.is_file()), find_pose_file(folder))
    if path is None or not files:
        return drive
    found = read_stamped_poses(path)
    if path in in_camera:
        T_cam0_lidar = _read_camera_calibration(folder / "calib.txt")
        found = found._replace(poses=rigid.inverse(T_cam0_lidar) @ found.poses @ T_cam0_lidar)
    if found.stamps is None:
        return drive._replace(T_world_lidar=match_poses(found.poses, files, path))
    T, notes = match_reference(found, drive.times, len(files), path)
    return drive._replace(T_world_lidar=T, notes=notes)


def read_velodyne_points(folder: Path, scans: Path) -> Drive3D:
    """Lists a drive of KITTI raw, or of KITTI-360 below data_3d_raw/; the world is the first lidar frame."""
    files = scan_files(scans)
    given = Path(os.path.abspath(folder))
    drive = Drive3D(given.name, files, times=_read_stamps(scans.parent / "timestamps.txt", files))
    is_kitti_360 = given.parent.name == "data_3d_raw"
    return _with_kitti_360_poses(drive, folder) if is_kitti_360 else _with_oxts_poses(drive, folder)


def _with_oxts_poses(drive: Drive3D, folder: Path) -> Drive3D:
    """Adds the poses of KITTI raw: oxts/data, and calib_imu_to_velo.txt in the folder of the day."""
    home = folder / "oxts" / "data"
    records = sorted(home.glob("*.txt"), key=lambda record: natural_key(record.name))
    if not records or not drive.files:
        return drive
    candidates = [parent / "calib_imu_to_velo.txt" for parent in (folder, folder.resolve().parent)]
    calibration = next((path for path in candidates if path.is_file()), None)
    if calibration is None:
        advice = "put the calibration of the day (calib_imu_to_velo.txt) into the folder above"
        raise InputError(folder, "GPS/IMU records but no calib_imu_to_velo.txt", advice)
    entries = read_labelled_numbers(calibration)
    turn, shift = entries.get("R", np.zeros(0)), entries.get("T", np.zeros(0))
    is_good = len(turn) == 9 and len(shift) == 3
    require(is_good, calibration, "no lines 'R:' of 9 and 'T:' of 3 numbers", "take KITTI's calibration file")
    T_lidar_imu = check_poses(homogeneous(turn.reshape(1, 3, 3), shift[None]), calibration)[0]
    T_world_imu = _poses_from_oxts(np.vstack([_first_row(record, 6) for record in records]), home)
    # A drive may lack scans that have a record: poses are matched by number.
    poses = match_poses(T_world_imu @ rigid.inverse(T_lidar_imu), drive.files, home)
    return drive._replace(T_world_lidar=rigid.inverse(poses[0]) @ poses)


def _with_kitti_360_poses(drive: Drive3D, folder: Path) -> Drive3D:
    """Adds the poses of KITTI-360: data_poses/DRIVE/poses.txt and calibration/ beside data_3d_raw/.

    The data set has no poses where the car stands; poses of such scans are interpolated. Scans before the first and
    after the last pose have no reference.

    Returns:
        The drive.
    """
    root = Path(os.path.abspath(folder)).parent.parent
    path = root / "data_poses" / drive.name / "poses.txt"
    if not path.is_file():
        return drive
    rows = _read_rows(path, "KITTI-360's poses.txt: frame and 12 numbers")
    calibration = root / "calibration" / "calib_cam_to_pose.txt"
    numbers = read_labelled_numbers(calibration).get("image_00", np.zeros(0))
    require(len(numbers) == 12, calibration, "no line 'image_00:' of 12 numbers", "take KITTI-360's calibration folder")
    T_imu_cam0 = from_rows(numbers, calibration)
    calibration = root / "calibration" / "calib_cam_to_velo.txt"
    T_lidar_cam0 = from_rows(_first_row(calibration, 12), calibration)
    T_world_lidar = from_rows(rows[:, 1:], path) @ T_imu_cam0 @ rigid.inverse(T_lidar_cam0)
    frames = np.array(_require_numbers(drive.files), np.float64)
    return _interpolate(drive, frames, (rows[:, 0], T_world_lidar), path, how="the numbers of the frames")


def read_kitti_carla(_folder: Path, scans: Path) -> Drive3D:
    """Lists a drive of KITTI-CARLA: TownNN/generated with frames/frame_NNNN.ply and full_poses_lidar.txt.

    Frame i has pose 100 i; a row of poses has 12 numbers and a time. Frames are not corrected for the motion of the car
    during a turn.

    Returns:
        The drive.
    """
    files, home = scan_files(scans, (".ply",)), scans.parent.resolve()
    name = home.parent.name if home.name == "generated" else home.name
    path = scans.parent / "full_poses_lidar.txt"
    if not path.is_file():
        return Drive3D(name, files)
    rows = _read_rows(path, "KITTI-CARLA's full_poses_lidar.txt: 12 numbers and a time")
    endings = [(re.findall(r"\d+", file.stem) or [str(index)])[-1] for index, file in enumerate(files)]
    at = [_CARLA_POSES_PER_FRAME * int(ending[-9:]) for ending in endings]
    require(max(at, default=0) < len(rows), path, f"{len(rows)} rows for {len(files)} frames", "give 100 rows a frame")
    return Drive3D(name, files, from_rows(rows[at, :12], path), rows[at, 12])


def read_mulran(folder: Path, scans: Path) -> Drive3D:
    """Lists a drive of MulRan: Ouster/STAMP.bin (nanoseconds) and global_pose.csv of the car at 100 Hz.

    The world is the first lidar frame with a pose. Scans half a second or more outside of the poses have no reference.

    Returns:
        The drive.
    """
    from scipy.spatial.transform import Rotation

    files = scan_files(scans, (".bin",))
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
    poses = from_rows(rows[:, 1:], path) @ T_car_lidar
    return _interpolate(drive, times, (pose_times, poses), path, how="time", slack=_MULRAN_SLACK_S)


def _interpolate(
    drive: Drive3D,
    wanted: FloatArray,
    stamped: tuple[FloatArray, FloatArray],
    path: Path,
    *,
    how: str,
    slack: float = 0.0,
) -> Drive3D:
    """Adds interpolated poses, relative to the first, to the scans within `slack` of the times of the poses."""
    times, first = np.unique(stamped[0], return_index=True)
    kept = np.flatnonzero((wanted >= times[0] - slack) & (wanted <= times[-1] + slack))
    require(len(kept) > 0, path, "no scan lies within the times of the poses", "give scans and poses of one drive")
    found = interpolate_poses(times, stamped[1][first], wanted[kept])
    T_world_lidar = np.full((len(wanted), 4, 4), np.nan)
    # In the frame of the first, without the 1e6 m of national grids.
    T_world_lidar[kept] = rigid.inverse(found[0]) @ found
    return drive._replace(T_world_lidar=T_world_lidar, notes=(*drive.notes, matching_note(path, how, T_world_lidar)))


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


def read_labelled_numbers(path: Path) -> dict[str, FloatArray]:
    """Reads the lines `key: numbers` of a calibration file; other lines are ignored."""
    found = {}
    for key, _, numbers in (line.partition(":") for line in read_lines(path)):
        try:
            found[key.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue
    return found


def _read_camera_calibration(path: Path) -> FloatArray:
    """Reads `Tr`, the lidar's frame to the left grey camera's, `T_cam0_lidar` (4, 4), out of KITTI's calib.txt."""
    entries = read_labelled_numbers(path)
    rows = next((entries[k] for k in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam") if len(entries.get(k, ())) == 12), None)
    if rows is None:
        advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
        raise InputError(path, "no line 'Tr:' of 12 numbers", advice)
    return np.asarray(from_rows(rows, path)[0])


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


# What a folder of a layout holds, the reader of the folder and of its scans, and the place of the scans.
LAYOUTS: tuple[tuple[str, Callable[[Path, Path], Drive3D], str], ...] = (
    ("generated/frames", read_kitti_carla, "generated/frames"),
    ("full_poses_lidar.txt", read_kitti_carla, "frames"),
    ("Ouster", read_mulran, "Ouster"),
    ("sensor_data/Ouster", read_mulran, "sensor_data/Ouster"),
    ("velodyne_points", read_velodyne_points, "velodyne_points/data"),
    ("velodyne", read_kitti_odometry, "velodyne"),
)
