"""Simulated drives as sequences, and on disk in KITTI's layout."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.geometry import rigid
from dpmjax.io.errors import InputError
from dpmjax.io.files import write_atomically
from dpmjax.io.lidar.sequence import LidarSequence, iterate_scans
from dpmjax.io.poses.trajectory_files import write_kitti
from dpmjax.simulation.town.cast import CastConfig
from dpmjax.simulation.town.driving import DriveConfig, drive
from dpmjax.simulation.town.make import TownConfig, make_town
from dpmjax.simulation.town.scan import scan_town
from dpmjax.simulation.town.sensors import HDL64E, LidarSensor

# KITTI's cameras look along x of the lidar: x right, y down, z forward. This town's camera sits in the lidar.
_T_CAM0_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def simulate_lidar_sequence(
    seed: int,
    config: TownConfig = TownConfig(),  # noqa: B008 (frozen)
    *,
    driving: DriveConfig | None = None,
    sensor: LidarSensor = HDL64E,
    trajectory: ArrayLike | None = None,
    casting: CastConfig = CastConfig(),  # noqa: B008
) -> LidarSequence:
    """A drive through a town of its own; a scan is simulated when it is asked for.

    Args:
        seed: of the town, the drive and the noise: the same sequence every time.
        config: what the town is like.
        driving: how the car drives; None takes the default with the sensor's own height.
        sensor: the lidar.
        trajectory: (n, 4, 4) `T_world_lidar` of a real drive to lay the street along, see `make_town`.
        casting: capacities of the ray caster.

    Returns:
        The sequence, with exact poses and times. The world is the town's.

    Raises:
        ValueError: see `make_town`.
    """
    town = make_town(seed, config, trajectory=trajectory)
    driving = driving or DriveConfig(sensor_height_m=sensor.height_m)
    way = drive(town, driving, seed=seed)

    def read_scan(index: int) -> NDArray[np.float32]:
        key = jax.random.fold_in(jax.random.key(seed), index)
        pose, time = way.T_world_lidar[index], way.times[index]
        cloud = scan_town(town.primitives, pose, time, key=key, sensor=sensor, config=casting)
        return np.asarray(cloud.points)[np.asarray(cloud.mask)]

    return LidarSequence(
        name=town.name,
        sources=tuple(f"{town.name}, scan {index}" for index in range(len(way.times))),
        read_scan=read_scan,
        T_world_lidar=way.T_world_lidar,
        times=way.times,
    )


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
    T_world_cam0 = _T_CAM0_LIDAR @ T_first_lidar @ rigid.inverse(_T_CAM0_LIDAR)
    write_kitti(root / "poses" / f"{name}.txt", T_world_cam0)
    numbers = " ".join(f"{value:.12e}" for value in _T_CAM0_LIDAR[:3].ravel())
    write_atomically(folder / "calib.txt", f"Tr: {numbers}\n")
    times = np.arange(len(kept)) / 10.0 if sequence.times is None else sequence.times[kept]
    write_atomically(folder / "times.txt", "".join(f"{time:.6f}\n" for time in times))
    return folder
