"""The order of the lines of a log by their time stamps.

Some published logs have lines with the scan, time stamp and odometry of another time, while their corrected poses are
in order. There the time stamps are out of order, and the odometry jumps by metres and back. These scans are sorted by
time.
"""

from __future__ import annotations

import bisect
import dataclasses
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.sequences import BoolArray, FloatArray, ScanSequence

_log = logging.getLogger(__name__)
# A line is moved to the position of its time stamp if that shortens the detour of its odometry to this share.
_SHORTER_WAY = 0.5


def in_order_of_time(sequence: ScanSequence, path: str | Path) -> ScanSequence:
    """Moves scans of another time to the positions of their time stamps.

    Args:
        sequence: scans in the order of the lines, with their time stamps.
        path: of the log, for warnings.

    Returns:
        The scans in the order of time. Time and odometry are interpolated where the stamp alone is wrong. No times
        where all stamps are equal or have no order.
    """
    times, odometry, rows = sequence.times, sequence.odometry_poses, np.arange(len(sequence))
    assert times is not None
    if np.ptp(times) == 0:
        return dataclasses.replace(sequence, times=None)
    ordered = _longest_increasing(times)
    late = np.setdiff1d(rows, ordered)
    if 2 * len(late) > len(times):
        _log.warning("%s: time stamps are in no order; lines stay in their order, times are dropped", path)
        return dataclasses.replace(sequence, times=None)
    moved = np.zeros(len(times), bool)
    if odometry is not None:
        by_row, by_time = (_detours(odometry, late, ordered, keys) for keys in (rows.astype(np.float64), times))
        moved[late] = by_time < _SHORTER_WAY * by_row
    if len(late):
        message = "%s: %d of %d lines are of another moment; %d are moved to their time, the others are interpolated"
        _log.warning(message, path, len(late), len(times), moved.sum())
    known = np.union1d(ordered, np.flatnonzero(moved))
    stamps = np.interp(rows, ordered, times[ordered])
    stamps[known] = times[known]
    order = np.argsort(stamps, kind="stable")
    if odometry is not None:
        odometry = _interpolated(odometry, ordered, known)
    repaired = dataclasses.replace(sequence, times=stamps, odometry_poses=odometry)
    return _carry_reference(repaired.take(order), moved[order])


def _interpolated(odometry: FloatArray, ordered: NDArray[np.int64], known: NDArray[np.int64]) -> FloatArray:
    """Interpolates unknown odometry between the ordered lines."""
    pose = odometry[ordered].copy()
    pose[:, 2] = np.unwrap(pose[:, 2])
    between = np.column_stack([np.interp(np.arange(len(odometry)), ordered, column) for column in pose.T])
    between[:, 2] = np.pi - (np.pi - between[:, 2]) % (2 * np.pi)
    between[known] = odometry[known]
    return between


def _detours(odometry: FloatArray, late: NDArray[np.int64], ordered: NDArray[np.int64], keys: FloatArray) -> FloatArray:
    """Computes the increase of the path length by each late line, inserted at the position of its key."""
    after = np.searchsorted(keys[ordered], keys[late])
    before, after = ordered[np.maximum(after - 1, 0)], ordered[np.minimum(after, len(ordered) - 1)]

    def way(start: NDArray[np.int64], end: NDArray[np.int64]) -> FloatArray:
        step = se2.relative(odometry[start], odometry[end])
        return np.hypot(step[:, 0], step[:, 1]) + np.abs(se2.wrap_angle(step[:, 2]))

    return way(before, late) + way(late, after) - way(before, after)


def _carry_reference(sequence: ScanSequence, moved: BoolArray) -> ScanSequence:
    """Computes the reference of moved scans from the reference before and the odometry."""
    reference, odometry = sequence.reference_poses, sequence.odometry_poses
    if reference is None or odometry is None or not moved.any():
        return sequence
    rows = np.arange(len(moved))
    before = np.maximum.accumulate(np.where(moved, -1, rows))
    before = np.where(before < 0, np.flatnonzero(~moved)[0], before)
    carried = se2.compose(reference[before], se2.relative(odometry[before], odometry))
    return dataclasses.replace(sequence, reference_poses=np.where(moved[:, None], carried, reference))


def _longest_increasing(values: FloatArray) -> NDArray[np.int64]:
    """Finds the indices of the longest strictly increasing subsequence (patience sorting)."""
    tails: list[float] = []
    ends: list[int] = []
    before = np.full(len(values), -1)
    for index, value in enumerate(values.tolist()):
        pile = bisect.bisect_left(tails, value)
        tails[pile : pile + 1] = [value]
        ends[pile : pile + 1] = [index]
        before[index] = ends[pile - 1] if pile else -1
    chain = [ends[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])
