"""Errors of odometry against the trajectory of a finished map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid

# Largest delay that is tried, in scans and as a share of the drive, and least share by which it must lower the error.
MAX_DELAY, MAX_DELAY_SHARE, LEAST_GAIN = 30, 0.25, 0.5


class OdometryErrors(NamedTuple):
    """Comparison of odometry with the trajectory of a map.

    Attributes:
        step: median error of a motion of odometry between two scans, in the unit of the poses.
        delay_scans: number of scans by which the stamps of odometry are late; negative if they are early.
        undelayed_step: the median error without this delay.
    """

    step: float
    delay_scans: int
    undelayed_step: float


def compare_odometry(
    odometry: Float[np.ndarray, "n d1 d1"], T_world_scan: Float[np.ndarray, "n d1 d1"]
) -> OdometryErrors:
    """Compares the motions of odometry with those of a map, at once and shifted in time.

    Args:
        odometry: (n, d+1, d+1) poses of the sensor, NaN where there is none.
        T_world_scan: (n, d+1, d+1) poses of the same scans in the map.

    Returns:
        The errors.
    """
    given, found = (rigid.inverse(T[:-1]) @ T[1:] for T in (odometry, T_world_scan))
    most = min(MAX_DELAY, int(MAX_DELAY_SHARE * len(found)))
    errors = {delay: _step_error(given, found, delay) for delay in sorted(range(-most, most + 1), key=abs)}
    best = min(errors, key=lambda delay: errors[delay])
    delay = best if errors[best] < LEAST_GAIN * errors[0] else 0
    return OdometryErrors(errors[0], delay, errors[delay])


def _step_error(given: Float[np.ndarray, "n d1 d1"], found: Float[np.ndarray, "n d1 d1"], delay: int) -> float:
    """Returns the median distance of motions, those of odometry taken a number of steps later."""
    late, early = max(delay, 0), max(-delay, 0)
    pairs = given[late : len(given) - early], found[early : len(found) - late]
    apart = np.linalg.norm(pairs[0][:, :-1, -1] - pairs[1][:, :-1, -1], axis=1)
    return float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf
