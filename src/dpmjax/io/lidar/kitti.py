"""KITTI odometry, SemanticKITTI and their copies on disk, in and out: velodyne/, calib.txt, times.txt, poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.io.files import read_lines, write_atomically
from dpmjax.io.lidar.drive import Drive3D, match_poses, match_times, scan_files
from dpmjax.io.poses import check_poses, read_poses, to_homogeneous, write_kitti
from dpmjax.sequences import FloatArray, InputError, LidarSequence, iterate_scans

# Axes of a camera that looks along x of the lidar: x right, y down, z forward. Written sequences have it in the lidar.
_T_CAM0_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


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
    path = next((p for p in (in_lidar, *in_camera) if p.is_file()), None)
    poses = None
    if path is not None:
        poses = read_poses(path)
        if path != in_lidar:
            T_cam0_lidar = _read_camera_calibration(folder / "calib.txt")
            poses = rigid.inverse(T_cam0_lidar) @ poses @ T_cam0_lidar
        poses = match_poses(poses, files, path)
    return Drive3D(name, files, poses, match_times(folder / "times.txt", files))


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
            return check_poses(to_homogeneous(entries[key][None]), path)[0]
    advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
    raise InputError(path, "no line 'Tr:' of 12 numbers", advice)
