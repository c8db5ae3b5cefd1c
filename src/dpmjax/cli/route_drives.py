"""Simulated drives along a trajectory of the user, and simulated scans that are kept on disk."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.cli.run_folder import RESULTS
from dpmjax.io import read_lidar_trajectory, write_atomically
from dpmjax.sequences import InputError, LidarSequence, Note

ROUTE_SUFFIXES = (".txt", ".tum")
# A car of 10 m/s and a lidar of 10 turns a second, as in KITTI: one scan each metre, with up to 3 degrees of turn.
ROUTE_SPEED_M_S, ROUTE_RATE_HZ, ROUTE_TURN_DEG_S = 10.0, 10.0, 30.0
STEP_M = 2.0**-8
"""Unit of the integer coordinates of kept scans: 16 bits reach 128 m."""


def is_route(path: Path) -> bool:
    """Returns True for a file of poses, along which a town is simulated."""
    return path.suffix.lower() in ROUTE_SUFFIXES and path.is_file()


def route_drive(path: Path, seed: int) -> LidarSequence:
    """Simulates a town along a trajectory, and a drive through it; scans are simulated when they are first read.

    Streets follow the trajectory, and the ground its slopes; all passes of a place have one height. The car drives in
    its lane at constant speed and tilts with the ground; rotations and times of the file are ignored.

    Args:
        path: poses of a lidar or of a camera as TUM or KITTI, metres.
        seed: of the town.

    Returns:
        The drive with exact poses and times.

    Raises:
        InputError: no such poses, or a trajectory shorter than 20 m.
    """
    from dpmjax.simulation import DriveConfig, TownConfig, simulate_lidar_sequence

    T_world_lidar = read_lidar_trajectory(path)
    T_world_lidar[:, :3, 3] -= T_world_lidar[0, :3, 3]  # float32 holds no centimetres at the coordinates of a country
    driving = DriveConfig(ROUTE_SPEED_M_S, ROUTE_RATE_HZ, max_turn_deg_s=ROUTE_TURN_DEG_S)
    try:
        drive = simulate_lidar_sequence(seed, TownConfig(), driving=driving, trajectory=T_world_lidar)
    except ValueError as error:
        raise InputError(path, str(error), "give the poses of a drive, in metres") from error
    sources = tuple(f"{path}, simulated scan {number}" for number in range(len(drive)))
    kept = keep_scans(replace(drive, name=path.stem, sources=sources))
    return replace(kept, notes=(*kept.notes, Note(f"{path}: a town of seed {seed} is simulated along these poses")))


def keep_scans(drive: LidarSequence, folder: Path = RESULTS / "simulated") -> LidarSequence:
    """Caches the scans of a simulated drive on disk at their first reading, rounded to 4 mm.

    Args:
        drive: the drive; points within 128 m.
        folder: a folder in it, named after the drive and its content, gets one file a scan.

    Returns:
        The same drive, with rounded points.
    """
    home = folder.resolve() / f"{drive.name}-{_digest(drive)}"
    return replace(drive, read_scan=partial(_read_kept, home, drive.read_scan))


def _read_kept(folder: Path, read_scan: Callable[[int], NDArray[np.float32]], index: int) -> NDArray[np.float32]:
    path = folder / f"{index:06}.npy"
    if not path.exists():
        buffer = io.BytesIO()
        np.save(buffer, np.rint(read_scan(index) / STEP_M).astype(np.int16))
        write_atomically(path, buffer.getvalue())
    return np.load(path).astype(np.float32) * np.float32(STEP_M)


def _digest(drive: LidarSequence) -> str:
    """Hashes the poses, the times and two scans, which differ between towns, lidars and versions of the simulator."""
    arrays = (drive.T_world_lidar, drive.times, drive.read_points(0), drive.read_points(len(drive) - 1))
    parts = (b"" if array is None else np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:8]
