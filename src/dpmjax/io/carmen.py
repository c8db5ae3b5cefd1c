"""CARMEN logs: planar scans of a front laser, the robot's odometry, and poses by a SLAM program.

A scan has two poses. A log as recorded has both at the places of its ODOM lines: they are the raw
odometry, and there is no reference. In a log that a SLAM program has corrected, the first pose is the reference and the
second the raw odometry; where both are equal, the raw odometry is lost.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.io.files import read_bytes, refusing
from dpmjax.io.log_order import in_order_of_time
from dpmjax.sequences import FloatArray, ScanSequence, require

_LARGEST_NUMBER = 1e18
_FLASER = "a line reads FLASER n r1..rn x y theta odom_x odom_y odom_theta timestamp host timestamp"
_ROBOTLASER1 = (
    "a line reads ROBOTLASER1 type start_angle field_of_view step max_range accuracy remission_mode n r1..rn m i1..im "
    "laser_x laser_y laser_theta robot_x robot_y robot_theta, five more numbers, timestamp host timestamp"
)
# Words of a ROBOTLASER1 line before its ranges, and after its poses up to the last time stamp.
_HEAD, _TAIL = 9, 8


class ScanLine(NamedTuple):
    """One scan.

    Attributes:
        ranges: metres.
        angles: directions of the beams, radians, counter-clockwise from straight ahead.
        pose: x, y, theta of the laser.
        odometry: x, y, theta of the robot by its wheels.
        time: time of the measurement (ipc_timestamp); 0 where the line has none.
    """

    ranges: FloatArray
    angles: FloatArray
    pose: FloatArray
    odometry: FloatArray
    time: float


class CarmenLines(NamedTuple):
    """Contents of a log.

    Attributes:
        scans: scans in the order of the file.
        is_newer: True where the scans are ROBOTLASER1 lines.
        odometry: (m, 4) time, x, y, theta of the ODOM lines.
        is_of_slam: True where there are NEFF lines of the SLAM program GMapping, so that the poses are its result.
    """

    scans: list[ScanLine]
    is_newer: bool
    odometry: FloatArray
    is_of_slam: bool


def read_carmen_lines(path: str | Path) -> CarmenLines:
    """Reads the lines of a log: FLASER lines, or ROBOTLASER1 lines where there is no FLASER line.

    Args:
        path: text, also packed by gzip.

    Returns:
        At least one scan.

    Raises:
        InputError: the file cannot be read, has no such line, or one lacks values or holds words that are no numbers.
    """
    content = read_bytes(path)
    with refusing(path, "cannot be unpacked ({error})", "copy the file again", (OSError, EOFError, zlib.error)):
        text = (gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content).decode("latin-1")
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1)]
    found, newer, wheels, slam = (
        [(number, words) for number, words in lines if words[:1] == [kind]]
        for kind in ("FLASER", "ROBOTLASER1", "ODOM", "NEFF")
    )
    is_newer = not found
    found = found or newer
    require(len(found) > 0, path, "no FLASER and no ROBOTLASER1 line", "give a CARMEN log of a front laser")
    parse = _parse_newer if is_newer else _parse_older
    scans = [parse(words, f"{path}:{number}") for number, words in found]
    odometry = [values for _, words in wheels if (values := _parse_odometry(words)) is not None]
    return CarmenLines(scans, is_newer, np.array(odometry, np.float64).reshape(-1, 4), bool(slam))


def scan_angles(num_beams: int) -> FloatArray:
    """Returns the directions of the beams of a scan over 180 degrees, from right to left.

    An odd number of beams (181, 361) includes both ends; an even one (180, 360) has the step 180 / n and leaves out the
    left end. Consecutive scans of real logs agree best this way.

    Args:
        num_beams: number of beams.

    Returns:
        (num_beams,) radians in the sensor frame, from -pi/2 upwards.
    """
    step = np.pi / max(num_beams - 1 if num_beams % 2 else num_beams, 1)
    return -np.pi / 2 + step * np.arange(num_beams, dtype=np.float64)


def _parse_older(words: list[str], source: str) -> ScanLine:
    with refusing(source, "not a FLASER line ({error})", _FLASER, (ValueError, IndexError, OverflowError)):
        count = int(words[1])
        values = np.array(words[2 : 2 + count + 6], np.float64)
        time = float(words[count + 8]) if len(words) > count + 8 else 0.0
    found = f"{len(words) - 2} values after n = {count}, at least {count + 6} expected"
    require(count >= 1 and len(values) >= count + 6, source, found, _FLASER)
    _check_numbers(values[:count], [*values[count:], time], source)
    return ScanLine(values[:count], scan_angles(count), values[count : count + 3], values[count + 3 :], time)


def _parse_newer(words: list[str], source: str) -> ScanLine:
    with refusing(source, "not a ROBOTLASER1 line ({error})", _ROBOTLASER1, (ValueError, IndexError, OverflowError)):
        start, step, count = float(words[2]), float(words[4]), int(words[8])
        ranges: FloatArray = np.array(words[_HEAD : _HEAD + count], np.float64)
        first = _HEAD + count + 1 + int(words[_HEAD + count])
        poses = np.array(words[first : first + 6], np.float64)
        time = float(words[first + 6 + 5]) if len(words) >= first + 6 + _TAIL else 0.0
    found = f"{len(words)} words for {count} ranges"
    require(count >= 1 and len(ranges) == count and len(poses) == 6, source, found, _ROBOTLASER1)
    require(step > 0 and abs(start) < 7, source, f"angles from {start} by {step} radians", _ROBOTLASER1)
    _check_numbers(ranges, [start, step, *poses, time], source)
    angles = start + step * np.arange(count, dtype=np.float64)
    return ScanLine(ranges, angles, poses[:3], poses[3:], time)


def _parse_odometry(words: list[str]) -> list[float] | None:
    """Parses time and pose; None for a damaged line, because scans have odometry of their own."""
    try:
        values = [float(words[7]), *map(float, words[1:4])]
    except (ValueError, IndexError):
        return None
    return values if np.isfinite(values).all() else None


def _check_numbers(ranges: FloatArray, others: Sequence[float], source: str) -> None:
    is_good = not np.isnan(ranges).any() and bool((np.abs(others) < _LARGEST_NUMBER).all())
    require(is_good, source, "NaN, infinite or huge values", "remove the line")


_SHORTEST_SCALE_M = 7.9  # Least range of the code for "no echo" of the lasers of these logs.
_LONGEST_RANGE_M = 1e6
# Poses of a log as recorded are those of its ODOM lines, within the distance from one such line to the next.
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
        the laser; the corrected ones are the reference. No times where the log's stand still. Lines of another moment
        are in the order of time; the reference of such a scan follows from the one before by the odometry.

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
    times = np.array([line.time for line in lines])
    sequence = ScanSequence(Path(path).name.split(".")[0], points, mask, "m", True, reference, odometry, times)
    return in_order_of_time(sequence, path)


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
    """Returns True where most poses lie at the ODOM line next in time."""
    if not len(log.odometry):
        return False
    ordered = log.odometry[np.argsort(log.odometry[:, 0], kind="stable")]
    after = np.searchsorted(ordered[:, 0], [line.time for line in log.scans])
    nearest = ordered[np.clip(after, 0, len(ordered) - 1)]
    return float(np.median(np.hypot(*(nearest[:, 1:3] - poses[:, :2]).T))) < _SAME_PLACE_M


def _no_echo_limit(lines: list[ScanLine]) -> float:
    largest = max(float(line.ranges.max()) for line in lines)
    return largest - _CODE_BAND_M if largest >= _SHORTEST_SCALE_M else np.inf
