"""The files of a drive of 3-D scans with their poses and times: plain folders of scans, KITTI odometry in and out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.io.files import load_arrays, natural_key, read_lines, read_table, write_atomically
from dpmjax.io.poses import check_poses, from_rows, homogeneous, read_poses, write_kitti
from dpmjax.sequences import FloatArray, InputError, LidarSequence, iterate_scans

SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".pcd", ".ply")
_POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
               "trajectory.npy", "gt_poses.txt", "groundtruth.txt")  # fmt: skip
# Axes of a camera that looks along x of the lidar: x right, y down, z forward. Written sequences have it in the lidar.
_T_CAM0_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


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
    T_world_lidar: FloatArray | None = None
    times: FloatArray | None = None


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
    files = [f for f in folder.iterdir() if f.is_file() and f.name[0] != "." and f.name not in _POSE_FILES]
    of_suffix: list[list[Path]] = [[f for f in files if f.suffix.lower() == suffix] for suffix in suffixes]
    return sorted(max(of_suffix, key=len), key=lambda file: natural_key(file.name))


def numbers_of(files: Sequence[Path], largest: float = 2.0**62) -> list[int] | None:
    """The numbers that are the names of files.

    Args:
        files: the scans.
        largest: no number may be above this.

    Returns:
        One number a file, or None where a name is no number or too large.
    """
    names = [file.stem for file in files]
    is_good = all(name.isascii() and name.isdecimal() and len(name) < 20 and int(name) <= largest for name in names)
    return [int(name) for name in names] if is_good else None


def match_rows(rows: NDArray[Any], files: list[Path]) -> NDArray[Any] | None:
    """The row of each scan: in order if there are as many, else by the number that is the file's name.

    Args:
        rows: (m, ...) values.
        files: the n scans.

    Returns:
        (n, ...), or None where there are more or fewer rows, and names that are no numbers of rows.
    """
    numbers = range(len(files)) if len(rows) == len(files) else numbers_of(files, len(rows) - 1)
    return None if numbers is None else rows[list(numbers)]


def match_poses(poses: FloatArray, files: list[Path], path: Path) -> FloatArray:
    """The pose of each scan, see `match_rows`.

    Args:
        poses: (m, 4, 4).
        files: the n scans.
        path: of the poses, for messages.

    Returns:
        (n, 4, 4).

    Raises:
        InputError: another number of poses, and names that are no numbers.
    """
    matched = match_rows(poses, files)
    if matched is None:
        raise InputError(path, f"{len(poses)} poses for {len(files)} scans", "give one pose a scan, in their order")
    return matched


def match_times(path: Path, files: list[Path]) -> FloatArray | None:
    """The times of the scans out of times.txt; a file that does not fit is ignored.

    Args:
        path: of times.txt.
        files: the n scans.

    Returns:
        (n,) s, or None.
    """
    try:
        times = match_rows(read_table(path)[:, 0], files)
    except InputError:
        return None
    return times if times is not None and np.isfinite(times).all() else None


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
    keys = ("ego_rotation", "ego_translation")
    poses: list[FloatArray | None] = []
    for file in files:
        try:
            table = load_arrays(file, keys)
        except InputError:  # The scan is bad too, and is named when it is read.
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


def read_kitti_odometry(folder: Path) -> Drive3D:
    """Lists a sequence of KITTI odometry.

    Poses are looked for in poses_lidar.txt (already in the lidar's frame), poses.txt beside velodyne/ (SemanticKITTI's)
    and poses/NN.txt two folders up, both in the left camera's frame.

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
    path = next((p for p in (in_lidar, *in_camera) if p.is_file()), None)
    if path is None:
        return drive
    poses = read_poses(path)
    if path != in_lidar:
        T_cam0_lidar = _read_camera_calibration(folder / "calib.txt")
        poses = rigid.inverse(T_cam0_lidar) @ poses @ T_cam0_lidar
    return drive._replace(T_world_lidar=match_poses(poses, files, path))


def write_kitti_sequence(root: str | Path, name: str, sequence: LidarSequence) -> Path:
    """Writes a sequence as KITTI odometry lays it out: sequences/NAME/{velodyne,calib.txt,times.txt}, poses/NAME.txt.

    Reflectance is written as 0. Poses are those of the camera of the written calib.txt, from the first scan on.

    Args:
        root: folder of the data set.
        name: of the sequence, like "00".
        sequence: the scans; it must have poses. Bad scans are left out, with their poses.

    Returns:
        The sequence's folder.

    Raises:
        InputError: no poses, or not one good scan.
    """
    if sequence.T_world_lidar is None:
        raise InputError(sequence.name, "no poses", "a KITTI sequence needs a pose for each scan")
    root = Path(root)
    folder = root / "sequences" / name
    kept: list[int] = []
    for index, points in iterate_scans(sequence):
        rows = np.zeros((len(points), 4), "<f4")
        rows[:, :3] = points
        write_atomically(folder / "velodyne" / f"{len(kept):06d}.bin", rows.tobytes())
        kept.append(index)
    T_first_lidar = rigid.inverse(sequence.T_world_lidar[kept[0]]) @ sequence.T_world_lidar[kept]
    write_kitti(root / "poses" / f"{name}.txt", _T_CAM0_LIDAR @ T_first_lidar @ rigid.inverse(_T_CAM0_LIDAR))
    numbers = " ".join(f"{value:.12e}" for value in _T_CAM0_LIDAR[:3].ravel())
    write_atomically(folder / "calib.txt", f"Tr: {numbers}\n")
    times = np.arange(len(kept)) / 10.0 if sequence.times is None else sequence.times[kept]
    write_atomically(folder / "times.txt", "".join(f"{time:.6f}\n" for time in times))
    return folder


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


def _read_camera_calibration(path: Path) -> FloatArray:
    """(4, 4) `T_cam0_lidar`: `Tr`, the lidar's frame to the left grey camera's, out of KITTI's calib.txt."""
    entries = read_labelled_numbers(path)
    for key in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
        if key in entries and len(entries[key]) == 12:
            return from_rows(entries[key], path)[0]
    advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
    raise InputError(path, "no line 'Tr:' of 12 numbers", advice)
