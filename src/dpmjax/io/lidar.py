"""Drives of 3-D scans: folders of any known layout and bags of ROS, opened for lazy reading."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.files import log_notes, natural_key
from dpmjax.io.lidar_datasets import DRIVES, find_pose_file, is_drive, open_folder
from dpmjax.io.lidar_file import check_size, columns_of_drive, unit_note
from dpmjax.io.poses import read_stamped_poses
from dpmjax.io.references import camera_note, match_reference, order_note
from dpmjax.io.scan_bags import is_bag, open_lidar_bag
from dpmjax.sequences import FloatArray, InputError, LidarSequence, Note, require


def open_lidar_sequence(
    path: str | Path,
    *,
    sequence: str | None = None,
    poses: str | Path | None = None,
    selection: slice = slice(None),
    bin_columns: int | None = None,
    topic: str | None = None,
) -> LidarSequence:
    """Opens a drive of 3-D scans in any of the known layouts; scans are read on demand.

    The notes of the sequence hold the decisions about the files; doubts are logged as warnings.

    Args:
        path: the folder of a drive, the root of a data set that holds several, or a bag of ROS.
        sequence: name of a drive of a root, like "00"; None: the only one.
        poses: a pose file in the lidar's frame (KITTI or TUM rows, `.npy`) instead of the data set's own.
        selection: start, stop and stride in scans.
        bin_columns: number of values of a point in `.bin` files; None: inferred from the first file.
        topic: topic of clouds of a bag; None: the only one.

    Returns:
        The sequence, with poses in the lidar's frame and times where the source has them.

    Raises:
        InputError: one line with the file, the finding and the advice: no such folder, an unknown layout, no scan,
            poses without a known lidar frame, or an empty selection.
    """
    path, poses = Path(path), None if poses is None else Path(poses)
    is_good = bin_columns is None or bin_columns >= 3
    require(is_good, path, f"bin_columns is {bin_columns}", "a point has x, y and z at least")
    is_recording = is_bag(path) and not is_drive(path)
    require(topic is None or is_recording or not path.exists(), path, "no bag of ROS", "leave the topic out")
    whole = _open_bag(path, topic, poses) if is_recording else open_folder(_choose(path, sequence), poses, bin_columns)
    of_poses = None if whole.T_world_lidar is None else camera_note(whole.T_world_lidar, poses or path)
    of_times = None if whole.times is None else order_note(whole.times, path)
    notes = (*whole.notes, *(note for note in (of_poses, of_times) if note is not None))
    log_notes(notes)

    def read_scan(index: int) -> NDArray[np.float32]:
        points = whole.read_scan(index)
        note = unit_note(points, whole.sources[0]) if index == 0 else None
        log_notes([note] if note is not None else [])
        return points

    part = replace(whole, read_scan=read_scan, notes=notes).take(selection)
    require(len(part) > 0, path, f"{selection} chooses 0 of {len(whole)} scans", "choose others")
    return part


def _open_bag(path: Path, topic: str | None, poses: Path | None) -> LidarSequence:
    """Opens the clouds of a bag, with poses of a given file or of one with a usual name and matching times."""
    sequence = open_lidar_bag(path, topic)
    beside = find_pose_file(path if path.is_dir() else path.resolve().parent) if poses is None else poses
    if beside is None:
        return sequence
    try:
        T, notes = read_odometry(beside, sequence)
    except InputError as error:
        if poses is not None:
            raise
        T, notes = None, (Note(f"{beside}: {error.found}; these poses are not used", is_doubt=True),)
    return replace(sequence, T_world_lidar=T, notes=(*sequence.notes, *notes))


def read_odometry(path: str | Path, sequence: LidarSequence) -> tuple[FloatArray, tuple[Note, ...]]:
    """Reads poses of the robot by its own odometry, at the times of the scans.

    Args:
        path: poses as TUM, matched by time; or as TUM, KITTI or matrices, one a scan.
        sequence: the scans.

    Returns:
        (n, 4, 4) poses in the world of the file, NaN for scans without one; and notes on the matching.

    Raises:
        InputError: no poses, or no times in common and another number of poses than of scans.
    """
    path = Path(path)
    return match_reference(read_stamped_poses(path), sequence.times, len(sequence), path)


def require_whole_files(sequence: LidarSequence, *, bin_columns: int | None = None) -> None:
    """Refuses a drive with a file that is missing, or truncated by its length.

    Args:
        sequence: the drive.
        bin_columns: number of values of a point in `.bin` files; None: inferred from the first file.

    Raises:
        InputError: names the first such file.
    """
    files = [Path(source) for source in sequence.sources if source.lower().endswith(".bin")]
    columns = bin_columns or columns_of_drive(files)[0]
    for file in files:
        require(file.is_file(), file, "no such file", "copy it again")
        check_size(file, file.stat().st_size, columns)


def list_lidar_sequences(path: str | Path) -> list[str]:
    """Lists the drives below the root of a data set.

    Args:
        path: a folder with sequences/NN, data_3d_raw/DRIVE, scene/agent/N.npz, or drives right in it.

    Returns:
        Names for `open_lidar_sequence(path, sequence=name)`, in natural order; none where the path is a drive itself.
    """
    path = Path(path)
    return [] if not path.is_dir() or is_drive(path) else sorted(_drives(path), key=natural_key)


def _choose(path: Path, sequence: str | None) -> Path:
    """Returns the folder of the selected drive."""
    require(path.exists(), path, "no such file or folder", "check the path")
    converter = "convert captures of packets to a bag or to .pcd files by ouster-cli or velodyne-decoder"
    is_capture = path.suffix.lower() in (".pcap", ".pcapng", ".osf")
    advice = converter if is_capture else "give the folder that holds all scans of the drive"
    require(not path.is_file(), path, "a single file", advice)
    if is_drive(path) and sequence in (None, path.resolve().name):
        return path
    drives = _drives(path)
    known = ", ".join(sorted(drives, key=natural_key)[:30])
    if sequence is None:
        require(len(drives) > 0, path, "a folder without scans", f"give {DRIVES}")
        require(len(drives) == 1, path, f"{len(drives)} sequences: {known}", "name one of them, or give its folder")
        return next(iter(drives.values()))
    found = f"no sequence {sequence}, it has {known or 'none'}"
    require(sequence in drives, path, found, "name one of those, or leave the name out")
    return drives[sequence]


def _drives(path: Path) -> dict[str, Path]:
    """Finds the drives up to two levels below a root, by name."""
    for below in ("sequences", "dataset/sequences", "data_3d_raw"):
        if (path / below).is_dir():
            return _drives(path / below)
    children = _readable_folders(path)
    found = {child.name: child for child in children if is_drive(child)}
    deeper = (folder for child in children for folder in _readable_folders(child))
    return found or {f"{folder.parent.name}/{folder.name}": folder for folder in deeper if is_drive(folder)}


def _readable_folders(path: Path) -> list[Path]:
    # Others, such as lost+found, are no drives.
    return [child for child in sorted(path.iterdir()) if child.is_dir() and os.access(child, os.R_OK | os.X_OK)]
