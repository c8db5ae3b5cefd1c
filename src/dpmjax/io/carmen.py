"""CARMEN logs: planar scans of a front laser, the robot's odometry, and poses by a SLAM program.

A scan has two poses. A log as recorded has both at the places of its ODOM lines: they are the raw odometry, and there
is no reference. In a log that a SLAM program has corrected, the first pose is the reference and the second the raw
odometry; where both are equal, the raw odometry is lost.
"""

from __future__ import annotations

import bisect
import dataclasses
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.io.files import is_number, read_lines, refusing
from dpmjax.sequences import BoolArray, FloatArray, ScanSequence, pad_scans, require

_log = logging.getLogger(__name__)
_FORMS = {
    "FLASER": "a line reads FLASER n r1..rn x y theta odom_x odom_y odom_theta timestamp host timestamp",
    "ROBOTLASER1": "a line has 7 numbers of the laser, n r1..rn, m i1..im, poses of laser and robot, 5 numbers, times",
}


class _Scan(NamedTuple):
    """A scan: ranges (b,) m at angles (b,) from straight ahead, x y theta of laser and robot, time (0 for none)."""

    ranges: FloatArray
    angles: FloatArray
    pose: FloatArray
    odometry: FloatArray
    time: float


def read_carmen_log(path: str | Path) -> ScanSequence:
    """Reads a CARMEN log: its FLASER lines, or its ROBOTLASER1 lines where there is no FLASER line.

    Args:
        path: `.log`, `.clf` or their `.gz`.

    Returns:
        The scans in metres; scans with fewer beams than the longest are padded with masked beams. Masked as no echo
        are readings of zero and below, and those within 0.1 m of the largest reading of the log, if that is beyond
        7.9 m. Poses are those of the laser; the corrected ones are the reference. No times where the log's stand still.
        Lines of another moment are in the order of time; the reference of such a scan follows from the one before by
        the odometry.

    Raises:
        InputError: the file cannot be read, has no FLASER and no ROBOTLASER1 line, or one lacks values or holds words
            that are no numbers.
    """
    lines: dict[str, list[tuple[int, list[str]]]] = {kind: [] for kind in (*_FORMS, "ODOM", "NEFF")}
    for number, words in enumerate(map(str.split, read_lines(path)), 1):
        if words and words[0] in lines:
            lines[words[0]].append((number, words))
    is_newer = not lines["FLASER"]
    found = lines["ROBOTLASER1"] if is_newer else lines["FLASER"]
    require(len(found) > 0, path, "no FLASER and no ROBOTLASER1 line", "give a CARMEN log of a front laser")
    if not is_newer and lines["ROBOTLASER1"]:
        _log.warning("%s: only its FLASER lines are read, its ROBOTLASER1 lines are left out", path)
    scans = [_parse_scan(words, f"{path}:{number}") for number, words in found]
    largest = max(float(scan.ranges.max()) for scan in scans)
    # Codes for "no echo" are 7.9 m and more, and scatter by a few centimetres (81.87 to 81.91 m on a SICK LMS).
    limit = min(largest - 0.1 if largest >= 7.9 else np.inf, 1e6)
    ends = [
        np.where((scan.ranges > 0) & (scan.ranges < limit), scan.ranges, np.nan)[:, None]
        * np.column_stack([np.cos(scan.angles), np.sin(scan.angles)])
        for scan in scans
    ]
    points, mask = pad_scans(ends)
    poses, odometry, times = (np.array(x) for x in zip(*((s.pose, s.odometry, s.time) for s in scans), strict=True))
    if is_newer:
        # The second pose is that of the robot, on which the laser is fixed somewhere.
        mounting = np.median(se2.relative(odometry, poses), axis=0)
        odometry = np.asarray(se2.compose(odometry, np.broadcast_to(mounting, odometry.shape)))
    are_equal = bool(np.abs(poses - odometry).max() < 1e-4)
    # NEFF lines are those of the SLAM program GMapping.
    is_raw = (are_equal and is_newer) or _is_at_wheels([words for _, words in lines["ODOM"]], poses, times)
    reference = None if is_raw and not lines["NEFF"] else poses
    wheels = None if are_equal and reference is not None else odometry
    sequence = ScanSequence(Path(path).name.split(".")[0], points, mask, "m", reference, wheels, times)
    return _in_order_of_time(sequence, path)


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


def _parse_scan(words: list[str], source: str) -> _Scan:
    """Reads the words of a FLASER or a ROBOTLASER1 line."""
    is_newer = words[0] == "ROBOTLASER1"
    first = 9 if is_newer else 2
    found, kinds = f"not a {words[0]} line ({{error}})", (ValueError, IndexError, OverflowError)
    with refusing(source, found, _FORMS[words[0]], kinds):
        count = int(words[first - 1])
        if count < 1:
            raise ValueError(f"n = {count}")
        ranges, angles = np.array(words[first : first + count], np.float64), scan_angles(count)
        first += count
        if is_newer:
            angles = float(words[2]) + float(words[4]) * np.arange(count, dtype=np.float64)
            first += 1 + int(words[first])  # after the remissions
            if not float(words[4]) > 0 or abs(float(words[2])) >= 7:
                raise ValueError(f"angles from {words[2]} by {words[4]} radians")
        poses = np.array(words[first : first + 6], np.float64)
        stamp = first + 11 if is_newer else first + 6
        time = float(words[stamp]) if len(words) > stamp else 0.0
        if len(ranges) != count or len(poses) != 6:
            raise ValueError(f"{len(words)} words for {count} ranges")
        if np.isnan(ranges).any() or not (np.abs([*angles, *poses, time]) < 1e18).all():
            raise ValueError("NaN, infinite or huge values")
    return _Scan(ranges, angles, poses[:3], poses[3:], time)


def _is_at_wheels(lines: list[list[str]], poses: FloatArray, times: FloatArray) -> bool:
    """Returns True if most laser poses coincide with an ODOM line beside them in time; damaged lines do not count."""
    rows = [(words[7], *words[1:3]) for words in lines if len(words) > 7]
    wheels = np.array([[float(word) for word in row] for row in rows if all(map(is_number, row))]).reshape(-1, 3)
    wheels = wheels[np.isfinite(wheels).all(axis=1)]
    if not len(wheels):
        return False
    ordered = wheels[np.argsort(wheels[:, 0], kind="stable")]
    after = np.searchsorted(ordered[:, 0], times)
    beside = ordered[np.clip([after - 1, after], 0, len(ordered) - 1), 1:]
    # Poses of a log as recorded differ from those of its ODOM lines by the way from one such line to the next.
    return float(np.median(np.linalg.norm(beside - poses[:, :2], axis=-1).min(axis=0))) < 0.5


def _in_order_of_time(sequence: ScanSequence, path: str | Path) -> ScanSequence:
    """Moves scans of another time to the positions of their time stamps.

    Some published logs have lines with the scan, time stamp and odometry of another time, while their corrected poses
    are in order. There the time stamps are out of order, and the odometry jumps by metres and back. Where the stamp
    alone is wrong, the time is interpolated, and the odometry, too, if it jumps. Without any order of the stamps the
    sequence gets no times.

    Returns:
        The scans in the order of time.
    """
    stamps, rows = np.array(sequence.times), np.arange(len(sequence))
    times = _with_one_clock(stamps.copy())
    if not np.array_equal(times, stamps):
        _log.warning("%s: the clock was set back; lines stay in their order, later times are continued", path)
    ordered = _longest_ascending(times)
    late = np.setdiff1d(rows, ordered)
    if 2 * len(late) > len(times):
        _log.warning("%s: time stamps are in no order; lines stay in their order, times are dropped", path)
    if np.ptp(times) == 0 or 2 * len(late) > len(times):
        return dataclasses.replace(sequence, times=None)
    given = sequence.odometry_poses
    odometry = np.zeros((len(rows), 3)) if given is None else given
    by_row, by_time = (_detours(odometry, late, ordered, keys) for keys in (rows.astype(np.float64), times))
    # A line is moved to the position of its time stamp if that halves the detour of its odometry.
    is_moved = np.isin(rows, late[by_time < 0.5 * by_row])
    if len(late):
        message = "%s: %d of %d lines are of another moment; %d are moved to their time, the others are interpolated"
        _log.warning(message, path, len(late), len(times), is_moved.sum())
    is_known = is_moved | np.isin(rows, ordered)
    stamps = np.where(is_known, times, np.interp(rows, ordered, times[ordered]))
    if given is not None:
        # Lines that join lines in order by usual steps alone have the odometry of their place.
        lengths = _step_lengths(odometry[:-1], odometry[1:])
        # Steps of up to four times the median are no jumps.
        piece = np.concatenate([[0], np.cumsum(lengths > 4.0 * np.median(lengths))])
        is_right = is_known | np.isin(piece, piece[ordered])
        heading = np.unwrap(odometry[ordered, 2])
        columns = (*odometry[ordered, :2].T, heading)
        between = np.column_stack([np.interp(rows, ordered, column) for column in columns])
        between[:, 2] = np.pi - (np.pi - between[:, 2]) % (2 * np.pi)
        odometry = np.where(is_right[:, None], odometry, between)
    order = np.argsort(stamps, kind="stable")
    poses = None if given is None else odometry
    repaired = dataclasses.replace(sequence, times=stamps, odometry_poses=poses).take(order)
    return _carry_reference(repaired, is_moved[order])


def _with_one_clock(times: FloatArray) -> FloatArray:
    """Continues the times where a clock was set back: all later stamps precede half of those before it."""
    steps = np.diff(times)
    for last in np.flatnonzero(steps < 0):
        if times[last + 1 :].max() < np.median(times[: last + 1]):
            times[last + 1 :] += times[last] - times[last + 1] + np.median(steps)
    return times


def _step_lengths(start: FloatArray, end: FloatArray) -> FloatArray:
    """Computes the lengths of motions, metres and radians added."""
    step = se2.relative(start, end)
    return np.asarray(np.hypot(step[:, 0], step[:, 1]) + np.abs(se2.wrap_angle(step[:, 2])))


def _detours(odometry: FloatArray, late: NDArray[np.int64], ordered: NDArray[np.int64], keys: FloatArray) -> FloatArray:
    """Computes the increase of the path length by each late line, inserted at the position of its key."""
    after = np.searchsorted(keys[ordered], keys[late])
    before, after = ordered[np.maximum(after - 1, 0)], ordered[np.minimum(after, len(ordered) - 1)]
    start, middle, end = odometry[before], odometry[late], odometry[after]
    return _step_lengths(start, middle) + _step_lengths(middle, end) - _step_lengths(start, end)


def _carry_reference(sequence: ScanSequence, is_moved: BoolArray) -> ScanSequence:
    """Computes the reference of moved scans from the reference before and the odometry."""
    reference, odometry = sequence.reference_poses, sequence.odometry_poses
    if reference is None or odometry is None or not is_moved.any():
        return sequence
    kept = np.flatnonzero(~is_moved)
    before = kept[np.maximum(np.searchsorted(kept, np.arange(len(is_moved)), side="right") - 1, 0)]
    carried = se2.compose(reference[before], se2.relative(odometry[before], odometry))
    return dataclasses.replace(sequence, reference_poses=np.where(is_moved[:, None], carried, reference))


def _longest_ascending(values: FloatArray) -> NDArray[np.int64]:
    """Finds the indices of the longest subsequence that never falls (patience sorting)."""
    tails: list[float] = []
    chains: list[Any] = []
    for index, value in enumerate(values.tolist()):
        pile = bisect.bisect_right(tails, value)
        tails[pile : pile + 1] = [value]
        chains[pile : pile + 1] = [(index, chains[pile - 1] if pile else None)]
    link, found = chains[-1], []
    while link is not None:
        index, link = link
        found.append(index)
    return np.array(found[::-1])
