"""Files of a drive of 3-D scans with poses and times, plain folders, and iteration over scans."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.io.files import load_arrays, read_lines, read_table
from dpmjax.io.poses import check_poses, from_rows, homogeneous, read_poses, read_stamped_poses
from dpmjax.io.references import camera_note, match_reference, scan_times
from dpmjax.io.scan_names import sort_scans, strays_among
from dpmjax.sequences import FloatArray, InputError, LidarSequence, Note, require

_log = logging.getLogger(__name__)
SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply", ".las", ".laz")
POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
              "trajectory.npy", "gt_poses.txt", "groundtruth.txt")  # fmt: skip
"""Usual names of files of reference poses in the lidar's frame."""
# Axes of a camera that looks along x of the lidar: x right, y down, z forward.
_T_CAM0_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


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


def scan_files(folder: Path, suffixes: tuple[str, ...] = SCAN_SUFFIXES) -> list[Path]:
    """Lists the scans of a folder in the order of their numbers: the files of the most frequent ending.

    Args:
        folder: searched folder, without its subfolders.
        suffixes: endings of scans.

    Returns:
        The files, without those that `stray_note` names; none where there is no such folder.
    """
    most = _of_one_ending(folder, suffixes)
    strays = strays_among(most)
    return sort_scans([file for file in most if file not in strays])


def stray_note(folder: Path) -> Note | None:
    """Lists the files of a folder that have the ending of scans but are no scans, such as map.pcd.

    Args:
        folder: folder of the scans.

    Returns:
        The note, or None.
    """
    strays = strays_among(_of_one_ending(folder, SCAN_SUFFIXES))
    if not strays:
        return None
    text = f"{folder}: {strays[0].name} is no scan, as its name has no number; {len(strays)} such left out"
    return Note(text, is_doubt=True)


def _of_one_ending(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Returns the files of the most frequent ending, unsorted."""
    if not folder.is_dir():
        return []
    files = [f for f in folder.iterdir() if f.is_file() and f.name[0] != "." and f.name not in POSE_FILES]
    return max(([f for f in files if f.suffix.lower() == suffix] for suffix in suffixes), key=len)


def find_pose_file(*homes: Path) -> Path | None:
    """Finds a file of reference poses by the usual names.

    Args:
        *homes: searched folders.

    Returns:
        The first one; None where there is none.
    """
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
    T, pose_notes = match_reference(read_stamped_poses(path), times, len(files), path)
    calibration = next((home / "calib.txt" for home in homes if (home / "calib.txt").is_file()), None)
    if calibration is not None and camera_note(T, path) is not None:
        T_cam0_lidar = read_camera_calibration(calibration)
        T = rigid.inverse(T_cam0_lidar) @ T @ T_cam0_lidar
    return drive._replace(T_world_lidar=T, notes=(*drive.notes, *pose_notes))


def read_learned_folder(folder: Path) -> Drive3D:
    """Lists a folder of N.npz with lidar_pcd, ego_rotation and ego_translation (DeepPointMap's published data).

    Args:
        folder: the agent's folder that holds the files.

    Returns:
        The drive; broken files get the pose of the file before. Where a readable file has no pose, it is a plain
        folder.

    Raises:
        InputError: a pose that is no rigid motion.
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
    known = next((pose for pose in poses if pose is not None), None)
    if known is None:
        return Drive3D(folder.resolve().name, files)
    stacked = np.stack([known if pose is None else pose for pose in poses])
    return Drive3D(folder.resolve().name, files, check_poses(stacked, folder))


def read_lidar_trajectory(path: str | Path) -> FloatArray:
    """Reads the poses of a drive; those of a camera, which moves along its z axis, are turned into the lidar's axes.

    Args:
        path: rows of TUM or KITTI, metres.

    Returns:
        (n, 4, 4) poses, x forward, y left, z up.

    Raises:
        InputError: no such file, planar poses, or another layout.
    """
    path = Path(path)
    advice = "give poses in space: TUM (stamp tx ty tz qx qy qz qw) or KITTI (12 numbers a row)"
    require(read_table(path).shape[1] > 3, path, "rows of 3 columns", advice)
    T = read_poses(path)
    return T if camera_note(T, path) is None else rigid.inverse(_T_CAM0_LIDAR) @ T @ _T_CAM0_LIDAR


class IndexedScan(NamedTuple):
    """A scan and its number in the sequence.

    Attributes:
        number: number of the scan in the sequence.
        points: (n, 3) float32, lidar frame, m.
    """

    number: int
    points: NDArray[np.float32]


def iterate_scans(sequence: LidarSequence) -> Iterator[IndexedScan]:
    """Reads scan after scan and leaves out damaged ones; a warning names them at the end.

    Args:
        sequence: the scans.

    Yields:
        The readable scans with their numbers.

    Raises:
        InputError: no scan is readable.
    """
    bad: list[str] = []
    for index, source in enumerate(sequence.sources):
        try:
            points = sequence.read_scan(index)
        except InputError as error:
            bad.append(f"scan {index}, {source}: {error.found}")
            continue
        yield IndexedScan(index, points)
    listed = "; ".join(bad[:10]) + (f"; and {len(bad) - 10} more" if len(bad) > 10 else "")
    is_usable = not bad or len(bad) < sequence.num_scans
    require(is_usable, sequence.name, f"all {len(bad)} scans are bad: {listed}", "check the files")
    if bad:
        _log.warning("%s: %d of %d scans left out: %s", sequence.name, len(bad), sequence.num_scans, listed)


def read_labelled_numbers(path: Path) -> dict[str, FloatArray]:
    """Reads the lines `key: numbers` of a calibration file; other lines are ignored.

    Args:
        path: the file.

    Returns:
        The numbers by key.

    Raises:
        InputError: there is no such file.
    """
    found = {}
    for key, _, numbers in (line.partition(":") for line in read_lines(path)):
        try:
            found[key.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue
    return found


def read_camera_calibration(path: Path) -> FloatArray:
    """Reads `Tr`, the lidar's frame to the left grey camera's, out of KITTI's calib.txt.

    Args:
        path: the file.

    Returns:
        (4, 4) `T_cam0_lidar`.

    Raises:
        InputError: there is no such file, or no such line in it.
    """
    entries = read_labelled_numbers(path)
    for key in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
        if key in entries and len(entries[key]) == 12:
            return np.asarray(from_rows(entries[key], path)[0])
    advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
    raise InputError(path, "no line 'Tr:' of 12 numbers", advice)
