"""The files of a drive of 3-D scans, in order, and the poses and times that belong to them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.io.errors import InputError
from dpmjax.io.files import natural_key
from dpmjax.io.lidar.files import SCAN_SUFFIXES
from dpmjax.io.poses.lidar_poses import read_table

POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
              "trajectory.npy", "gt_poses.txt", "groundtruth.txt")  # fmt: skip
"""Names under which poses in the lidar's frame lie beside scans."""


class Drive3D(NamedTuple):
    """The files of a drive, one a scan in order, with poses and times where there are any.

    Attributes:
        name: for titles.
        files: the scans.
        T_world_lidar: (n, 4, 4), or None.
        times: (n,) s, or None.
    """

    name: str
    files: list[Path]
    T_world_lidar: NDArray[np.float64] | None
    times: NDArray[np.float64] | None


def scan_files(folder: Path, suffixes: tuple[str, ...] = SCAN_SUFFIXES) -> list[Path]:
    """The scans of a folder in natural order: those of the most frequent ending, for other clouds may lie about.

    Args:
        folder: where to look, not deeper.
        suffixes: endings of scans.

    Returns:
        The files; none where there is no such folder.
    """
    if not folder.is_dir():
        return []
    found = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file() and f.name[0] != "."]
    found = [f for f in found if f.name not in POSE_FILES]
    counts = {suffix: sum(f.suffix.lower() == suffix for f in found) for suffix in suffixes}
    kept = max(suffixes, key=lambda suffix: counts[suffix])
    return sorted((f for f in found if f.suffix.lower() == kept), key=lambda f: natural_key(f.name))


def one_pose_each(
    poses: NDArray[np.float64] | None, files: list[Path], path: Path | None
) -> NDArray[np.float64] | None:
    """The pose of each scan: in order if there are as many, else by the number that is the file's name.

    Args:
        poses: (m, 4, 4), or None.
        files: the scans.
        path: of the poses, for messages.

    Returns:
        (n, 4, 4), or None.

    Raises:
        InputError: another number of poses, and names that are no numbers.
    """
    if poses is None or len(poses) == len(files):
        return poses
    if all(file.stem.isdecimal() and int(file.stem) < len(poses) for file in files):
        return poses[[int(file.stem) for file in files]]
    raise InputError(
        path or "poses", f"{len(poses)} poses for {len(files)} scans", "give one pose a scan, in their order"
    )


def times_of(path: Path, files: list[Path]) -> NDArray[np.float64] | None:
    """times.txt, if there is one that fits; a bad one is no reason to refuse the scans.

    Args:
        path: of times.txt.
        files: the scans.

    Returns:
        (n,) s, or None.
    """
    try:
        times = read_table(path)[:, 0]
    except InputError:
        return None
    if len(times) == len(files):
        return times
    numbers = [int(file.stem) for file in files if file.stem.isdecimal()]
    fits = len(numbers) == len(files) and max(numbers, default=0) < len(times)
    return times[numbers] if fits else None
