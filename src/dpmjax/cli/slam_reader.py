"""Reads the scans of a drive for SLAM: one ahead of the caller, with times of points for deskewing."""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence
    from dpmjax.slam.front_end import AnyScan

TURN_S = 0.1


class ScanReader:
    """Reads scans, timed ones where they are deskewed.

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

        points = self._sequence.read_points(index)
        if not self._is_deskewed or not len(points):
            return points
        offsets = self._offsets_by_times(index)
        return TimedScan(points, offsets_by_azimuth(points, self._turn_share(index)) if offsets is None else offsets)

    def iterate(self, start: int) -> Generator[AnyScan, None, None]:
        """Reads scan after scan, the next one while the caller works on this one."""
        numbers = range(start, len(self._sequence))
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(self, start) if numbers else None
            for index in numbers:
                done, waiting = waiting, pool.submit(self, index + 1) if index + 1 in numbers else None
                assert done is not None
                yield done.result()

    def _offsets_by_times(self, index: int) -> np.ndarray | None:
        """Returns the offsets by the times in the file; None where it has none that can be used."""
        from dpmjax.scans import offsets_by_times

        times = None if self._sequence.read_times is None else self._sequence.read_times(index)
        if times is None:
            return None
        interval_s = self._interval_s(index)
        offsets = offsets_by_times(times, interval_s)
        return offsets if offsets is None or interval_s is not None else offsets / self._jump

    def _turn_share(self, index: int) -> float:
        """Returns the time of a turn, as a share of the time between the two scans before."""
        interval_s = self._interval_s(index)
        return 1.0 / self._jump if interval_s is None else min(TURN_S / interval_s, 1.0)

    def _interval_s(self, index: int) -> float | None:
        """Returns the time between the two scans before, whose motion predicts this one; None where it is unknown."""
        times = self._sequence.times
        if times is None or index < 2:
            return None
        interval_s = float(times[index - 1] - times[index - 2])
        return interval_s if interval_s > 0 else None
