"""What every reader and simulator of 3-D scans returns: a sequence that loads a scan when it is asked for."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.errors import InputError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LidarSequence:
    """Scans of one drive, read lazily.

    Attributes:
        name: short name of the source, for titles and folders.
        sources: where each scan comes from: a file, in general.
        read_scan: read_scan(i) gives scan i as (n, 3) float32 points in the lidar's frame (x forward, y left, z up), m;
            raises an InputError that names the file where the scan is bad.
        T_world_lidar: (num_scans, 4, 4) float64 reference poses, or None.
        times: (num_scans,) float64 s, or None.

    Raises:
        ValueError: poses or times that are not one a scan.
    """

    name: str
    sources: tuple[str, ...] = field(repr=False)
    read_scan: Callable[[int], NDArray[np.float32]] = field(repr=False)
    T_world_lidar: NDArray[np.float64] | None = field(default=None, repr=False)
    times: NDArray[np.float64] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.T_world_lidar is not None and self.T_world_lidar.shape != (self.num_scans, 4, 4):
            raise ValueError(f"T_world_lidar must be ({self.num_scans}, 4, 4), got {self.T_world_lidar.shape}")
        if self.times is not None and self.times.shape != (self.num_scans,):
            raise ValueError(f"times must be ({self.num_scans},), got {self.times.shape}")

    @property
    def num_scans(self) -> int:
        """Number of scans, the bad ones too."""
        return len(self.sources)

    def __len__(self) -> int:
        return len(self.sources)


@dataclass(frozen=True)
class BadScan:
    """A scan that could not be used.

    Attributes:
        index: its number in the sequence.
        file: where it came from.
        reason: what was found there.
    """

    index: int
    file: str
    reason: str


class IndexedScan(NamedTuple):
    """A scan and its number in the sequence.

    Attributes:
        number: of the scan in the sequence.
        points: (n, 3) float32, lidar frame, m.
    """

    number: int
    points: NDArray[np.float32]


def take_lidar_scans(sequence: LidarSequence, selection: slice | NDArray[np.int64]) -> LidarSequence:
    """Cuts scans out of a sequence, poses and times with them; nothing is read.

    Args:
        sequence: the whole.
        selection: start, stop and stride, or the numbers of the scans to keep.

    Returns:
        The part; the world stays the same.
    """
    chosen = np.arange(sequence.num_scans)[selection]
    numbers = [int(i) for i in chosen]

    def read_scan(index: int) -> NDArray[np.float32]:
        return sequence.read_scan(numbers[index])

    poses, times = sequence.T_world_lidar, sequence.times
    return replace(
        sequence,
        sources=tuple(sequence.sources[i] for i in numbers),
        read_scan=read_scan,
        T_world_lidar=None if poses is None else poses[chosen],
        times=None if times is None else times[chosen],
    )


def iterate_scans(sequence: LidarSequence, bad: list[BadScan] | None = None) -> Iterator[IndexedScan]:
    """Reads scan after scan, passes over the bad ones and says so at the end.

    Args:
        sequence: the scans.
        bad: gets an entry for each scan that was passed over; a warning that names them is logged at the end anyway.

    Yields:
        The good scans with their numbers.

    Raises:
        InputError: not one scan is good.
    """
    found: list[BadScan] = []
    for index, source in enumerate(sequence.sources):
        try:
            points = sequence.read_scan(index)
        except InputError as error:
            found.append(BadScan(index, source, error.found))
            if bad is not None:
                bad.append(found[-1])
            continue
        yield IndexedScan(index, points)
    if found:
        told = "; ".join(f"scan {scan.index}, {scan.file}: {scan.reason}" for scan in found[:10])
        more = f"; and {len(found) - 10} more" if len(found) > 10 else ""
        if len(found) == sequence.num_scans:
            raise InputError(sequence.name, f"all {len(found)} scans are bad: {told}{more}", "check the files")
        _log.warning("%s: %d of %d scans left out: %s%s", sequence.name, len(found), sequence.num_scans, told, more)
