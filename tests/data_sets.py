"""Writers of data sets in the layouts of their authors, for tests of the readers and of the commands."""

from pathlib import Path

import numpy as np
from scipy.io import savemat

from dpmjax.cli.options import RunOptions
from dpmjax.cli.run import Run
from dpmjax.geometry import rigid
from dpmjax.io import InputError, LidarSequence, ScanSequence
from dpmjax.io.clouds import parse_pcd, parse_ply
from dpmjax.io.files import read_bytes
from tests.io.drives import write_kitti_odometry


def write_pcd(path: Path, points: np.ndarray) -> Path:
    """Writes points in the layout of the DeepMapping authors: fields x y z, float32, binary, one row of points."""
    cloud = np.zeros((len(points), 3), "<f4")
    cloud[:, : points.shape[1]] = points
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(cloud)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(cloud)}\nDATA binary\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + cloud.tobytes())
    return path


def readable_scans(sequence: LidarSequence) -> dict[int, np.ndarray]:
    """Reads the scans of a drive by their numbers, without the damaged ones."""
    scans = {}
    for index in range(len(sequence)):
        try:
            scans[index] = sequence.read_scan(index)
        except InputError:
            continue
    return scans


def write_deepmapping_folder(folder: Path, sequence: ScanSequence) -> Path:
    """Writes `000.pcd` and so on in pixels / 512 or in metres, invalid beams as zeros, and gt_pose.mat."""
    folder.mkdir(parents=True, exist_ok=True)
    stored = np.where(sequence.mask[..., None], sequence.points, 0.0) / (512.0 if sequence.unit == "px" else 1.0)
    for index, points in enumerate(stored):
        write_pcd(folder / f"{index:03d}.pcd", points)
    if sequence.reference_poses is not None:
        savemat(folder / "gt_pose.mat", {"pose": sequence.reference_poses})
    return folder


def write_kitti_sequence(root: Path, name: str, sequence: LidarSequence) -> Path:
    """Writes the good scans in the layout of KITTI's odometry."""
    scans = readable_scans(sequence)
    T_world_lidar = sequence.T_world_lidar[list(scans)]
    return write_kitti_odometry(root, list(scans.values()), rigid.inverse(T_world_lidar[0]) @ T_world_lidar, name)


def read_pcd(path: Path) -> np.ndarray:
    return parse_pcd(read_bytes(path), str(path)).points


def read_ply(path: Path) -> np.ndarray:
    return parse_ply(read_bytes(path), str(path)).points


def run_in(folder: Path) -> Run:
    """A run of a command in a folder, which may hold an earlier part of it."""
    run = Run("toy", RunOptions())
    folder.mkdir(exist_ok=True)
    run.path = folder
    return run
