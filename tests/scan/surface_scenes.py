"""Points on the surfaces of a street with known shape: ground, two walls, a house front, poles."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def street(seed: int, num_points: int = 6000, noise_m: float = 0.01) -> np.ndarray:
    """(n, 3) world points; other seeds draw other points of the same surfaces."""
    rng = np.random.default_rng(seed)
    share = num_points // 4
    u, v = rng.uniform(0, 1, (2, share))
    ground = np.column_stack([60 * u - 30, 24 * v - 12, np.full(share, -1.7)])
    left = np.column_stack([60 * u - 30, np.full(share, 12.0), 6 * v - 1.7])
    right = np.column_stack([40 * u - 30, np.full(share, -12.0), 5 * v - 1.7])
    corners = rng.integers(0, 5, share)
    fronts = np.column_stack([np.array([-18, -7, 2, 11, 23.0])[corners], 6 * u + 6, 4 * v - 1.7])
    return np.concatenate([ground, left, right, fronts]) + noise_m * rng.normal(size=(4 * share, 3))


def motion(yaw_deg: float, translation: tuple[float, float, float], tilt_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [yaw_deg, tilt_deg, -tilt_deg], degrees=True).as_matrix()
    T[:3, 3] = translation
    return T


def seen_from(points_world: np.ndarray, T_world_scan: np.ndarray) -> np.ndarray:
    """The same points in the frame of a scan."""
    return (points_world - T_world_scan[:3, 3]) @ T_world_scan[:3, :3]


def rectangle(
    rng: np.random.Generator,
    corner: tuple[float, float, float],
    first: tuple[float, ...],
    second: tuple[float, ...],
    density: float = 60.0,
) -> np.ndarray:
    """(n, 3) points of a rectangle with two sides from a corner; `density` is points a square metre."""
    num = int(density * np.linalg.norm(first) * np.linalg.norm(second))
    u, v = rng.uniform(0, 1, (2, num, 1))
    return np.array(corner) + u * np.array(first) + v * np.array(second) + 0.01 * rng.normal(size=(num, 3))


def corridor(
    seed: int, pillars_m: tuple[float, ...] = (), length_m: float = 120.0, density: float = 60.0
) -> np.ndarray:
    """(n, 3) points of the floor, the ceiling and the walls of a corridor along x, and of pillars at the left wall."""
    rng = np.random.default_rng(seed)

    start, long, high = -length_m / 2, (length_m, 0.0, 0.0), (0.0, 0.0, 2.6)
    parts = [rectangle(rng, (start, -1.1, z), long, (0.0, 2.5, 0.0), density) for z in (-1.2, 1.4)]
    parts += [rectangle(rng, (start, y, -1.2), long, high, density) for y in (-1.1, 1.4)]
    parts += [rectangle(rng, (x, 0.9, -1.2), (0.0, 0.5, 0.0), high, density) for x in pillars_m]
    parts += [rectangle(rng, (x + 0.6, 0.9, -1.2), (0.0, 0.5, 0.0), high, density) for x in pillars_m]
    return np.concatenate(parts)
