"""Scans and first poses of deepmapping_3d: a window of a drive, or a simulated place."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence
    from experiments.deepmapping_3d import Config

Floats = NDArray[np.float64]

_NUM_SIMULATED = 16
_SIMULATED_NOISE_M = 0.2


def read_drive(config: Config) -> LidarSequence:
    """Opens the scans of the window; a `ValueError` where there are fewer than two."""
    from dpmjax import io

    drive = (
        simulated_drive(config)
        if config.data is None
        else io.open_lidar_sequence(config.data, sequence=config.sequence)
    )
    part = drive.take(config.selection())
    if len(part) < 2:
        raise ValueError(f"--window {config.window} --jump {config.jump}: chooses {len(part)} of {len(drive)} scans")
    return part


def simulated_drive(config: Config) -> LidarSequence:
    """Returns the first scans of a simulated flat or suburb."""
    from dpmjax import simulation

    kind, sensor, spacing = (
        ("flat", simulation.OS1_64, 4.0) if config.scene == "room" else ("suburb", simulation.HDL64E, 2.0)
    )
    mixture = simulation.SceneMixture(
        kinds=((kind, 1.0),), sensors=((sensor, 1.0),), spacing_m=spacing, indoor_scale=(1.0, 1.0), moving_rate=0.0
    )
    drive = simulation.simulate_scene(simulation.draw_scene(config.seed, mixture))
    return drive.take(slice(0, _NUM_SIMULATED))


def starting_poses(config: Config, sequence: LidarSequence) -> Floats | None:
    """Returns (n, 4, 4) poses with their noise; None for a cold start."""
    if config.init == "zero":
        return None
    if config.init == "poses":
        if sequence.T_world_lidar is None:
            raise ValueError(f"{sequence.name}: has no poses to start from; use --init FILE or --init zero")
        T = sequence.T_world_lidar
    else:
        T = read_start(config, len(sequence))
    noise_m = config.init_noise
    if noise_m is None:
        noise_m = _SIMULATED_NOISE_M if config.data is None and config.init == "poses" else 0.0
    return T if noise_m == 0.0 else add_noise(T, noise_m, config.init_noise_deg, config.seed)


def read_start(config: Config, num_scans: int) -> Floats:
    """Reads the trajectory of `--init`: a pose for each scan of the window, or of the whole drive."""
    from dpmjax import io

    if not Path(config.init).exists():
        raise ValueError(f"--init {config.init}: no such file, and none of poses, zero")
    T = io.read_poses(config.init)
    chosen = T if len(T) == num_scans else T[config.selection()]
    if len(chosen) != num_scans:
        raise ValueError(f"{config.init}: {len(T)} poses for {num_scans} scans; give one a scan, in the scans' order")
    return chosen


def add_noise(T: Floats, noise_m: float, noise_deg: float, seed: int) -> Floats:
    """Moves each pose by a random motion whose root mean square is given."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(size=(len(T), 3)) * math.radians(noise_deg) / math.sqrt(3.0))
    moved = T.copy()
    moved[:, :3, 3] += rng.normal(size=(len(T), 3)) * noise_m / math.sqrt(3.0)
    moved[:, :3, :3] = T[:, :3, :3] @ turns.as_matrix()
    return moved
