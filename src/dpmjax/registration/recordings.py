"""Whole recordings: the scans that are registered, and poses for all the others.

A robot's log has thousands of scans, most of them a hand's breadth from the one before. Only those are registered that
lie some way or turn apart; each other scan follows the odometry between the two around it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dpmjax.checks import require_positive
from dpmjax.geometry import se2
from dpmjax.registration.planar_scans import Floats, Indices


def choose_by_motion(odometry: Float[np.ndarray, "n 3"], min_distance: float, min_turn: float) -> Indices:
    """Chooses scans that lie apart; a robot that stands still adds none.

    Args:
        odometry: poses x, y, heading of all scans, in the order of time.
        min_distance: a scan is chosen where it lies at least so far from the one chosen before ...
        min_turn: ... or is turned at least so far against it, radians.

    Returns:
        Rows of the chosen scans in order; the first and the last scan are among them.

    Raises:
        ValueError: if there is no scan, or if a limit is not positive.
    """
    require_positive("min_distance", min_distance)
    require_positive("min_turn", min_turn)
    if len(odometry) == 0:
        raise ValueError("odometry: expected at least one pose, got none")
    chosen = [0]
    for row in range(1, len(odometry)):
        x, y, heading = odometry[row] - odometry[chosen[-1]]
        if np.hypot(x, y) >= min_distance or abs(se2.wrap_angle(heading)) >= min_turn:
            chosen.append(row)
    if chosen[-1] != len(odometry) - 1:
        chosen.append(len(odometry) - 1)
    return np.array(chosen, np.int64)


def fill_between(chosen: Indices, poses: Float[np.ndarray, "k 3"], odometry: Float[np.ndarray, "n 3"]) -> Floats:
    """Returns poses of all scans: those of the chosen ones, and odometry in between, corrected at both ends.

    What odometry is off by at the next chosen scan is spread over the scans before it, in proportion to the way and the
    turns until there.

    Args:
        chosen: rows of k scans in order, the first and the last scan among them.
        poses: T_world_scan of these, x, y, heading.
        odometry: of all n scans.

    Returns:
        (n, 3) T_world_scan; the given ones at `chosen`, to rounding.

    Raises:
        ValueError: if the rows do not begin at the first scan, end at the last one, and increase.
    """
    if chosen[0] != 0 or chosen[-1] != len(odometry) - 1 or (np.diff(chosen) < 1).any():
        raise ValueError(f"chosen: expected increasing rows from 0 to {len(odometry) - 1}")
    before = np.clip(np.searchsorted(chosen, np.arange(len(odometry)), side="right") - 1, 0, max(len(chosen) - 2, 0))
    after = np.minimum(before + 1, len(chosen) - 1)
    start, end = chosen[before], chosen[after]
    # All in the frame of the chosen scan before: where odometry puts the next one, and how far off that is.
    T_before_after = se2.relative(odometry[start], odometry[end])
    error = se2.relative(T_before_after, se2.relative(poses[before], poses[after]))
    part = _exp(_share_of_way(odometry, start, end)[:, None] * np.asarray(se2.log(error), np.float64))
    correction = se2.compose(se2.compose(T_before_after, part), se2.inverse(T_before_after))
    T_before_scan = se2.compose(correction, se2.relative(odometry[start], odometry))
    filled = np.asarray(se2.compose(poses[before], T_before_scan), np.float64)
    filled[chosen] = poses
    return filled


def _share_of_way(odometry: Floats, start: Indices, end: Indices) -> Floats:
    """Returns how much of the way from `start` to `end` each scan has behind it; turns count as a metre a radian."""
    steps = se2.relative(odometry[:-1], odometry[1:])
    lengths = np.hypot(steps[:, 0], steps[:, 1]) + np.abs(se2.wrap_angle(steps[:, 2])) + 1e-9
    way = np.append(0.0, np.cumsum(lengths))
    return np.asarray((way - way[start]) / np.maximum(way[end] - way[start], 1e-9), np.float64)


def _exp(tangent: Floats) -> Floats:
    return np.asarray(se2.from_matrix(np.asarray(se2.exp(tangent), np.float64)), np.float64)
