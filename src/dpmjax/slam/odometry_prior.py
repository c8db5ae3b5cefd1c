"""Odometry of wheels or of an IMU as first guess of each motion, and its errors compared with the finished map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid
from dpmjax.slam.front_end import FrontEndState
from dpmjax.types import Pose, Poses

# Largest delay that is tried, in scans and as a share of the drive, and least share by which it must lower the error.
MAX_DELAY, MAX_DELAY_SHARE, LEAST_GAIN = 30, 0.25, 0.5


class OdometryErrors(NamedTuple):
    """Comparison of odometry with the trajectory of SLAM.

    Attributes:
        step_m: median error of a motion of odometry between two scans.
        delay_scans: number of scans by which the stamps of odometry are late; negative if they are early.
        undelayed_step_m: the median error without this delay.
    """

    step_m: float
    delay_scans: int
    undelayed_step_m: float


def with_guess(state: FrontEndState, odometry: Poses | None, index: int) -> FrontEndState:
    """Replaces the predicted motion to a scan by the motion of odometry, if there is one.

    Args:
        state: state of the front end before the scan.
        odometry: (n, 4, 4) poses of the lidar, NaN where there is none; None for no odometry.
        index: row of the scan.

    Returns:
        The state.
    """
    if odometry is None or not 0 < index < len(odometry):
        return state
    T_last_scan: Pose = rigid.inverse(odometry[index - 1]) @ odometry[index]
    if not np.isfinite(T_last_scan).all():
        return state
    return state._replace(T_before_last=T_last_scan)


def compare_odometry(odometry: Poses, T_world_scan: Poses) -> OdometryErrors:
    """Compares the motions of odometry with those of SLAM, at once and shifted in time.

    Args:
        odometry: (n, 4, 4) poses of the lidar, NaN where there is none.
        T_world_scan: (n, 4, 4) poses of the same scans by SLAM.

    Returns:
        The errors.
    """
    given, found = (rigid.inverse(T[:-1]) @ T[1:] for T in (odometry, T_world_scan))
    most = min(MAX_DELAY, int(MAX_DELAY_SHARE * len(found)))
    errors = {delay: _step_error(given, found, delay) for delay in sorted(range(-most, most + 1), key=abs)}
    best = min(errors, key=lambda delay: errors[delay])
    delay = best if errors[best] < LEAST_GAIN * errors[0] else 0
    return OdometryErrors(errors[0], delay, errors[delay])


def _step_error(given: Float[np.ndarray, "n 4 4"], found: Float[np.ndarray, "n 4 4"], delay: int) -> float:
    """Returns the median distance of motions, those of odometry taken a number of steps later."""
    late, early = max(delay, 0), max(-delay, 0)
    pairs = given[late : len(given) - early], found[early : len(found) - late]
    apart = np.linalg.norm(pairs[0][:, :3, 3] - pairs[1][:, :3, 3], axis=1)
    return float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf
