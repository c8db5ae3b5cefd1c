"""CARMEN logs: planar scans of a front laser, the robot's odometry, and the poses that a SLAM program gave them.

A scan has two poses (`carmen_lines`). A log as recorded has both at the places of its ODOM lines: they are the raw
odometry, and there is no reference. In a log that a SLAM program has corrected, the first pose is the reference and the
second the raw odometry; where both are equal, the raw odometry is lost.

Some published logs have lines with the time stamp and odometry of another moment: the time stamps are out of order
there, and the odometry jumps by metres there and back. Those entries are interpolated.
"""

from __future__ import annotations

import bisect
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.io.carmen_lines import CarmenLines, ScanLine, read_carmen_lines
from dpmjax.sequences import FloatArray, ScanSequence

_log = logging.getLogger(__name__)
_SHORTEST_SCALE_M = 7.9  # No laser of these logs has a shorter scale: a log that ends before has no code for "no echo".
_LONGEST_RANGE_M = 1e6
# Poses of a log as recorded are those of its ODOM lines, within the way from one such line to the next.
_SAME_PLACE_M = 0.5
# Equal poses, metres and radians.
_SAME_POSE = 1e-4
_CODE_BAND_M = 0.1  # Codes for "no echo" scatter by a few centimetres (81.87 to 81.91 m on a SICK LMS).


def read_carmen_log(path: str | Path, *, max_range: float | None = None) -> ScanSequence:
    """Reads a CARMEN log.

    Args:
        path: `.log`, `.clf` or their `.gz`.
        max_range: readings of this many metres or more are masked as no echo. None takes the largest reading of the
            log, less 0.1 m, if that reading is beyond 7.9 m, and masks no long reading otherwise. Readings of zero and
            below are always masked.

    Returns:
        The scans in metres; scans with fewer beams than the longest are padded with masked beams. Poses are those of
        the laser; the corrected ones are the reference. No times where the log's stand still.

    Raises:
        InputError: the file cannot be read, has no FLASER and no ROBOTLASER1 line, or one lacks values or holds words
            that are no numbers.
    """
    log = read_carmen_lines(path)
    lines = log.scans
    capacity = max(len(line.ranges) for line in lines)
    points = np.zeros((len(lines), capacity, 2), np.float32)
    mask = np.zeros((len(lines), capacity), bool)
    limit = _no_echo_limit(lines) if max_range is None else max_range
    for row, valid, line in zip(points, mask, lines, strict=True):
        count = len(line.ranges)
        valid[:count] = (line.ranges > 0) & (line.ranges < min(limit, _LONGEST_RANGE_M))
        ranges = np.where(valid[:count], line.ranges, 0.0)
        row[:count] = ranges[:, None] * np.column_stack([np.cos(line.angles), np.sin(line.angles)])
    points[~mask] = 0  # no -0.0
    reference, odometry = _reference_and_odometry(log)
    stamps = np.array([line.time for line in lines])
    times, repaired = _repair(stamps, np.zeros((len(lines), 3)) if odometry is None else odometry, path)
    raw = None if odometry is None else repaired
    return ScanSequence(Path(path).name.split(".")[0], points, mask, "m", True, reference, raw, times)


def _reference_and_odometry(log: CarmenLines) -> tuple[FloatArray | None, FloatArray | None]:
    poses, odometry = np.array([line.pose for line in log.scans]), np.array([line.odometry for line in log.scans])
    if log.is_newer:
        # The second pose is that of the robot, on which the laser is fixed somewhere.
        mounting = np.median(se2.relative(odometry, poses), axis=0)
        odometry = np.asarray(se2.compose(odometry, np.broadcast_to(mounting, odometry.shape)))
    are_equal = bool(np.abs(poses - odometry).max() < _SAME_POSE)
    if not log.is_of_slam and ((are_equal and log.is_newer) or _is_at_wheels(log, poses)):
        return None, odometry
    return poses, None if are_equal else odometry


def _is_at_wheels(log: CarmenLines, poses: FloatArray) -> bool:
    """Whether most poses lie where the ODOM line next in time is."""
    if not len(log.odometry):
        return False
    ordered = log.odometry[np.argsort(log.odometry[:, 0], kind="stable")]
    after = np.searchsorted(ordered[:, 0], [line.time for line in log.scans])
    nearest = ordered[np.clip(after, 0, len(ordered) - 1)]
    return float(np.median(np.hypot(*(nearest[:, 1:3] - poses[:, :2]).T))) < _SAME_PLACE_M


def _no_echo_limit(lines: list[ScanLine]) -> float:
    largest = max(float(line.ranges.max()) for line in lines)
    return largest - _CODE_BAND_M if largest >= _SHORTEST_SCALE_M else np.inf


def _repair(times: FloatArray, odometry: FloatArray, path: str | Path) -> tuple[FloatArray | None, FloatArray]:
    """Interpolates time and odometry where the time stamp is out of order; no times where they stand still."""
    if np.ptp(times) == 0:
        return None, odometry
    trusted = _longest_increasing(times)
    num_wrong = len(times) - len(trusted)
    if 2 * num_wrong > len(times):
        _log.warning("%s: time stamps are in no order; odometry is taken as it stands, times are dropped", path)
        return None, odometry
    if num_wrong:
        message = "%s: %d of %d lines carry time and odometry of another moment; both are interpolated"
        _log.warning(message, path, num_wrong, len(times))
    index = np.arange(len(times))
    pose = odometry[trusted].copy()
    pose[:, 2] = np.unwrap(pose[:, 2])
    repaired = np.column_stack([np.interp(index, trusted, column) for column in pose.T])
    repaired[:, 2] = np.pi - (np.pi - repaired[:, 2]) % (2 * np.pi)
    repaired[trusted] = odometry[trusted]
    return np.interp(index, trusted, times[trusted]), repaired


def _longest_increasing(values: FloatArray) -> NDArray[np.int64]:
    """Indices of the longest subsequence that strictly increases (patience sorting)."""
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
