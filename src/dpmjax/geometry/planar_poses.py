"""Planar poses (x, y, heading) in float64 on the host: chains, graphs and everything that must not lose millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Poses = NDArray[np.float64]
Angles = NDArray[np.float64] | np.float64


def wrap(angle: Angles) -> Angles:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def compose(pose_a_b: Poses, pose_b_c: Poses) -> Poses:
    """T_a_b @ T_b_c, (..., 3) each. The translation is turned by the rotation of T_a_b alone."""
    c, s = np.cos(pose_a_b[..., 2]), np.sin(pose_a_b[..., 2])
    x = pose_a_b[..., 0] + c * pose_b_c[..., 0] - s * pose_b_c[..., 1]
    y = pose_a_b[..., 1] + s * pose_b_c[..., 0] + c * pose_b_c[..., 1]
    return np.stack([x, y, wrap(pose_a_b[..., 2] + pose_b_c[..., 2])], axis=-1)


def inverse(pose_a_b: Poses) -> Poses:
    """T_b_a of T_a_b, (..., 3)."""
    c, s = np.cos(pose_a_b[..., 2]), np.sin(pose_a_b[..., 2])
    x = -c * pose_a_b[..., 0] - s * pose_a_b[..., 1]
    y = s * pose_a_b[..., 0] - c * pose_a_b[..., 1]
    return np.stack([x, y, wrap(-pose_a_b[..., 2])], axis=-1)


def relative(pose_w_a: Poses, pose_w_b: Poses) -> Poses:
    """T_a_b of two poses in one world, (..., 3)."""
    return compose(inverse(pose_w_a), pose_w_b)


def chain(steps: Poses) -> Poses:
    """Poses from steps: T_world_next = T_world_scan @ T_scan_next, first pose zero.

    Args:
        steps: (n - 1, 3) T_scan_next.

    Returns:
        (n, 3) T_world_scan.
    """
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def matrices(poses: Poses) -> NDArray[np.float64]:
    """(n, 3) poses as (n, 3, 3) homogeneous matrices."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    result = np.tile(np.eye(3), (len(poses), 1, 1))
    result[:, 0, 0], result[:, 0, 1], result[:, 0, 2] = c, -s, poses[:, 0]
    result[:, 1, 0], result[:, 1, 1], result[:, 1, 2] = s, c, poses[:, 1]
    return result


def transform(poses: Poses, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points of every scan in the world: poses (n, 3), points (n, b, 2) -> (n, b, 2)."""
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x = c * points[..., 0] - s * points[..., 1] + poses[:, 0, None]
    y = s * points[..., 0] + c * points[..., 1] + poses[:, 1, None]
    return np.stack([x, y], axis=-1)


def nearest_tour(poses: Poses) -> NDArray[np.int64]:
    """An order in which neighbours are near each other: from each pose to the nearest one not yet visited.

    Args:
        poses: (n, 3) x, y, heading.

    Returns:
        (n,) rows, the first one 0.
    """
    left = set(range(1, len(poses)))
    tour = [0]
    while left:
        here = poses[tour[-1], :2]
        tour.append(min(left, key=lambda scan: (float(np.hypot(*(poses[scan, :2] - here))), scan)))
        left.remove(tour[-1])
    return np.array(tour, np.int64)
