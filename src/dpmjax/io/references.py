"""Times and reference poses of the scans of a drive: matched by time where both have times, else by their counts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.io.files import read_table
from dpmjax.io.poses import StampedPoses, interpolate_poses, read_poses
from dpmjax.io.scan_names import last_numbers, stamps_in_names
from dpmjax.sequences import FloatArray, InputError, Note, Relations, counted, require

# Stamps since 1970 and steps of stamps from 0, of which these are the smallest, in nano-, micro- and milliseconds.
_UNITS = ((1e9, 1e17, 3e6), (1e6, 1e14, 3e3), (1e3, 1e11, 8.0))
# Nanoseconds since 1970 are below this for three thousand years.
_LARGEST_STAMP = 1e20
# Axes of a camera that looks along x of the lidar: x right, y down, z forward.
_T_CAM0_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def match_rows(rows: NDArray[Any], files: Sequence[Path], path: Path) -> NDArray[Any]:
    """Returns the row of each scan of a data set: in order if the counts are equal, else by the file's number.

    Args:
        rows: (m, ...) values.
        files: the n scans.
        path: file of the rows, for messages.

    Returns:
        (n, ...).

    Raises:
        InputError: there are more or fewer rows, and names that are no numbers of rows.
    """
    if len(rows) == len(files):
        return rows
    is_numbered = all(file.stem.isascii() and file.stem.isdecimal() for file in files)
    numbers = last_numbers(files) if is_numbered else [len(rows)]
    found = f"{counted(len(rows), 'row')} for {len(files)} scans"
    require(max(numbers) < len(rows), path, found, "give one pose and time a scan, in their order")
    return rows[numbers]


def to_seconds(stamps: FloatArray) -> FloatArray:
    """Converts time stamps in nano-, micro- or milliseconds to seconds.

    The unit of stamps since 1970 is found by their values, that of others by their median step. Milliseconds are whole
    numbers.

    Args:
        stamps: (n,) in order.

    Returns:
        (n,) s.
    """
    smallest = float(np.abs(stamps).min(initial=np.inf))
    is_whole = bool((stamps == np.round(stamps)).all())
    step = float(np.median(np.abs(np.diff(stamps)))) if len(stamps) > 1 else 0.0
    for per_second, least_stamp, least_step in _UNITS:
        is_step = step >= least_step and (is_whole or per_second > 1e3)
        if least_stamp <= smallest < _LARGEST_STAMP or (smallest < 1e8 and is_step):
            return stamps / per_second
    return stamps


def scan_times(homes: Sequence[Path], files: Sequence[Path]) -> tuple[FloatArray | None, tuple[Note, ...]]:
    """Finds the times of the scans of a folder: times.txt, or the time stamps that are their names.

    Args:
        homes: folders that may have times.txt.
        files: the n scans.

    Returns:
        (n,) s or None, and a note where times.txt does not fit.
    """
    stamps, notes = stamps_in_names(files), tuple[Note, ...]()
    path = next((home / "times.txt" for home in homes if (home / "times.txt").is_file()), None)
    try:
        if path is not None:
            table = read_table(path)
            # A column that numbers the rows from 0 or 1 is no time.
            numbers = [np.arange(len(table)) + first for first in (0, 1)]
            columns = (column for column in table.T if not any(np.array_equal(column, each) for each in numbers))
            read = match_rows(next(columns, table[:, 0]), files, path)
            require(_are_times(read), path, "rows that are no times", "give seconds")
            stamps = read
    except InputError as error:
        notes = (Note(f"{path}: {error.found}; these times are not used", is_doubt=True),)
    return None if stamps is None else to_seconds(stamps), notes


def match_reference(
    found: StampedPoses, times: FloatArray | None, num_scans: int, path: Path
) -> tuple[FloatArray, tuple[Note, ...]]:
    """Matches scans with reference poses.

    If poses and scans have times, poses are interpolated at the times of the scans. The nearest pose must lie within
    the tolerance: half the step of the poses, at most 0.1 s. Stamps may also be the numbers of the scans. Without times
    in common, there must be one pose a scan.

    Args:
        found: the poses of the file.
        times: (n,) s of the scans; None where they have none.
        num_scans: number of scans.
        path: path of the poses, for messages.

    Returns:
        (n, 4, 4) T_world_lidar, NaN for scans without one; and notes on the matching.

    Raises:
        InputError: no times to match by, and another number of poses than of scans.
    """
    stamps = found.stamps if found.stamps is not None and _are_times(found.stamps) else None
    if stamps is not None and _are_numbers(stamps, times, num_scans):
        T = np.full((num_scans, 4, 4), np.nan)
        T[stamps.astype(np.int64)] = found.poses
        return T, (matching_note(path, "the numbers that are their stamps", T),)
    reason, is_doubt = "the file has no times" if stamps is None else "the scans have no times", False
    if stamps is not None and times is not None:
        T, tolerance_s = _by_time(to_seconds(stamps), found.poses, times)
        if np.isfinite(T[:, 0, 0]).any():
            return T, (matching_note(path, f"time, tolerance {tolerance_s:.3g} s", T),)
        reason, is_doubt = "no scan has the time of a pose", True
    advice = "give a TUM file and times.txt with one time a scan, or one pose a scan"
    text = f"{counted(len(found.poses), 'pose')} for {num_scans} scans, and {reason}"
    require(len(found.poses) == num_scans, path, text, advice)
    return found.poses, (Note(f"{path}: {reason}; poses are matched by their order", True),) if is_doubt else ()


def camera_note(T_world_lidar: FloatArray, source: str | Path) -> Note | None:
    """Finds poses of a camera, which moves along its own z axis, where those of the lidar are expected.

    Args:
        T_world_lidar: (n, 4, 4); NaN for scans without one.
        source: source for the note.

    Returns:
        The note, or None.
    """
    T = T_world_lidar[np.isfinite(T_world_lidar).all(axis=(1, 2))]
    steps = np.einsum("nji,nj->ni", T[:-1, :3, :3], np.diff(T[:, :3, 3], axis=0))
    with np.errstate(over="ignore", invalid="ignore"):
        way_m, squares = float(np.linalg.norm(steps, axis=1).sum()), (steps**2).sum(axis=0)
        share = float(squares[2] / max(squares.sum(), 1e-30))
    # A lidar moves along its x axis, a camera along its z axis.
    if not 2.0 <= way_m < np.inf or not share >= 0.8:
        return None
    found = f"the poses move along their own z axis ({share:.0%} of the way), as a camera does, not a lidar"
    advice = "their rotations are off by 90 degrees; give poses of the lidar, or a calib.txt with Tr beside them"
    return Note(f"{source}: {found}; {advice}", is_doubt=True)


def order_note(times: FloatArray, source: str | Path) -> Note | None:
    """Finds times that do not increase from scan to scan.

    Args:
        times: (n,) s.
        source: source for the note.

    Returns:
        The note, or None.
    """
    rows = 1 + np.flatnonzero(np.diff(times) <= 0)
    found = f"{len(rows)} of {len(times)} times are not later than the one before, the first is that of scan"
    advice = "scans stay in the order of their names, check their times"
    return Note(f"{source}: {found} {rows[0]}; {advice}", is_doubt=True) if len(rows) else None


def read_lidar_trajectory(path: str | Path) -> FloatArray:
    """Reads the poses of a drive; those of a camera, which moves along its z axis, are turned into the lidar's axes.

    Args:
        path: rows of TUM or KITTI, metres.

    Returns:
        (n, 4, 4) poses, x forward, y left, z up.

    Raises:
        InputError: no such file, planar poses, or another layout.
    """
    path = Path(path)
    advice = "give poses in space: TUM (stamp tx ty tz qx qy qz qw) or KITTI (12 numbers a row)"
    require(read_table(path).shape[1] > 3, path, "rows of 3 columns", advice)
    T = read_poses(path)
    return T if camera_note(T, path) is None else rigid.inverse(_T_CAM0_LIDAR) @ T @ _T_CAM0_LIDAR


def _are_times(stamps: FloatArray) -> bool:
    return bool((np.abs(stamps) < _LARGEST_STAMP).all())


def _are_numbers(stamps: FloatArray, times: FloatArray | None, num_scans: int) -> bool:
    """Returns True if stamps are numbers of scans: integers up to the last scan, and no times of the scans."""
    is_whole = bool((stamps == np.round(stamps)).all() and len(np.unique(stamps)) == len(stamps))
    if not is_whole or stamps.min() < 0 or stamps.max() >= num_scans:
        return False
    if times is None:
        return True
    spans = float(np.ptp(stamps)), float(np.ptp(times))
    is_other_time = abs(spans[0] - spans[1]) > 1.0 + 0.1 * max(spans)
    return is_other_time or (len(stamps) == num_scans and bool(abs(stamps.min() - times.min()) > 1.0))


def _by_time(stamps: FloatArray, poses: FloatArray, times: FloatArray) -> tuple[FloatArray, float]:
    """Interpolates poses at the times of the scans, NaN where no pose is near; and returns the tolerance."""
    stamps, first = np.unique(stamps, return_index=True)
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    tolerance_s = max(min(0.5 * step, 0.1), 0.001)
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    nearest = np.minimum(np.abs(times - stamps[after - 1]), np.abs(times - stamps[np.minimum(after, len(stamps) - 1)]))
    # Times since 1970 in nanoseconds are good to 256 ns.
    T = np.where((nearest <= tolerance_s + 1e-6)[:, None, None], interpolate_poses(stamps, poses[first], times), np.nan)
    return T, tolerance_s


def matching_note(path: Path, how: str, T: FloatArray) -> Note:
    """Makes the note on the scans that have a reference pose; those without one make it a doubt.

    Args:
        path: file of the poses.
        how: how they were matched.
        T: (n, 4, 4) poses, NaN for scans without one.

    Returns:
        The note.
    """
    num_without = int(np.isnan(T[:, 0, 0]).sum())
    found = f"{num_without} of {len(T)} scans have no reference pose"
    text = f"{path}: poses are matched by {how}; {found if num_without else 'all scans have a reference pose'}"
    return Note(text, is_doubt=num_without > 0)


def read_relations(path: str | Path) -> Relations:
    """Reads relations in the plane.

    Args:
        path: text of eight numbers a line; comments begin with #.

    Returns:
        The relations.

    Raises:
        InputError: the file is missing, has another number of columns, holds words that are no numbers, or relations
            that leave the plane.
    """
    table = read_table(path, 8)  # t1 t2 x y z roll pitch yaw: seconds, metres, radians
    is_flat = bool((np.abs(table[:, 4:7]) < 1e-3).all())
    require(is_flat, path, "relations with a height or a tilt", "give those of a planar log")
    return Relations(table[:, 0], table[:, 1], table[:, [2, 3, 7]])
