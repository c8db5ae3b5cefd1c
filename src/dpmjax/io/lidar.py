"""Drives of 3-D scans: folders of any known layout and bags of ROS, opened for lazy reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.bags import is_bag
from dpmjax.io.bin_columns import check_size, columns_of_drive
from dpmjax.io.drives import Drive3D, find_pose_file, read_learned_folder, read_plain_folder, scan_files, stray_note
from dpmjax.io.files import natural_key
from dpmjax.io.lidar_datasets import read_kitti_360, read_kitti_carla, read_kitti_odometry, read_kitti_raw, read_mulran
from dpmjax.io.messages import log_notes
from dpmjax.io.poses import read_stamped_poses
from dpmjax.io.references import camera_note, match_reference
from dpmjax.io.scan_bags import open_lidar_bag
from dpmjax.io.scan_file import read_point_times, read_points, unit_note
from dpmjax.sequences import InputError, LidarSequence, Note, require

_FORMATS = (
    "a KITTI sequence (velodyne/, calib.txt), a KITTI raw or KITTI-360 drive (velodyne_points/data), a MulRan folder "
    "(Ouster/), a KITTI-CARLA town (generated/frames), a folder of .bin .npy .npz .pcd .ply .las .laz scans, or a bag "
    "of ROS (.bag, .mcap, or a folder with metadata.yaml)"
)
_CAPTURES = {
    ".pcap": "a capture of packets",
    ".pcapng": "a capture of packets",
    ".osf": "a capture of an Ouster",
}


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
    is_recording = is_bag(path) and (path.is_file() or _kind(path) is None)
    require(topic is None or is_recording or not path.exists(), path, "no bag of ROS", "leave the topic out")
    whole = _open_bag(path, topic, poses) if is_recording else _open_folder(_choose(path, sequence), poses, bin_columns)
    note = None if whole.T_world_lidar is None else camera_note(whole.T_world_lidar, poses or path)
    whole = replace(whole, notes=(*whole.notes, *([] if note is None else [note])))
    log_notes(whole.notes)
    part = whole.take(selection)
    require(part.num_scans > 0, path, f"{selection} chooses 0 of {whole.num_scans} scans", "choose others")
    return part


def _open_folder(path: Path, poses: Path | None, bin_columns: int | None) -> LidarSequence:
    """Opens one drive in files."""
    drive = _read(path, poses)
    require(len(drive.files) > 0, path, "a folder without scans", f"give {_FORMATS}")
    notes: list[Note | None] = [stray_note(drive.files[0].parent), *drive.notes]
    if bin_columns is None:
        columns = columns_of_drive(drive.files)
        bin_columns = columns.num_columns
        notes.append(columns.note)
    sources, read_scan = tuple(map(str, drive.files)), partial(_read_scan, drive.files, bin_columns)
    return LidarSequence(
        drive.name,
        sources,
        read_scan,
        drive.T_world_lidar,
        drive.times,
        lambda index: read_point_times(sources[index]),
        tuple(note for note in notes if note is not None),
    )


def _open_bag(path: Path, topic: str | None, poses: Path | None) -> LidarSequence:
    """Opens the clouds of a bag, with poses of a given file or of one with a usual name and matching times."""
    sequence = open_lidar_bag(path, topic)
    beside = find_pose_file(path if path.is_dir() else path.resolve().parent) if poses is None else poses
    if beside is None:
        return sequence
    try:
        T, notes = match_reference(read_stamped_poses(beside), sequence.times, len(sequence), beside)
    except InputError as error:
        if poses is not None:
            raise
        note = Note(f"{beside}: {error.found}; these poses are not used", is_doubt=True)
        return replace(sequence, notes=(*sequence.notes, note))
    return replace(sequence, T_world_lidar=T, notes=(*sequence.notes, *notes))


def require_whole_files(sequence: LidarSequence, *, bin_columns: int | None = None) -> None:
    """Refuses a drive with a file that is missing, or truncated by its length.

    Args:
        sequence: the drive.
        bin_columns: number of values of a point in `.bin` files; None: inferred from the first file.

    Raises:
        InputError: names the first such file.
    """
    files = [Path(source) for source in sequence.sources if source.lower().endswith(".bin")]
    columns = bin_columns or columns_of_drive(files).num_columns
    for file in files:
        try:
            size = file.stat().st_size
        except OSError as error:
            raise InputError(file, f"cannot be read ({error.strerror})", "check the file") from error
        check_size(file, size, columns)


def list_lidar_sequences(path: str | Path) -> list[str]:
    """Lists the drives below the root of a data set.

    Args:
        path: a folder with sequences/NN, data_3d_raw/DRIVE, scene/agent/N.npz, or drives right in it.

    Returns:
        Names for `open_lidar_sequence(path, sequence=name)`, in natural order; none where the path is a drive itself.
    """
    path = Path(path)
    return [] if not path.is_dir() or _kind(path) is not None else sorted(_drives(path), key=natural_key)


def _read_scan(files: list[Path], bin_columns: int, index: int) -> NDArray[np.float32]:
    """Reads scan `index`; only the first one is checked for a wrong unit."""
    points = read_points(files[index], bin_columns=bin_columns)
    if index == 0 and (note := unit_note(points, files[index])) is not None:
        log_notes([note])
    return points


def _choose(path: Path, sequence: str | None) -> Path:
    """Returns the folder of the selected drive."""
    require(path.exists(), path, "no such file or folder", "check the path")
    capture = _CAPTURES.get(path.suffix.lower())
    converter = "convert it to a bag or to .pcd files with ouster-cli (Ouster) or velodyne-decoder (Velodyne)"
    require(capture is None, path, f"{capture}, which is not read", converter)
    require(not path.is_file(), path, "a single file", "give the folder that holds all scans of the drive")
    is_drive = _kind(path) is not None
    if sequence is None and is_drive:
        return path
    drives = _drives(path)
    known = ", ".join(sorted(drives, key=natural_key)[:30])
    if sequence is not None:
        if sequence not in drives and is_drive and path.resolve().name == sequence:
            return path
        held = f"it has {known}" if drives else "it is one drive without a name" if is_drive else "it has no scans"
        advice = "name one of those" if drives else "leave the name out, or give another folder"
        require(sequence in drives, path, f"no sequence {sequence}, {held}", advice)
        return drives[sequence]
    require(len(drives) > 0, path, "a folder without scans", f"give {_FORMATS}")
    require(len(drives) == 1, path, f"{len(drives)} sequences: {known}", "name one of them, or give its folder")
    return next(iter(drives.values()))


def _drives(path: Path) -> dict[str, Path]:
    """Finds the drives up to two levels below a root, by name."""
    for below in ("sequences", "dataset/sequences", "data_3d_raw"):
        if (path / below).is_dir():
            return _drives(path / below)
    children = [child for child in sorted(path.iterdir()) if child.is_dir()]
    deeper = (folder for child in children for folder in sorted(child.iterdir()) if folder.is_dir())
    found = {child.name: child for child in children if _kind(child) is not None}
    return found or {f"{folder.parent.name}/{folder.name}": folder for folder in deeper if _kind(folder) is not None}


# Reader of each kind of drive, and its folder of scans.
_LAYOUTS: dict[str, tuple[Callable[[Path], Drive3D], str]] = {
    "kitti_carla": (read_kitti_carla, "generated/frames"),
    "mulran": (read_mulran, "Ouster"),
    "kitti_360": (read_kitti_360, "velodyne_points/data"),
    "kitti_raw": (read_kitti_raw, "velodyne_points/data"),
    "kitti_odometry": (read_kitti_odometry, "velodyne"),
    "learned": (read_learned_folder, ""),
    "plain": (read_plain_folder, ""),
    "plain_data": (lambda path: _read_plain(path, "data", None), "data"),
}


def _read_plain(path: Path, scans: str, poses: Path | None) -> Drive3D:
    """Lists a plain folder of scans below that of the drive."""
    return read_plain_folder(path / scans, poses=poses)._replace(name=path.resolve().name)


def _kind(path: Path) -> str | None:
    """Finds the layout of a folder by its files; None for none."""
    if (path / "generated" / "frames").is_dir() or (path / "full_poses_lidar.txt").is_file():
        return "kitti_carla"
    if (path / "Ouster").is_dir() or (path / "sensor_data" / "Ouster").is_dir():
        return "mulran"
    if (path / "velodyne_points").is_dir():
        return "kitti_360" if path.resolve().parent.name == "data_3d_raw" else "kitti_raw"
    if (path / "velodyne").is_dir():
        return "kitti_odometry"
    if files := scan_files(path):
        return "learned" if files[0].suffix.lower() == ".npz" else "plain"
    return "plain_data" if scan_files(path / "data") else None


def _read(path: Path, poses: Path | None) -> Drive3D:
    """Lists the drive in a folder; a given pose file replaces that of the data set."""
    kind = _kind(path) or "plain"
    read, scans = _LAYOUTS[kind]
    return read(path) if poses is None else _read_plain(path, scans, poses)
