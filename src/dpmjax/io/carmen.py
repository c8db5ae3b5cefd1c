"""CARMEN logs: planar scans of a front laser with the pose a SLAM program gave them and the robot's odometry.

A line is `FLASER n r1 .. rn x y theta odom_x odom_y odom_theta ipc_timestamp host timestamp`: ranges in metres over 180
degrees from right to left, the corrected pose, the raw odometry. Other lines are ignored.

Published logs have two faults. Some lines carry the time stamp and odometry of another moment: the time stamps are out
of order there, and the odometry jumps by metres there and back. Those entries are interpolated. And where odometry
equals the corrected pose throughout, the raw odometry is lost: the sequence has none.
"""

from __future__ import annotations

import bisect
import gzip
import logging
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import read_bytes, refusing
from dpmjax.sequences import FloatArray, ScanSequence, require

_log = logging.getLogger(__name__)
_SHORTEST_SCALE_M = 7.9  # No laser of these logs has a shorter scale: a log that ends before has no code for "no echo".
_LONGEST_RANGE_M, _LARGEST_NUMBER = 1e6, 1e18
_CODE_BAND_M = 0.1  # Codes for "no echo" scatter by a few centimetres (81.87 to 81.91 m on a SICK LMS).


class _Line(NamedTuple):
    """One FLASER line: ranges, m; corrected pose, odometry (x, y, theta); time stamp, s."""

    ranges: FloatArray
    corrected: FloatArray
    odometry: FloatArray
    time: float


def read_carmen_log(path: str | Path, *, max_range: float | None = None) -> ScanSequence:
    """Reads a CARMEN log.

    Args:
        path: `.log`, `.clf` or their `.gz`.
        max_range: readings of this many metres or more are masked as no echo. None takes the largest reading of the
            log, less 0.1 m, if that reading is beyond 7.9 m, and masks no long reading otherwise. Readings of zero and
            below are always masked.

    Returns:
        The scans in metres; scans with fewer beams than the longest are padded with masked beams. The corrected poses
        are the reference. No times where the log's stand still.

    Raises:
        InputError: the file cannot be read, has no FLASER line, or a FLASER line lacks values or holds words that
            are no numbers.
    """
    lines = [_parse_line(words, f"{path}:{number}") for number, words in _flaser_lines(path)]
    capacity = max(len(line.ranges) for line in lines)
    points = np.zeros((len(lines), capacity, 2), np.float32)
    mask = np.zeros((len(lines), capacity), bool)
    limit = _no_echo_limit(lines) if max_range is None else max_range
    for row, valid, line in zip(points, mask, lines, strict=True):
        count = len(line.ranges)
        angles = scan_angles(count)
        valid[:count] = (line.ranges > 0) & (line.ranges < min(limit, _LONGEST_RANGE_M))
        ranges = np.where(valid[:count], line.ranges, 0.0)
        row[:count] = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    points[~mask] = 0  # no -0.0
    corrected, odometry = np.array([line.corrected for line in lines]), np.array([line.odometry for line in lines])
    has_odometry = not np.allclose(corrected, odometry, atol=1e-6)
    times, odometry = _repair(np.array([line.time for line in lines]), odometry, path)
    name, raw = Path(path).name.split(".")[0], odometry if has_odometry else None
    return ScanSequence(name, points, mask, "m", True, corrected, raw, times)


def scan_angles(num_beams: int) -> FloatArray:
    """Directions of the beams of a scan over 180 degrees, from right to left.

    An odd number of beams (181, 361) includes both ends; an even one (180, 360) has the step 180 / n and leaves out the
    left end. Consecutive scans of real logs agree best this way.

    Args:
        num_beams: number of beams.

    Returns:
        (num_beams,) radians in the sensor frame, from -pi/2 upwards.
    """
    step = np.pi / max(num_beams - 1 if num_beams % 2 else num_beams, 1)
    return -np.pi / 2 + step * np.arange(num_beams, dtype=np.float64)


def _flaser_lines(path: str | Path) -> list[tuple[int, list[str]]]:
    """Line numbers and words of the FLASER lines."""
    content = read_bytes(path)
    with refusing(path, "cannot be unpacked ({error})", "copy the file again", (OSError, EOFError, zlib.error)):
        text = (gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content).decode("latin-1")
    lines = text.splitlines()
    found = [(number, line.split()) for number, line in enumerate(lines, 1) if line.startswith("FLASER")]
    is_newer = any(line.startswith("ROBOTLASER1") for line in lines)
    what = "ROBOTLASER1 lines but no FLASER line" if is_newer else "no FLASER line"
    require(len(found) > 0, path, what, "give a CARMEN log with FLASER lines")
    return found


def _parse_line(words: list[str], source: str) -> _Line:
    advice = "a line reads FLASER n r1..rn x y theta odom_x odom_y odom_theta timestamp host timestamp"
    with refusing(source, "not a FLASER line ({error})", advice, (ValueError, IndexError, OverflowError)):
        count = int(words[1])
        values = np.array(words[2 : 2 + count + 6], np.float64)
        time = float(words[count + 8]) if len(words) > count + 8 else 0.0
    found = f"{len(words) - 2} values after n = {count}, at least {count + 6} expected"
    require(count >= 1 and len(values) >= count + 6, source, found, advice)
    is_good = not np.isnan(values).any() and (np.abs([*values[count:], time]) < _LARGEST_NUMBER).all()
    require(is_good, source, "NaN, infinite or huge values", "remove the line")
    return _Line(values[:count], values[count : count + 3], values[count + 3 :], time)


def _no_echo_limit(lines: list[_Line]) -> float:
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
