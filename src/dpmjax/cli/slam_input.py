"""What dpm_slam reads: a drive of any layout or a simulated town, scan after scan, and what can be known to be bad."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpmjax.sequences import EmptyScanError, InputError

if TYPE_CHECKING:
    from dpmjax.cli.slam import Config
    from dpmjax.sequences import LidarSequence
    from dpmjax.slam.front_end import AnyScan

TOWN_ROUTE_M, TOWN_DRIVE_M, TOWN_RATE_HZ, TOWN_AZIMUTHS = 400.0, 480.0, 3.0, 900
TURN_S = 0.1
_FLOAT32_ROW_BYTES = 16


def open_drive(config: Config) -> LidarSequence:
    """Opens the scans that are asked for; bad input that can be known before the run is a `ValueError`."""
    from dpmjax import io

    if config.data is None:
        drive = simulated_drive(config.seed)
    else:
        drive = corrected(io.open_lidar_sequence(config.data, sequence=config.sequence), config.kitti_angle_correction)
    numbers = np.arange(len(drive))[:: config.jump][: config.n_scans]
    part = drive.take(numbers)
    require_whole_files(part)
    read_points(part, 0)
    return part


def corrected(sequence: LidarSequence, is_kitti: bool) -> LidarSequence:
    """The sequence as it is, or with the beams of KITTI's lidar raised to where they point."""
    from dpmjax.scans import raise_beams
    from dpmjax.scans.elevation import KITTI_ELEVATION_DEG

    def read_scan(index: int) -> np.ndarray:
        return raise_beams(sequence.read_scan(index), KITTI_ELEVATION_DEG)

    return replace(sequence, read_scan=read_scan) if is_kitti else sequence


def simulated_drive(seed: int) -> LidarSequence:
    """A drive once round a town and on over streets that it knows, with an HDL-64 of half the columns."""
    from dpmjax.simulation import HDL64E, DriveConfig, Scene, TownConfig, simulate_scene

    town = TownConfig("suburb", "loop", TOWN_ROUTE_M, 90.0)
    driving = DriveConfig(rate_hz=TOWN_RATE_HZ, length_m=TOWN_DRIVE_M)
    return simulate_scene(Scene(seed, town, driving, HDL64E.with_azimuths(TOWN_AZIMUTHS)))


def require_whole_files(sequence: LidarSequence) -> None:
    """Raises an `InputError` for the first file that is missing or cut off, as far as its length tells."""
    for source in map(Path, sequence.sources):
        if source.suffix.lower() != ".bin":
            continue
        try:
            size = source.stat().st_size
        except OSError as error:
            raise InputError(source, f"cannot be read ({error.strerror})", "check the file") from error
        if size % _FLOAT32_ROW_BYTES:
            found = f"{size} bytes are no whole number of points of 4 float32: truncated, or other columns"
            raise InputError(source, found, "copy the file again, or leave it out")


def read_points(sequence: LidarSequence, index: int) -> np.ndarray:
    """Reads a scan; one without points is empty."""
    try:
        return sequence.read_scan(index)
    except EmptyScanError:
        return np.zeros((0, 3), np.float32)


class ScanReader:
    """Reads scans as SLAM takes them.

    Args:
        sequence: the drive.
        is_deskewed: whether points get times, for deskewing.
        jump: number of scans of the drive for each that is read, where it has no times.
    """

    def __init__(self, sequence: LidarSequence, *, is_deskewed: bool = False, jump: int = 1) -> None:
        self._sequence, self._is_deskewed, self._jump = sequence, is_deskewed, jump

    def __call__(self, index: int) -> AnyScan:
        """Reads a scan."""
        from dpmjax.scans import offsets_by_azimuth
        from dpmjax.slam import TimedScan

        points = read_points(self._sequence, index)
        if not self._is_deskewed or not len(points):
            return points
        offsets = self._offsets_by_times(index)
        return TimedScan(points, offsets_by_azimuth(points, self._turn_share(index)) if offsets is None else offsets)

    def iterate(self, start: int) -> Iterator[AnyScan]:
        """Reads scan after scan, the next one while the caller works on this one."""
        numbers = range(start, len(self._sequence))
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(self, start) if numbers else None
            for index in numbers:
                done, waiting = waiting, pool.submit(self, index + 1) if index + 1 in numbers else None
                assert done is not None
                yield done.result()

    def _offsets_by_times(self, index: int) -> np.ndarray | None:
        """What the file says of its points, if anything that can be used."""
        from dpmjax.scans import offsets_by_times

        times = None if self._sequence.read_times is None else self._sequence.read_times(index)
        if times is None:
            return None
        interval_s = self._interval_s(index)
        offsets = offsets_by_times(times, interval_s)
        return offsets if offsets is None or interval_s is not None else offsets / self._jump

    def _turn_share(self, index: int) -> float:
        """Time of a turn, as a share of the time between the two scans before."""
        interval_s = self._interval_s(index)
        return 1.0 / self._jump if interval_s is None else min(TURN_S / interval_s, 1.0)

    def _interval_s(self, index: int) -> float | None:
        """Time between the two scans before, whose motion predicts this one; None where it is not known."""
        times = self._sequence.times
        if times is None or index < 2:
            return None
        interval_s = float(times[index - 1] - times[index - 2])
        return interval_s if interval_s > 0 else None


def reference_of(sequence: LidarSequence) -> LidarSequence:
    """The sequence with its reference in the frame of the first scan."""
    from dpmjax.geometry import rigid

    T = sequence.T_world_lidar
    return sequence if T is None else replace(sequence, T_world_lidar=rigid.inverse(T[0]) @ T)
