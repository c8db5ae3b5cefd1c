"""Input of the commands: drives of 3-D scans, from files, simulated, or simulated along a trajectory of the user."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import FlagCreatePairsOff, arg

from dpmjax import deeppointmap, io, metrics, scan, simulation, slam
from dpmjax.cli.options import Bound, ModelOptions, RunOptions, ScanOptions
from dpmjax.cli.run import RESULTS, Run
from dpmjax.sequences import InputError, LidarSequence, Note, ScanSequence

LOGGER = logging.getLogger("dpmjax.drives")
TOWN = "town"
# Unit of the integer coordinates of kept scans: 16 bits reach 128 m.
STEP_M = 2.0**-8
# Time of a turn of a lidar whose scans have no times of points.
TURN_S = 0.1


@dataclass(frozen=True, kw_only=True)
class DriveOptions(ScanOptions, ModelOptions, RunOptions):
    """Options of every command that reads the scans of whole drives."""

    topic: Annotated[str | None, arg(aliases=["-t"], metavar="NAME")] = None
    """Topic of the clouds, if a bag of ROS holds several."""
    columns: Annotated[int | None, arg(metavar="N"), Bound(3)] = None
    """Number of values of each point in .bin files (4: KITTI, 5: nuScenes). Without it, the values decide."""
    kitti_angle_correction: FlagCreatePairsOff[bool] = False
    """Raise the beams by 0.205 degrees, as KITTI's HDL-64E needs."""

    def check_data(self, data: object, sequence: str | None) -> None:
        """Raises a ValueError for options of files if no folder is given."""
        given = sequence, self.topic, self.columns, self.kitti_angle_correction or None
        if not (data or self.resume) and any(one is not None for one in given):
            raise ValueError("--sequence, --topic, --columns and --kitti-angle-correction describe DATA: give DATA too")


def open_drive(data: Path | None, options: DriveOptions, sequence: str | None = None) -> LidarSequence:
    """Opens a drive, checks the lengths of its files and reads its first scan.

    Args:
        data: folder of scans, a bag of ROS, or a file of poses along which a town is simulated; None for any town.
        options: selection of scans of the drive, and seed of a simulated town.
        sequence: name of the drive, if the folder holds several.

    Returns:
        The drive.

    Raises:
        InputError: the folder, the drive or the poses do not exist, a file is missing or truncated, or the first scan
            is damaged.
    """
    if data is None:
        drive = demo_drive(options.seed)
    else:
        drive = open_path(data, options.seed, sequence=sequence, bin_columns=options.columns, topic=options.topic)
    if options.kitti_angle_correction:
        drive = with_raised_beams(drive)
    part = drive.take(options.selection)
    io.require_whole_files(part, bin_columns=options.columns)
    notes = [io.unit_note(part.read_points(0), part.sources[0])]
    if options.n_scans is not None and len(part) < options.n_scans:
        at_jump = f" at --jump {options.jump}" if options.jump > 1 else ""
        notes.append(Note(f"{part.name}: {len(part)} scans{at_jump}, fewer than --n-scans {options.n_scans}"))
    return replace(part, notes=(*part.notes, *(note for note in notes if note is not None)))


def open_path(path: Path, seed: int, **options: Any) -> LidarSequence:
    """Opens a folder of scans or a bag, or simulates a town of a seed along a file of poses."""
    is_route = path.suffix.lower() in (".txt", ".tum") and path.is_file()
    return route_drive(path, seed) if is_route else io.open_lidar_sequence(path, **options)


def with_raised_beams(drive: LidarSequence) -> LidarSequence:
    """Returns the drive with the beams of KITTI's lidar raised to their true elevation."""
    from dpmjax.scan.lidar.corrections import KITTI_ELEVATION_DEG

    def read_scan(index: int) -> np.ndarray:
        return scan.raise_beams(drive.read_scan(index), KITTI_ELEVATION_DEG)

    return replace(drive, read_scan=read_scan)


def demo_drive(seed: int) -> LidarSequence:
    """Simulates a drive once round a town and on over the first streets, with an HDL-64 of half the columns."""
    town = simulation.TownConfig("suburb", "loop", route_length_m=400.0, block_m=90.0)
    driving = simulation.DriveConfig(rate_hz=3.0, length_m=480.0)
    return simulation.simulate_scene(simulation.Scene(seed, town, driving, simulation.HDL64E.with_azimuths(900)))


def route_drive(path: Path, seed: int) -> LidarSequence:
    """Simulates a town along a trajectory, and a drive through it; scans are simulated when they are first read.

    Streets follow the trajectory, and the ground follows its slopes. All passes of a place have one height. The car
    drives in its lane at constant speed and tilts with the ground. Rotations and times of the file are ignored.

    Args:
        path: poses of a lidar or of a camera as TUM or KITTI, metres.
        seed: seed of the town.

    Returns:
        The drive with exact poses and times.

    Raises:
        InputError: the poses do not exist, or the trajectory is shorter than 20 m.
    """
    T_world_lidar = io.read_lidar_trajectory(path)
    T_world_lidar[:, :3, 3] -= T_world_lidar[0, :3, 3]  # float32 holds no centimetres at the coordinates of a country
    # As in KITTI: 10 m/s and 10 turns a second, so one scan each metre, with up to 3 degrees of turn.
    driving = simulation.DriveConfig(10.0, 10.0, max_turn_deg_s=30.0)
    try:
        scene = simulation.Scene(seed, simulation.TownConfig(), driving, simulation.HDL64E)
        drive = simulation.simulate_scene(scene, trajectory=T_world_lidar)
    except ValueError as error:
        raise InputError(path, str(error), "give the poses of a drive, in metres") from error
    sources = tuple(f"{path}, simulated scan {number}" for number in range(len(drive)))
    kept = keep_scans(replace(drive, name=path.stem, sources=sources))
    return replace(kept, notes=(*kept.notes, Note(f"{path}: a town of seed {seed} is simulated along these poses")))


def keep_scans(drive: LidarSequence, folder: Path = RESULTS / "simulated") -> LidarSequence:
    """Caches the scans of a simulated drive on disk at their first reading, rounded to 4 mm.

    Args:
        drive: the drive; points within 128 m.
        folder: parent of the cache. A folder in it, named after the drive and its content, gets one file a scan.

    Returns:
        The same drive, with rounded points.
    """
    home = folder.resolve() / f"{drive.name}-{_digest(drive)}"
    return replace(drive, read_scan=partial(_read_kept, home, drive.read_scan))


def _read_kept(folder: Path, read_scan: Callable[[int], NDArray[np.float32]], index: int) -> NDArray[np.float32]:
    path = folder / f"{index:06}.npy"
    if path.exists():
        steps = np.load(path)
    else:
        buffer, steps = BytesIO(), np.rint(read_scan(index) / STEP_M).astype(np.int16)
        np.save(buffer, steps)
        with suppress(OSError):  # in a folder that cannot be written, scans are simulated again
            io.write_atomically(path, buffer.getvalue())
    return steps.astype(np.float32) * np.float32(STEP_M)


def _digest(drive: LidarSequence) -> str:
    """Hashes the poses, the times and two scans, which differ between towns, lidars and versions of the simulator."""
    arrays = (drive.T_world_lidar, drive.times, drive[0], drive[-1])
    parts = (b"" if array is None else np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(b"".join(parts)).hexdigest()[:8]


Source = Callable[[], LidarSequence]
"""Opens or simulates a drive to train on or to evaluate with; a worker process calls it, so it can be pickled."""


def open_with_poses(path: Path, name: str | None) -> LidarSequence:
    """Opens a drive, or simulates a town along a file of poses, and leaves out scans without a reference pose."""
    return with_reference_only(open_path(path, 0, sequence=name))


def with_reference_only(drive: LidarSequence) -> LidarSequence:
    """Leaves out the scans without a reference pose, if the drive has a reference."""
    return drive if drive.T_world_lidar is None else drive.take(drive.has_reference)


def find_sources(
    data: Sequence[str], towns: Sequence[Source], sampling: deeppointmap.SamplingConfig | None = None
) -> list[Source]:
    """Opens and checks the drives that a command line names; the entry `town` stands for all towns.

    Args:
        data: folders or files of poses, or `town` for the towns.
        towns: towns of the seeds of the run.
        sampling: distances at which a drive must have pairs of scans; None takes the published ones.

    Returns:
        The drives, in order.

    Raises:
        ValueError: if a path cannot be read or holds no useful drive.
    """
    sources: list[Source] = []
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            sources += towns
            continue
        names: Sequence[str | None] = io.list_lidar_sequences(entry) or [None]
        found = [partial(open_with_poses, Path(entry), name) for name in names]
        sampling = sampling or deeppointmap.SamplingConfig()
        reasons = {source: deeppointmap.why_useless(source(), sampling) for source in found}
        if None not in reasons.values():
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for source, reason in reasons.items():
            if reason is not None:
                LOGGER.warning("%s, %s is left out: %s", entry, source.args[1], reason)
        sources += [source for source, reason in reasons.items() if reason is None]
    return sources


def check_names_differ(drives: Iterable[LidarSequence]) -> None:
    """Raises a ValueError if two drives have the same name."""
    names = sorted(drive.name for drive in drives)
    if len(set(names)) < len(names):
        raise ValueError(f"two drives have the same name ({', '.join(names)}); evaluate them one by one")


class ScanReader:
    """Reads scans, with point times for deskewing and with odometry.

    Args:
        sequence: the drive.
        is_deskewed: True for points with times.
        jump: stride of the scans of the drive, for drives without times.
        odometry: (n, 4, 4) poses of the lidar, as first guesses; None without odometry.
    """

    def __init__(
        self,
        sequence: LidarSequence,
        *,
        is_deskewed: bool = False,
        jump: int = 1,
        odometry: NDArray[np.float64] | None = None,
    ) -> None:
        self.sequence, self.odometry, self._is_deskewed, self._jump = sequence, odometry, is_deskewed, jump
        self._has_warned = False

    def __call__(self, index: int) -> slam.TimedScan | np.ndarray:
        """Reads a scan."""
        points = self.sequence.read_points(index)
        if not self._is_deskewed or not len(points):
            return points
        interval_s = self._interval_s(index)
        times = None if self.sequence.read_times is None else self.sequence.read_times(index)
        offsets = None if times is None else scan.offsets_by_times(times, interval_s)
        if offsets is not None:
            return slam.TimedScan(points, offsets if interval_s is not None else offsets / self._jump)
        if times is not None and not self._has_warned:
            self._has_warned = True
            text = "its times of points span no turn of a lidar: the azimuth of the points gives them, in such scans"
            LOGGER.warning("%s: %s", self.sequence.sources[index], text)
        # By the time of a turn, as a share of the time between scans.
        turn_share = 1.0 / self._jump if interval_s is None else min(TURN_S / interval_s, 1.0)
        return slam.TimedScan(points, scan.offsets_by_azimuth(points, turn_share))

    def _interval_s(self, index: int) -> float | None:
        """Returns the time of the motion by which a scan is deskewed; None if it is unknown."""
        times, last = self.sequence.times, max(index - 1, 1)
        if times is None or len(times) < 2:
            return None
        interval_s = float(times[last] - times[last - 1])
        return interval_s if interval_s > 0 else None


def odometry_numbers(
    run: Run, odometry: np.ndarray, T_world_scan: np.ndarray, drive: LidarSequence | ScanSequence
) -> dict[str, float]:
    """Returns and prints the error of given odometry against the map, and the delay of its stamps.

    Args:
        run: prints the line.
        odometry: (n, d+1, d+1) poses of the sensor by odometry.
        T_world_scan: (n, d+1, d+1) poses of the same scans in the map.
        drive: the scans, with their times.

    Returns:
        Numbers of `metrics.json`.
    """
    found, unit = metrics.compare_odometry(odometry, T_world_scan), getattr(drive, "unit", "m")
    text = f"odometry: {found.step:.2g} {unit} off a step in the median"
    if found.delay_scans:
        step, of = (1.0, "scans") if drive.times is None else (float(np.median(np.diff(drive.times))), "s")
        late = f"{abs(found.delay_scans) * step:.2g} {of} {'late' if found.delay_scans > 0 else 'early'}"
        text += f"; its stamps are {late} ({found.undelayed_step:.2g} {unit} off)"
    run.say(text)
    return {f"odometry_step_{unit}": found.step, "odometry_delay_scans": found.delay_scans}
