"""Errors of a trajectory against hand-checked relations between its scans (Kümmerle et al. 2009).

The relations replace a ground truth: each says where the robot was at one time, seen from where it was at another one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import se2
from dpmjax.sequences import Relations


class RelationErrors(NamedTuple):
    """Errors of a trajectory.

    Attributes:
        translation_m: (u,) length of the error of each relation that was used.
        rotation_deg: (u,) and its angle.
        is_used: (r,) False for relations with a time of which there is no scan.
    """

    translation_m: Float[np.ndarray, " u"]
    rotation_deg: Float[np.ndarray, " u"]
    is_used: np.ndarray


def relation_errors(
    relations: Relations,
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 3"],
    *,
    tolerance_s: float = 0.005,
) -> RelationErrors:
    """Compares a trajectory with relations; the benchmark reports the mean of each kind of error.

    Args:
        relations: of the same recording.
        times: of the scans, seconds, of the same clock.
        poses: x, y, heading of T_world_scan, metres.
        tolerance_s: a scan is that of a relation if its time is so near.

    Returns:
        The errors.

    Raises:
        ValueError: if no relation has its scans, or if the lengths differ.
    """
    if len(times) != len(poses):
        raise ValueError(f"poses: expected {len(times)}, one for each time, got {len(poses)}")
    order = np.argsort(times, kind="stable")
    rows, is_used = [], np.ones(len(relations.times_from), bool)
    for wanted in (relations.times_from, relations.times_to):
        after = np.clip(np.searchsorted(times[order], wanted), 1, max(len(times) - 1, 1))
        pair = order[np.minimum(np.stack([after - 1, after]), len(times) - 1)]
        nearest = np.take_along_axis(pair, np.abs(times[pair] - wanted).argmin(axis=0)[None], axis=0)[0]
        is_used &= np.abs(times[nearest] - wanted) <= tolerance_s
        rows.append(nearest)
    if not is_used.any():
        raise ValueError("relations: expected times of the scans, no relation has both of its scans")
    found = se2.relative(poses[rows[0]], poses[rows[1]])[is_used]
    error = np.asarray(se2.relative(relations.T_from_to[is_used], found), np.float64)
    return RelationErrors(np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(se2.wrap_angle(error[:, 2]))), is_used)
