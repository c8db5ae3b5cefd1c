"""Scans and first poses of deepmapping_3d: a window of a drive, or a simulated place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dpmjax.io import LidarSequence

Floats = NDArray[np.float64]

_NUM_SIMULATED = 16


@dataclass(frozen=True)
class DriveWindow:
    """Some scans of a drive.

    Attributes:
        data: folder of the drive, or None for a simulated place.
        sequence: name of the drive where the folder holds several.
        scene: the simulated place, "room" or "street".
        rows: scans to use.
        seed: seed of the simulated place.
    """

    data: Path | None
    sequence: str | None
    scene: str
    rows: slice
    seed: int


# Root mean square of the noise of orientations, where noise is added.
_NOISE_DEG = 1.0


@dataclass(frozen=True)
class FirstPoses:
    """Poses to start from.

    Attributes:
        source: "poses" (of the drive), "zero", or the path of a trajectory.
        noise_m: root mean square of the noise of the positions, metres; orientations then have `_NOISE_DEG`.
        seed: seed of the noise.
    """

    source: str
    noise_m: float
    seed: int


def read_drive(window: DriveWindow) -> LidarSequence:
    """Opens the scans of the window; a `ValueError` where there are fewer than two."""
    from dpmjax import io

    if window.data is None:
        drive = simulated_drive(window)
    else:
        drive = io.open_lidar_sequence(window.data, sequence=window.sequence)
    part = drive.take(window.rows)
    if len(part) < 2:
        begin, end = ("" if row is None else row for row in (window.rows.start, window.rows.stop))
        raise ValueError(f"--window {begin}:{end} --jump {window.rows.step}: chooses {len(part)} of {len(drive)} scans")
    return part


def simulated_drive(window: DriveWindow) -> LidarSequence:
    """Returns the first scans of a simulated flat or suburb."""
    from dpmjax import simulation

    kind, sensor, spacing = (
        ("flat", simulation.OS1_64, 4.0) if window.scene == "room" else ("suburb", simulation.HDL64E, 2.0)
    )
    mixture = simulation.SceneMixture(
        kinds=((kind, 1.0),), sensors=((sensor, 1.0),), spacing_m=spacing, indoor_scale=(1.0, 1.0), moving_rate=0.0
    )
    drive = simulation.simulate_scene(simulation.draw_scene(window.seed, mixture))
    return drive.take(slice(0, _NUM_SIMULATED))


def starting_poses(first: FirstPoses, sequence: LidarSequence, rows: slice) -> Floats | None:
    """Returns (n, 4, 4) poses with their noise; None for a cold start.

    Args:
        first: where they come from.
        sequence: the scans of the window.
        rows: rows of the window in its drive; a trajectory may have a pose for each scan of either.

    Returns:
        The poses.
    """
    if first.source == "zero":
        return None
    if first.source == "poses":
        if sequence.T_world_lidar is None:
            raise ValueError(f"{sequence.name}: has no poses to start from; use --init FILE or --init zero")
        T = sequence.T_world_lidar
    else:
        T = read_start(first.source, len(sequence), rows)
    return T if first.noise_m == 0.0 else add_noise(T, first.noise_m, first.seed)


def read_start(path: str, num_scans: int, rows: slice) -> Floats:
    """Reads a trajectory: a pose for each scan of the window, or of the whole drive."""
    from dpmjax import io

    if not Path(path).exists():
        raise ValueError(f"--init {path}: no such file, and none of poses, zero")
    T = io.read_poses(path)
    chosen = T if len(T) == num_scans else T[rows]
    if len(chosen) != num_scans:
        raise ValueError(f"{path}: {len(T)} poses for {num_scans} scans; give one a scan, in the scans' order")
    return chosen


def add_noise(T: Floats, noise_m: float, seed: int) -> Floats:
    """Moves each pose by a random motion whose root mean square is given."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(size=(len(T), 3)) * math.radians(_NOISE_DEG) / math.sqrt(3.0))
    moved = T.copy()
    moved[:, :3, 3] += rng.normal(size=(len(T), 3)) * noise_m / math.sqrt(3.0)
    moved[:, :3, :3] = T[:, :3, :3] @ turns.as_matrix()
    return moved
