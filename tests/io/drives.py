"""Tiny drives in the layouts of the data sets: each function writes clouds and the poses of the lidar."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid
from dpmjax.io import write_ply
from dpmjax.io.poses import interpolate_poses

AXES = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])  # T_cam0_lidar


def write_bin(path: Path, points: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(path)
    return path


def write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def rows_of(poses: np.ndarray) -> str:
    return "".join(" ".join(f"{v:.12e}" for v in pose[:3].ravel()) + "\n" for pose in poses)


def write_kitti_odometry(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray, name: str = "00") -> Path:
    """Poses of the camera; returns the folder of the sequence."""
    folder = root / "sequences" / name
    for index, cloud in enumerate(clouds):
        write_bin(folder / "velodyne" / f"{index:06d}.bin", cloud)
    write_text(root / "poses" / f"{name}.txt", rows_of(AXES @ poses @ rigid.inverse(AXES)))
    write_text(folder / "calib.txt", f"P0: {rows_of(AXES[None])}Tr: {rows_of(AXES[None])}")
    write_text(folder / "times.txt", "".join(f"{0.1 * i:e}\n" for i in range(len(clouds))))
    return folder


def write_kitti_raw(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """Positions in the plane as longitude and latitude, heading north; returns the folder of the drive."""
    drive = root / "2011_09_26" / "2011_09_26_drive_0013_sync"
    for index, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        write_bin(drive / "velodyne_points" / "data" / f"{index:010d}.bin", cloud)
        # The lidar looks north, so that east is to its right.
        radius_m = 6378137.0 * np.cos(np.radians(49.0))
        longitude, latitude = 8.4 + np.degrees(-pose[1, 3] / radius_m), 49.0 + np.degrees(pose[0, 3] / 6378137.0)
        record = f"{latitude:.12f} {longitude:.12f} 110.0 0 0 {np.pi / 2} " + "0 " * 24
        write_text(drive / "oxts" / "data" / f"{index:010d}.txt", record)
    stamps = [f"2011-09-26 13:02:{index:02d}.951199337\n" for index in range(len(clouds))]
    write_text(drive / "velodyne_points" / "timestamps.txt", "".join(stamps))
    write_text(drive.parent / "calib_imu_to_velo.txt", "calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.7\n")
    return drive


def write_kitti_360(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """Poses of the car in a grid of a country."""
    name = "2013_05_28_drive_0000_sync"
    for index, cloud in enumerate(clouds):
        write_bin(root / "data_3d_raw" / name / "velodyne_points" / "data" / f"{index:010d}.bin", cloud)
    T_imu_cam0, T_lidar_cam0 = rigid.inverse(AXES), rigid.inverse(AXES) @ poses[-1]
    write_text(root / "calibration" / "calib_cam_to_pose.txt", "image_00: " + rows_of(T_imu_cam0[None]))
    write_text(root / "calibration" / "calib_cam_to_velo.txt", rows_of(T_lidar_cam0[None]))
    in_grid = poses.copy()
    in_grid[:, :3, 3] += [1e3, 5e3, 100]
    lines = rows_of(in_grid @ T_lidar_cam0 @ rigid.inverse(T_imu_cam0)).splitlines()
    write_text(root / "data_poses" / name / "poses.txt", "".join(f"{i} {line}\n" for i, line in enumerate(lines)))
    return root


def write_mulran(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray, home: str = "Ouster") -> Path:
    """Poses of the car by time."""
    T_car_lidar = np.eye(4)
    T_car_lidar[:3, :3] = Rotation.from_euler("xyz", [0.0001, 0.0003, 179.6654], degrees=True).as_matrix()
    T_car_lidar[:3, 3] = [1.7042, -0.021, 1.8047]
    stamps = [1567410200000000000 + index * 100_000_000 for index in range(len(clouds))]
    for stamp, cloud in zip(stamps, clouds, strict=True):
        write_bin(root / home / f"{stamp}.bin", cloud)
    lines = rows_of(poses @ rigid.inverse(T_car_lidar)).splitlines()
    table = [f"{stamp}," + ",".join(line.split()) for stamp, line in zip(stamps, lines, strict=True)]
    write_text(root / "global_pose.csv", "\n".join(table) + "\n")
    return root


def write_kitti_carla(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """A hundred poses a scan."""
    home = root / "Town01" / "generated"
    (home / "frames").mkdir(parents=True)
    for index, cloud in enumerate(clouds):
        write_ply(home / "frames" / f"frame_{index:04d}.ply", cloud)
    num = len(clouds)
    fine = interpolate_poses(np.arange(float(num)), poses, np.minimum(np.arange(100 * num) / 100, num - 1.0))
    lines = [f"{line} {0.001 * i:.3f}" for i, line in enumerate(rows_of(fine).splitlines())]
    write_text(home / "full_poses_lidar.txt", "# R(0,0) R(0,1) ... timestamp\n" + "\n".join(lines) + "\n")
    return root


def write_learned(root: Path, clouds: Sequence[np.ndarray], poses: np.ndarray) -> Path:
    """Poses in the files of the scans."""
    (root / "scene" / "0").mkdir(parents=True)
    for index, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        arrays = {"lidar_pcd": cloud, "ego_rotation": pose[:3, :3], "ego_translation": pose[:3, 3:]}
        np.savez(root / "scene" / "0" / f"{index}.npz", **arrays)
    return root


WRITERS: dict[str, Callable[[Path, Sequence[np.ndarray], np.ndarray], Path]] = {
    "kitti": write_kitti_odometry,
    "raw": write_kitti_raw,
    "360": write_kitti_360,
    "mulran": write_mulran,
    "carla": write_kitti_carla,
    "learned": write_learned,
}
