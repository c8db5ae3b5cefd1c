"""Corrections of the points of a scan: the motion of the lidar during its turn, and wrong elevations of its beams."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dpmjax.types import AnyArray

# Elevation of the beams of KITTI's HDL-64E above that of its points (KISS-ICP corrects it by the same angle).
KITTI_ELEVATION_DEG = 0.205

# Shortest and longest turn of a lidar.
_TURN_S = (0.02, 0.5)
_MIN_TIMES = 4


def deskew(
    points: Float[AnyArray, "n 3"], offsets: Float[AnyArray, " n"], T_last_scan: Float[AnyArray, "4 4"]
) -> Float[np.ndarray, "n 3"]:
    """Moves each point into the frame of the lidar at the time of the scan's pose.

    The lidar moves on a screw of constant velocity, p' = exp(offset log(T)) p.

    Args:
        points: metres, each in the frame of the lidar at its own moment.
        offsets: time of each point since the scan's pose, as a share of the time between two scans. A pose of the
            middle of the turn gives offsets from -0.5 to 0.5, if a turn ends where the next begins.
        T_last_scan: motion of the lidar from one scan to the next.

    Returns:
        (n, 3) float32 points as a lidar that stands still measures them.

    Raises:
        ValueError: other shapes, or a motion that is not finite.
    """
    points, offsets = np.asarray(points, np.float64), np.asarray(offsets, np.float64)
    T = np.asarray(T_last_scan, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or offsets.shape != points.shape[:1]:
        raise ValueError(f"points: expected (n, 3) with n offsets, got {points.shape} and {offsets.shape}")
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"T_last_scan: expected a finite motion (4, 4), got {T.shape}")
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle < 1e-9:
        return np.asarray(points + offsets[:, None] * T[:3, 3], np.float32)
    axis = turn / angle
    shift_of_velocity = np.stack([_shifts(unit, axis, angle, np.ones(1))[0] for unit in np.eye(3)], axis=1)
    velocity = np.linalg.solve(shift_of_velocity, T[:3, 3])
    turned = _rotated(points, axis, angle * offsets)
    return np.asarray(turned + _shifts(velocity, axis, angle, offsets), np.float32)


def offsets_by_azimuth(
    points: Float[AnyArray, "n 3"], turn_share: float = 1.0, *, is_clockwise: bool = True
) -> Float[np.ndarray, " n"]:
    """Estimates when a spinning lidar measured each point: it begins and ends its turn straight behind, as on KITTI.

    Args:
        points: metres, x forward, y left.
        turn_share: time of a turn as a share of the time between scans; 1 for a lidar that never pauses.
        is_clockwise: sense of the turn, seen from above.

    Returns:
        Offsets for `deskew`: 0 straight ahead.
    """
    points = np.asarray(points)
    azimuth = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
    return np.asarray(turn_share * (-azimuth if is_clockwise else azimuth), np.float64)


def offsets_by_times(times: Float[AnyArray, " n"], interval_s: float | None = None) -> Float[np.ndarray, " n"] | None:
    """Converts the times of points, in s, ms, us or ns from any start, to offsets.

    The unit is the one in which the times of a scan span 0.02 to 0.5 s.

    Args:
        times: times of the points of one scan.
        interval_s: time between two scans, s; None takes the time of this one.

    Returns:
        Offsets for `deskew`: 0 in the middle of the scan. None where no unit fits, and where there are fewer than four
        times, as those of a clock in float32.
    """
    times = np.asarray(times, np.float64)
    if not np.isfinite(times).all() or len(np.unique(times)) < _MIN_TIMES:
        return None
    first, last = times.min(), times.max()
    unit = next((unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if _TURN_S[0] <= unit * (last - first) <= _TURN_S[1]), None)
    if unit is None:
        return None
    return (times - (first + last) / 2) * (unit / interval_s if interval_s else 1 / (last - first))


def _rotated(
    points: Float[np.ndarray, "n 3"], axis: Float[np.ndarray, " 3"], angles: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Applies Rodrigues' formula with one angle for each point."""
    across = np.cross(axis, points)
    sin, cos = np.sin(angles)[:, None], np.cos(angles)[:, None]
    return points + sin * across + (1 - cos) * np.cross(axis, across)


def _shifts(
    velocity: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"], angle: float, offsets: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Computes the translations of exp(offset (velocity, angle axis))."""
    angles = angle * offsets
    across = np.cross(axis, velocity)
    rest = np.cross(axis, across)
    parts = (offsets, (1 - np.cos(angles)) / angle, (angles - np.sin(angles)) / angle)
    return np.outer(parts[0], velocity) + np.outer(parts[1], across) + np.outer(parts[2], rest)


def raise_beams(points: Float[AnyArray, "n 3"], elevation_deg: float) -> Float[np.ndarray, "n 3"]:
    """Turns each point up about the lidar; azimuth and range stay.

    A lidar whose elevations are off by a constant sees flat ground as a bowl, and odometry on it climbs or sinks.

    Args:
        points: metres, z up, in the frame of the lidar.
        elevation_deg: degrees to add to the elevation of each point.

    Returns:
        (n, 3) float32 points.
    """
    points = np.asarray(points, np.float64)
    across = np.hypot(points[:, 0], points[:, 1])
    elevation = np.arctan2(points[:, 2], across) + np.radians(elevation_deg)
    ranges = np.hypot(across, points[:, 2])
    # A point straight above has no azimuth: it stays there.
    shares = np.divide(ranges * np.cos(elevation), across, out=np.ones_like(across), where=across > 0)
    heights = np.where(across > 0, ranges * np.sin(elevation), points[:, 2])
    return np.column_stack([points[:, :2] * shares[:, None], heights]).astype(np.float32)
