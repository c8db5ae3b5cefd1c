"""Scan files of a folder: their choice, their order, and the numbers and times in their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpmjax.io.files import natural_key
from dpmjax.io.lidar_file import SCAN_SUFFIXES
from dpmjax.sequences import FloatArray, Note, require

# Usual names of files of reference poses in the lidar's frame.
POSE_FILES = ("poses_lidar.txt", "poses_lidar.npy", "poses.txt", "poses.npy", "trajectory.txt", "trajectory_tum.txt",
              "trajectory.npy", "gt_poses.txt", "groundtruth.txt", "groundtruth.csv", "poses.csv")  # fmt: skip
_NUMBER = re.compile(r"\d+(?:\.\d+)?|\.\d+")
# Seconds since 1970 with nanoseconds as a number of their own.
_SPLIT_STAMP = re.compile(r"(?<!\d)(\d{10})[_-](\d{9})$")


def scan_files(folder: Path) -> list[Path]:
    """Lists the scans of a folder in the order of their numbers: the files of the most frequent ending.

    Args:
        folder: searched folder, without its subfolders.

    Returns:
        The files, without those that `folder_note` names; none where there is no such folder.
    """
    most = _files_of_one_ending(folder, SCAN_SUFFIXES)
    strays = strays_among(most)
    return sort_scans([file for file in most if file not in strays])


def folder_note(folder: Path) -> Note | None:
    """Names files that are not read, of rarer endings, or such as map.pcd.

    Args:
        folder: folder of the scans.

    Returns:
        The note, or None.
    """
    most = _files_of_one_ending(folder, SCAN_SUFFIXES)
    strays, doubts = strays_among(most), []
    if strays:
        doubts.append(f"{strays[0].name} is no scan, as its name has no number; {len(strays)} such left out")
    for suffix in SCAN_SUFFIXES:
        others = _files_of_one_ending(folder, (suffix,))
        if others and not {*others} & {*most}:
            doubts.append(f"{len(others)} {suffix} left out beside {len(most)} {most[0].suffix}")
    return Note(f"{folder}: {'; '.join(doubts)}", is_doubt=True) if doubts else None


def _files_of_one_ending(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Returns the files of the most frequent ending, unsorted."""
    if not folder.is_dir():
        return []
    files = [f for f in folder.iterdir() if not f.is_dir() and f.name[0] != "." and f.name not in POSE_FILES]
    return max(([f for f in files if f.suffix.lower() == suffix] for suffix in suffixes), key=len)


def _stem_of(file: Path) -> str:
    """Returns the name without its endings, of which `.pcd.bin` has two."""
    return file.name[: -len(".pcd.bin")] if file.name.lower().endswith(".pcd.bin") else file.stem


def sort_scans(files: Sequence[Path]) -> list[Path]:
    """Sorts scans by the numbers in their names: 2 before 10, and 0.05 before 0.1 where the numbers are decimals.

    A number with a point is a decimal where the digits after the point differ in count and none of the longer ones ends
    in 0, as programs print them. Otherwise, both sides of the point are counted on their own, as of 1.9 and 1.10.

    Args:
        files: files in any order.

    Returns:
        The files in order.
    """
    pieces = (piece for file in files for piece in _NUMBER.findall(_stem_of(file)))
    fractions = {piece.partition(".")[2] for piece in pieces if "." in piece}
    are_printed = not any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    if len({len(fraction) for fraction in fractions}) > 1 and are_printed:
        return sorted(files, key=lambda file: natural_key(_stem_of(file), _NUMBER.pattern))
    return sorted(files, key=lambda file: natural_key(file.name))


def strays_among(files: Sequence[Path]) -> list[Path]:
    """Finds files without a number among three numbered ones at least, such as `map.pcd` among 0001.pcd, 0002.pcd.

    Args:
        files: files of one ending.

    Returns:
        The files that are no scans; empty where half of the files or more have no number.
    """
    plain = [file for file in files if not re.search(r"\d", _stem_of(file))]
    num_numbered = len(files) - len(plain)
    return plain if num_numbered >= max(3, len(plain) + 1) else []


def stamps_in_names(files: Sequence[Path]) -> FloatArray | None:
    """Reads the time stamps that are the last numbers in the names: decimals, or numbers of ten digits or more.

    Seconds and nanoseconds may be numbers of their own, as in 1600000000_250000000.

    Args:
        files: the scans in order.

    Returns:
        (n,) in any unit; None where a name has none, or they do not increase.
    """
    found = [_NUMBER.findall(_SPLIT_STAMP.sub(r"\1.\2", _stem_of(file))) for file in files]
    last = [numbers[-1] if numbers else "" for numbers in found]
    # A number of ten digits is a time stamp: seconds since 1970, or a smaller unit.
    if not last or not all("." in number or 10 <= len(number) < 20 for number in last):
        return None
    stamps = np.array(last, np.float64)
    return stamps if bool((np.diff(stamps) > 0).all()) else None


def last_numbers(files: Sequence[Path]) -> list[int]:
    """Returns the last number in each name.

    Args:
        files: the scans.

    Returns:
        One number a file.

    Raises:
        InputError: a name has no number, or one that is too large.
    """
    numbers = []
    for file in files:
        found = re.findall(r"[0-9]+", _stem_of(file))
        is_good = bool(found) and int(found[-1]) <= 2**62
        require(is_good, file, "a file name without a number of a scan", "keep the names of the data set")
        numbers.append(int(found[-1]))
    return numbers
