"""Odometry of wheels or of an IMU as first guess of each motion."""

from __future__ import annotations

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.slam.front_end import FrontEndState
from dpmjax.types import Pose, Poses


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
