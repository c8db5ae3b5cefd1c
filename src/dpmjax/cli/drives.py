"""The scans that a command takes: a drive in any layout or a simulated town, a part of it, and its checks."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence, Note

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
        seed: of the simulated town.
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
    """Writes what was decided about the input to the log; prints it, but for doubts, which the console has already.

    Args:
        notes: of a drive.

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
