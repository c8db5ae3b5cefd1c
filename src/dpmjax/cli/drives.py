"""Input of the commands: drives of 3-D scans, read ahead in a thread, and saved maps."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence, Note
    from dpmjax.slam import KeyframeMap, SlamMethods
    from dpmjax.slam.front_end import AnyScan


LOGGER = logging.getLogger(__name__)
TOWN_ROUTE_M, TOWN_DRIVE_M, TOWN_RATE_HZ, TOWN_AZIMUTHS = 400.0, 480.0, 3.0, 900


@dataclass(frozen=True, kw_only=True)
class DriveSelection:
    """Scans of one drive.

    Attributes:
        data: folder of scans, a bag of ROS, or a file of poses along which a town is simulated; None for any town.
        sequence: name of the drive, where the folder holds several.
        num_scans: number of scans; None for all.
        jump: every `jump`-th scan is taken.
        is_kitti_corrected: the beams are raised by 0.205 degrees, as KITTI's HDL-64E needs.
        columns: numbers a point has in `.bin` files; None infers it from the values.
        topic: which clouds of a bag of ROS; None takes the only ones.
        seed: seed of the simulated town.
    """

    data: Path | None = None
    sequence: str | None = None
    num_scans: int | None = None
    jump: int = 1
    is_kitti_corrected: bool = False
    columns: int | None = None
    topic: str | None = None
    seed: int = 0


def open_drive(selection: DriveSelection) -> LidarSequence:
    """Opens a drive, checks the lengths of its files and reads its first scan.

    Args:
        selection: the scans.

    Returns:
        The drive.

    Raises:
        InputError: no such folder, drive or poses, a file that is missing or cut off, or a first scan that is bad.
    """
    from dpmjax import io
    from dpmjax.cli.route_drives import is_route, route_drive

    if selection.data is None:
        drive = demo_drive(selection.seed)
    elif is_route(selection.data):
        drive = route_drive(selection.data, selection.seed)
    else:
        drive = io.open_lidar_sequence(
            selection.data, sequence=selection.sequence, bin_columns=selection.columns, topic=selection.topic
        )
    if selection.is_kitti_corrected:
        drive = with_raised_beams(drive)
    part = drive.take(np.arange(len(drive))[:: selection.jump][: selection.num_scans])
    io.require_whole_files(part, bin_columns=selection.columns)
    note = io.unit_note(part.read_points(0), part.sources[0])
    return part if note is None else replace(part, notes=(*part.notes, note))


def report_notes(notes: Iterable[Note]) -> dict[str, list[str]]:
    """Writes the notes on the input to the log, and prints those that are no doubts: the console shows doubts already.

    Args:
        notes: notes of a drive.

    Returns:
        The entry of `metrics.json`.
    """
    texts = []
    for note in notes:
        LOGGER.info("%s", note.text)
        texts.append(note.text)
        if not note.is_doubt:
            print(note.text, flush=True)
    return {"input_notes": texts}


def with_raised_beams(drive: LidarSequence) -> LidarSequence:
    """Returns the drive with the beams of KITTI's lidar raised to their true elevation."""
    from dpmjax.scans import raise_beams
    from dpmjax.scans.elevation import KITTI_ELEVATION_DEG

    def read_scan(index: int) -> np.ndarray:
        return raise_beams(drive.read_scan(index), KITTI_ELEVATION_DEG)

    return replace(drive, read_scan=read_scan)


def demo_drive(seed: int) -> LidarSequence:
    """Simulates a drive once round a town and on over known streets, with an HDL-64 of half the columns."""
    from dpmjax.simulation import HDL64E, DriveConfig, Scene, TownConfig, simulate_scene

    town = TownConfig("suburb", "loop", TOWN_ROUTE_M, 90.0)
    driving = DriveConfig(rate_hz=TOWN_RATE_HZ, length_m=TOWN_DRIVE_M)
    return simulate_scene(Scene(seed, town, driving, HDL64E.with_azimuths(TOWN_AZIMUTHS)))


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


def open_map(path: Path, methods: SlamMethods) -> KeyframeMap:
    """Reads a saved map.

    Args:
        path: a file of `save_map`.
        methods: methods of the weights that must have made it.

    Returns:
        The map.

    Raises:
        ValueError: no such file, no map, or a map of other weights.
    """
    from dpmjax.saved_maps import load_map

    slam_map, origin = load_map(path), methods.origin
    if slam_map.origin is not None and slam_map.origin.fingerprint != origin.fingerprint:
        found = f"made with weights {slam_map.origin}, these are {origin}"
        raise ValueError(f"{path}: {found}; name the weights that made it with --weights")
    return slam_map


def keyframe_points(slam_map: KeyframeMap, row: int) -> np.ndarray:
    """Returns the surface elements of a keyframe.

    Args:
        slam_map: the map.
        row: row of the keyframe.

    Returns:
        (n, 3) metres, in the frame of the keyframe's lidar.
    """
    from dpmjax.scans.compact import expand_elements

    elements = expand_elements(slam_map.keyframes[row].compact.elements)
    return np.asarray(elements.positions)[np.asarray(elements.mask)]
