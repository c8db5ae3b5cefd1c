"""Simulated logs of corridors: a half-circle lidar of short reach, niches and rooms far apart, raw odometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.simulation import scan_world, simulate_odometry

Floats = NDArray[np.float64]

METRES_A_PX = 0.05
_LENGTH_PX, _HEIGHT_PX, _WIDTH_PX = 1600, 600, 60
_REACH_PX, _RANGE_NOISE_PX, _NUM_BEAMS = 160.0, 0.6, 360
_NUM_SCANS = 60
# Share of the sections with a niche or a room, and the lengths of sections.
_ROOM_SHARE, _SECTION_PX = 0.35, (60, 320)


def write_corridor_log(path: Path, seed: int) -> Path:
    """Simulates a drive along a corridor, 1 to 1.5 m a step.

    Args:
        path: `.npz` to write: ranges, angles, poses, odometry, times.
        seed: of the world, the drive, and all noise.

    Returns:
        The path.
    """
    rng = np.random.default_rng(seed)
    solid, poses = _make_corridor(rng), _drive(rng)
    points, mask = scan_world(
        solid, poses, num_beams=_NUM_BEAMS, max_range=_REACH_PX, range_noise_px=_RANGE_NOISE_PX, rng=rng
    )
    odometry = simulate_odometry(poses, rng=rng, translation_noise=0.05, rotation_noise_deg=0.6, bias=0.02)
    angles = se2.wrap_angle(2 * np.pi * np.arange(_NUM_BEAMS) / _NUM_BEAMS)
    ahead = np.flatnonzero(np.abs(angles) <= 0.5 * np.pi + 1e-9)
    ahead = ahead[np.argsort(angles[ahead])]
    ranges = np.where(mask, np.linalg.norm(points, axis=2), 0.0)[:, ahead] * METRES_A_PX
    metres = np.array([METRES_A_PX, METRES_A_PX, 1.0])
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"ranges": ranges, "angles": angles[ahead], "poses": poses * metres, "odometry": odometry * metres}
    np.savez(path, **arrays, times=np.arange(len(poses), dtype=np.float64))
    return path


def _make_corridor(rng: np.random.Generator) -> NDArray[np.bool_]:
    solid = np.ones((_HEIGHT_PX, _LENGTH_PX), bool)
    low, high = _HEIGHT_PX // 2, _HEIGHT_PX // 2 + _WIDTH_PX
    solid[low:high, 20 : _LENGTH_PX - 20] = False
    x = 60
    while x < _LENGTH_PX - 120:
        if rng.random() < _ROOM_SHARE:
            width, depth = int(rng.integers(20, 90)), int(rng.integers(10, 120))
            rows = slice(high, high + depth) if rng.random() < 0.5 else slice(low - depth, low)
            solid[rows, x : x + width] = False
        x += int(rng.integers(*_SECTION_PX))
    return solid


def _drive(rng: np.random.Generator) -> Floats:
    """Returns poses along the middle of the corridor, px and radians."""
    x = np.linspace(60.0, _LENGTH_PX - 80.0, _NUM_SCANS) + rng.normal(0.0, 3.0, _NUM_SCANS)
    middle = _HEIGHT_PX / 2 + _WIDTH_PX / 2
    y = middle + np.clip(np.cumsum(rng.normal(0.0, 1.0, _NUM_SCANS)), -15.0, 15.0)
    return np.column_stack([x, y, rng.normal(0.0, 0.08, _NUM_SCANS)])
