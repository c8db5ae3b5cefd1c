"""The lines of a CARMEN log: scans of the front laser in the older and the newer format, and wheel odometry.

    FLASER n r1 .. rn x y theta odom_x odom_y odom_theta ipc_timestamp host timestamp
    ROBOTLASER1 type start_angle field_of_view step max_range accuracy remission_mode n r1 .. rn m i1 .. im
        laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv forward_safety side_safety turn_axis
        ipc_timestamp host timestamp
    ODOM x y theta tv rv acceleration ipc_timestamp host timestamp

Ranges and positions are in metres, angles in radians, time in seconds.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dpmjax.io.files import read_bytes, refusing
from dpmjax.sequences import FloatArray, require

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
        time: when it was measured (ipc_timestamp); 0 where the line does not tell.
    """

    ranges: FloatArray
    angles: FloatArray
    pose: FloatArray
    odometry: FloatArray
    time: float


class CarmenLines(NamedTuple):
    """What is read of a log.

    Attributes:
        scans: in the order of the file.
        is_newer: the scans are ROBOTLASER1 lines.
        odometry: (m, 4) time, x, y, theta of the ODOM lines.
        is_of_slam: there are NEFF lines, which the SLAM program GMapping writes: the poses are its own.
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
    """Time and pose; None for a damaged line, for the scans have the odometry that is needed."""
    try:
        values = [float(words[7]), *map(float, words[1:4])]
    except (ValueError, IndexError):
        return None
    return values if np.isfinite(values).all() else None


def _check_numbers(ranges: FloatArray, others: Sequence[float], source: str) -> None:
    is_good = not np.isnan(ranges).any() and bool((np.abs(others) < _LARGEST_NUMBER).all())
    require(is_good, source, "NaN, infinite or huge values", "remove the line")
