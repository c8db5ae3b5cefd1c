"""Calibration files of KITTI: labelled rows of numbers, and the camera in the lidar's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpmjax.io.files import read_lines
from dpmjax.io.poses import from_rows
from dpmjax.sequences import FloatArray, InputError


def read_labelled_numbers(path: Path) -> dict[str, FloatArray]:
    """Reads the lines `key: numbers` of a calibration file; other lines are ignored.

    Args:
        path: the file.

    Returns:
        The numbers by key.

    Raises:
        InputError: there is no such file.
    """
    found = {}
    for key, _, numbers in (line.partition(":") for line in read_lines(path)):
        try:
            found[key.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue
    return found


def read_camera_calibration(path: Path) -> FloatArray:
    """Reads `Tr`, the lidar's frame to the left grey camera's, out of KITTI's calib.txt.

    Args:
        path: the file.

    Returns:
        (4, 4) `T_cam0_lidar`.

    Raises:
        InputError: there is no such file, or no such line in it.
    """
    entries = read_labelled_numbers(path)
    for key in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
        if key in entries and len(entries[key]) == 12:
            return np.asarray(from_rows(entries[key], path)[0])
    advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
    raise InputError(path, "no line 'Tr:' of 12 numbers", advice)
