"""Drives of 3-D scans in files: plain folders, and a table of data sets in their published layouts."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.io.files import load_arrays, natural_key, read_lines, read_table, refusing
from dpmjax.io.lidar_file import columns_of_drive, read_point_times, read_timed_cloud
from dpmjax.io.poses import StampedPoses, check_poses, from_rows, interpolate_poses, read_stamped_poses
from dpmjax.io.references import camera_note, match_reference, match_rows, matching_note, scan_times
from dpmjax.io.scan_names import POSE_FILES, folder_note, last_numbers, scan_files
from dpmjax.sequences import FloatArray, InputError, LidarSequence, Note, homogeneous, require

DRIVES = (
    "a KITTI sequence (velodyne/, calib.txt), a KITTI raw or KITTI-360 drive (velodyne_points/data), a MulRan folder "
    "(Ouster/), a KITTI-CARLA town (generated/frames), a folder of .bin .npy .npz .pcd .ply .las .laz scans, or a bag "
    "of ROS (.bag, .mcap, or a folder with metadata.yaml)"
)
_CARLA_POSES_PER_FRAME = 100  # KITTI-CARLA writes poses at 1000 Hz and frames at 10 Hz.


class SideData(NamedTuple):
    """Poses and times of the scans of a drive, where there are any.

    Attributes:
        T_world_lidar: (n, 4, 4), NaN for scans without a pose; or None.
        times: (n,) s, or None.
        notes: decisions about the files, and doubts.
    """

    T_world_lidar: FloatArray | None = None
    times: FloatArray | None = None
    notes: tuple[Note, ...] = ()


def find_pose_file(*homes: Path) -> Path | None:
    """Returns the first file of reference poses in these folders by the usual names; None where there is none."""
    return next((home / name for home in homes for name in POSE_FILES if (home / name).is_file()), None)


def read_plain_drive(
    folder: Path, files: list[Path], poses: Path | None = None, in_camera: Sequence[Path] = ()
) -> SideData:
    """Reads a pose file, and times.txt, beside or above the scans.

    Args:
        folder: folder of the drive; its scans may lie in a folder of it.
        files: the scans.
        poses: the pose file; None looks for the usual names in the folders. Poses that move as those of a camera come
            into the lidar's frame where a calib.txt with `Tr` lies beside.
        in_camera: KITTI's places of poses of its left camera, after poses_lidar.txt. They need `Tr` in calib.txt, and
            rows without times are matched by the numbers of the scans.

    Returns:
        Poses and times.

    Raises:
        InputError: broken files, or poses that match the scans neither by time nor by number.
    """
    scans = files[0].parent
    is_below = scans.name in ("data", "scans", "lidar", "velodyne")
    homes = [scans, scans.resolve().parent] if is_below else [scans]
    in_lidar = [home / "poses_lidar.txt" for home in homes]
    path = poses or next((file for file in (*in_lidar, *in_camera) if file.is_file()), find_pose_file(*homes))
    times, notes = scan_times(homes, files)
    if path is None:
        return SideData(None, times, notes)
    found, calibration = read_stamped_poses(path), folder / "calib.txt"
    if path in in_camera and found.stamps is None:
        found = found._replace(poses=match_rows(found.poses, files, path))
    T, pose_notes = match_reference(found, times, len(files), path)
    if path not in in_camera:
        calibration = next((home / "calib.txt" for home in homes if (home / "calib.txt").is_file()), calibration)
    if path in in_camera or (calibration.is_file() and camera_note(T, path) is not None):
        advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
        names = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
        T_cam0_lidar = from_rows(_read_labelled(calibration, names, 12, advice), calibration)[0]
        T = np.asarray(rigid.inverse(T_cam0_lidar) @ T @ T_cam0_lidar)
    return SideData(T, times, (*notes, *pose_notes))


def _read_learned(folder: Path, files: list[Path]) -> SideData:
    """Reads the poses in N.npz: lidar_pcd, ego_rotation, ego_translation (DeepPointMap's published data).

    Broken files have no pose. Where a readable file has none, it is a plain folder.

    Returns:
        Poses, times and notes; none where the files are missing.
    """
    T, keys = np.full((len(files), 4, 4), np.nan), ("ego_rotation", "ego_translation")
    for index, file in enumerate(files):
        try:
            table = load_arrays(file, keys)
        except InputError:  # The scan is damaged, too, and a warning names it when it is read.
            continue
        parts = [table.get(key, np.zeros(0)) for key in keys]
        if [part.size for part in parts] != [9, 3] or any(part.dtype.kind not in "fiu" for part in parts):
            return read_plain_drive(folder, files)
        pose = homogeneous(parts[0].astype(np.float64).reshape(3, 3), parts[1].astype(np.float64).ravel())
        T[index] = check_poses(pose[None], file)[0]
    return SideData(T if np.isfinite(T).any() else None)


def _read_kitti(folder: Path, files: list[Path]) -> SideData:
    """Reads poses and times of KITTI odometry.

    Poses of the left camera are searched in poses.txt beside velodyne/ (SemanticKITTI) and in poses/NN.txt two folders
    up: of the folder as it was given, because it may be a link, and the poses lie beside the link.

    Returns:
        Poses, times and notes; none where the files are missing.
    """
    given = Path(os.path.abspath(folder))
    above = given.parent.parent / "poses" / f"{given.name}.txt"
    return read_plain_drive(folder, files, in_camera=(folder / "poses.txt", above))


def _read_kitti_raw(folder: Path, files: list[Path]) -> SideData:
    """Reads poses and times of KITTI raw, or of KITTI-360 below data_3d_raw/; the world is the first lidar frame."""
    times = _read_dates(folder / "velodyne_points" / "timestamps.txt", files)
    given, home = Path(os.path.abspath(folder)), folder / "oxts" / "data"
    if given.parent.name == "data_3d_raw":
        return _read_kitti_360(given, files, times)
    records = sorted(home.glob("*.txt"), key=lambda record: natural_key(record.name))
    if not records:
        return SideData(None, times)
    day = next((up for up in (folder, folder.resolve().parent) if (up / "calib_imu_to_velo.txt").is_file()), folder)
    path, advice = day / "calib_imu_to_velo.txt", "put the calibration of the day into the folder above"
    turn, shift = _read_labelled(path, ("R",), 9, advice), _read_labelled(path, ("T",), 3, advice)
    T_lidar_imu = check_poses(homogeneous(turn.reshape(1, 3, 3), shift[None]), path)[0]
    with refusing(home, "a record without six numbers ({error})", "copy them again", (ValueError,)):
        table = np.vstack([read_table(record)[:1, :6] for record in records]).reshape(-1, 6)
    # A drive may lack scans that have a record: poses are matched by number.
    poses = match_rows(_poses_from_oxts(table, home) @ rigid.inverse(T_lidar_imu), files, home)
    return SideData(rigid.inverse(poses[0]) @ poses, times)


def _read_kitti_360(folder: Path, files: list[Path], times: FloatArray | None) -> SideData:
    """Reads the poses of KITTI-360: data_poses/DRIVE/poses.txt and calibration/ beside data_3d_raw/.

    The data set has no poses where the car stands; poses of such scans are interpolated. Scans before the first and
    after the last pose have no reference.

    Returns:
        Poses, times and notes; none where the files are missing.
    """
    root = folder.parent.parent
    path, calibration = root / "data_poses" / folder.name / "poses.txt", root / "calibration"
    if not path.is_file():
        return SideData(None, times)
    rows = read_table(path, 13)  # frame and pose
    cameras, lidar = calibration / "calib_cam_to_pose.txt", calibration / "calib_cam_to_velo.txt"
    T_imu_cam0 = from_rows(_read_labelled(cameras, ("image_00",), 12, "take KITTI-360's calibration folder"), cameras)
    T_lidar_cam0 = from_rows(read_table(lidar, 12)[:1], lidar)
    T_world_lidar = from_rows(rows[:, 1:], path) @ T_imu_cam0 @ rigid.inverse(T_lidar_cam0)
    numbers = np.array(last_numbers(files), np.float64)
    return _interpolate(numbers, times, StampedPoses(T_world_lidar, rows[:, 0]), path, slack=0.0)


def _read_carla(folder: Path, files: list[Path]) -> SideData:
    """Reads poses and times of KITTI-CARLA: TownNN/generated with frames/frame_NNNN.ply and full_poses_lidar.txt.

    Frame i has pose 100 i; a row of poses has 12 numbers and a time. Frames are not corrected for the motion of the car
    during a turn.

    Returns:
        Poses, times and notes; none where the files are missing.
    """
    path = files[0].parent.parent / "full_poses_lidar.txt"
    if not path.is_file():
        return SideData()
    rows = read_table(path, 13)  # pose and time
    at = _CARLA_POSES_PER_FRAME * np.array(last_numbers(files))
    found = f"{len(rows)} rows for {len(at)} frames"
    require(at.max() < len(rows), path, found, f"give {_CARLA_POSES_PER_FRAME} rows a frame")
    return SideData(from_rows(rows[at, :12], path), rows[at, 12])


def _read_mulran(folder: Path, files: list[Path]) -> SideData:
    """Reads poses and times of MulRan: Ouster/STAMP.bin (nanoseconds), and global_pose.csv of the car at 100 Hz.

    The world is the first lidar frame with a pose. Scans half a second or more outside of the poses have no reference.

    Returns:
        Poses, times and notes; none where the files are missing.
    """
    from scipy.spatial.transform import Rotation

    stamps = np.array(last_numbers(files))
    times, path = (stamps - stamps[0]).astype(np.float64) * 1e-9, folder / "global_pose.csv"
    if not path.is_file():
        return SideData(None, times)
    rows = read_table(path, 13)  # stamp and pose
    # In float64 a stamp of 1.5e18 ns is good to 256 ns.
    pose_times = (rows[:, 0] - float(stamps[0])) * 1e-9
    # The published calibration: the Ouster in the car's frame.
    R_car_lidar = Rotation.from_euler("xyz", (0.0001, 0.0003, 179.6654), degrees=True).as_matrix()
    poses = from_rows(rows[:, 1:], path) @ homogeneous(R_car_lidar, np.array((1.7042, -0.021, 1.8047)))
    return _interpolate(times, times, StampedPoses(poses, pose_times), path, slack=0.5)


def _interpolate(
    wanted: FloatArray, times: FloatArray | None, found: StampedPoses, path: Path, slack: float
) -> SideData:
    """Interpolates poses, relative to the first, for the scans within `slack` of the stamps of the poses."""
    stamps, first = np.unique(np.asarray(found.stamps), return_index=True)
    kept = (wanted >= stamps[0] - slack) & (wanted <= stamps[-1] + slack)
    require(kept.any(), path, "no scan lies within the times of the poses", "give scans and poses of one drive")
    T = interpolate_poses(stamps, found.poses[first], wanted)
    # In the frame of the first, without the 1e6 m of national grids.
    T = np.where(kept[:, None, None], rigid.inverse(T[kept.argmax()]) @ T, np.nan)
    return SideData(T, times, (matching_note(path, "time" if slack else "the numbers of the frames", T),))


def _read_labelled(path: Path, names: Sequence[str], count: int, advice: str) -> FloatArray:
    """Reads the first line `name: numbers` of a calibration file with one of these names and so many numbers."""
    lines = (line.partition(":") for line in read_lines(path))
    found = next((words.split() for key, _, words in lines if key.strip() in names and len(words.split()) == count), [])
    require(len(found) > 0, path, f"no line '{names[0]}:' of {count} numbers", advice)
    with refusing(path, f"line '{names[0]}:' ({{error}})", advice, (ValueError,)):
        return np.array(found, np.float64)


def _read_dates(path: Path, files: list[Path]) -> FloatArray | None:
    """Reads KITTI raw's timestamps.txt (2011-09-26 13:02:25.951199337), s from the first; None if it does not fit."""
    try:
        lines = [line.strip().replace(" ", "T") for line in read_lines(path) if line.strip()]
        if not all(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,9})?", line) for line in lines):
            return None
        dates = match_rows(np.array(lines, "datetime64[ns]"), files, path)
    except ValueError:
        return None
    return (dates - dates[0]).astype(np.float64) * 1e-9


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
    # The radius of the Earth, m.
    scale = np.cos(latitude[0]) * 6378137.0
    east, north = scale * longitude, scale * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    rotations = Rotation.from_euler("ZYX", records[:, [5, 4, 3]]).as_matrix()
    return homogeneous(rotations, np.column_stack([east, north, records[:, 2]]))


_Reader = Callable[[Path, list[Path]], SideData]
# Published layouts: by what their folder holds, the folder of the scans, and the reader of poses and times.
_LAYOUTS: dict[str, tuple[str, _Reader]] = {
    "generated/frames": ("generated/frames", _read_carla),
    "full_poses_lidar.txt": ("frames", _read_carla),
    "Ouster": ("Ouster", _read_mulran),
    "sensor_data/Ouster": ("sensor_data/Ouster", _read_mulran),
    "velodyne_points": ("velodyne_points/data", _read_kitti_raw),
    "velodyne": ("velodyne", _read_kitti),
}


def _layout_of(path: Path) -> tuple[str, _Reader]:
    """Returns the layout of a folder: a published one, or scans right in it or in data/."""
    scans = "data" if not scan_files(path) and scan_files(path / "data") else ""
    found = (layout for marker, layout in _LAYOUTS.items() if (path / marker).exists())
    return next(found, (scans, read_plain_drive))


def is_drive(path: Path) -> bool:
    """Returns True for a folder of a known layout, or with scans in it or in data/."""
    is_published = any((path / marker).exists() for marker in _LAYOUTS)
    return is_published or bool(scan_files(path / _layout_of(path)[0]))


def open_folder(path: Path, poses: Path | None, bin_columns: int | None) -> LidarSequence:
    """Opens the drive in a folder.

    Args:
        path: the folder.
        poses: a pose file, which replaces that of the data set; or None.
        bin_columns: number of values of a point in `.bin` files; None: inferred.

    Returns:
        The drive.

    Raises:
        InputError: no scans, broken files, or poses that do not match the scans.
    """
    scans, read = _layout_of(path)
    files = scan_files(path / scans)
    require(len(files) > 0, path, "a folder without scans", f"give {DRIVES}")
    read = _read_learned if scans == "" and files[0].suffix.lower() == ".npz" else read
    T, times, notes = read_plain_drive(path, files, poses) if poses else read(path, files)
    columns, note = columns_of_drive(files, bin_columns)
    notes = tuple(each for each in (folder_note(files[0].parent), *notes, note) if each is not None)
    given, sources = Path(os.path.abspath(path)), tuple(map(str, files))
    name = given.parent.name if given.name == "generated" else given.name
    read_scan, read_times = lambda i: read_timed_cloud(files[i], columns).points, lambda i: read_point_times(files[i])
    return LidarSequence(name, sources, read_scan, T, times, read_times, notes)
