"""Scans as plain NumPy arrays: `.npy` of end points, `.npz` of end points or of ranges and angles, with poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.io.files import load_arrays, to_float32
from dpmjax.io.poses import check_poses
from dpmjax.sequences import BoolArray, FloatArray, InputError, ScanSequence, has_angular_order

Table = Mapping[str, NDArray[np.generic]]
_KEYS = "points (n, b, 2), or ranges (n, b) and angles (b,); optional mask, poses, odometry, times, unit"


def read_arrays(path: str | Path, *, unit: Literal["px", "m"] | None = None) -> ScanSequence:
    """Reads scans from `.npy` or `.npz`.

    A `.npy` holds points (n, b, 2) in the sensor frame; the third coordinate of (n, b, 3) is ignored. A `.npz` holds
    `points` like that, or `ranges` (n, b) with `angles` (b,) or (n, b) in radians counter-clockwise from straight
    ahead; and optionally `mask` (n, b), `poses` (the reference) and `odometry` as (n, 3) x, y, heading or (n, 3, 3)
    `T_world_scan`, `times` (n,) in seconds, and `unit`, "px" or "m".

    A beam is invalid where `mask` is False, where both coordinates are NaN, or where its range is NaN, infinite or not
    positive (as scanner drivers write a beam without echo). A beam with one NaN coordinate is an error.

    Args:
        path: the file.
        unit: unit of lengths; None takes the file's `unit`, and "m" where it has none.

    Returns:
        The sequence.

    Raises:
        InputError: the file is missing or damaged, lacks an array, has wrong shapes, or holds NaN or infinite values
            other than for invalid beams.
    """
    table = load_arrays(path)
    points, mask = _points(table, path) if "points" in table else _from_ranges(table, path)
    if "mask" in table:
        given = table["mask"]
        if given.shape != mask.shape or given.dtype.kind not in "biu":
            raise InputError(path, f"mask is {given.shape} {given.dtype}", f"give {mask.shape} booleans")
        mask &= given.astype(bool)
    stored = np.where(mask[..., None], to_float32(points), np.float32(0))
    bad = ~np.isfinite(stored).all(axis=2)
    if bad.any():
        scan, beam = np.argwhere(bad)[0]
        advice = "mark an invalid beam by NaN in both coordinates"
        raise InputError(path, f"{bad.sum()} NaN or infinite points, the first in scan {scan}, beam {beam}", advice)
    times = table.get("times")
    if times is not None and (
        times.shape != (len(points),) or times.dtype.kind not in "fiu" or not np.isfinite(times).all()
    ):
        raise InputError(path, f"times are {times.shape} {times.dtype}", f"give ({len(points)},) finite seconds")
    return ScanSequence(
        name=Path(path).stem,
        points=stored,
        mask=mask,
        unit=unit or _unit(table, path),
        is_organised=has_angular_order(stored, mask),
        reference_poses=_planar(table, "poses", len(points), path),
        odometry_poses=_planar(table, "odometry", len(points), path),
        times=None if times is None else times.astype(np.float64),
    )


def _points(table: Table, path: str | Path) -> tuple[FloatArray, BoolArray]:
    points = table["points"]
    if points.ndim != 3 or points.shape[2] not in (2, 3) or points.dtype.kind not in "fiu":
        raise InputError(path, f"points are {points.shape} {points.dtype}", "give (n, b, 2): scans, beams, x and y")
    planar = points[..., :2].astype(np.float64)
    return planar, np.isnan(planar).sum(axis=2) < 2


def _from_ranges(table: Table, path: str | Path) -> tuple[FloatArray, BoolArray]:
    if "ranges" not in table or "angles" not in table:
        raise InputError(path, f"keys are {', '.join(table) or 'none'}", f"give {_KEYS}")
    ranges, angles = table["ranges"], table["angles"]
    fits = ranges.ndim == 2 and angles.shape in (ranges.shape, ranges.shape[1:])
    if not fits or ranges.dtype.kind not in "fiu" or angles.dtype.kind not in "fiu":
        raise InputError(path, f"ranges are {ranges.shape}, angles {angles.shape}", "give (n, b) and (b,) or (n, b)")
    distance, theta = ranges.astype(np.float64), angles.astype(np.float64)
    if not (np.abs(theta) < 1e6).all():
        raise InputError(path, "angles hold NaN, infinite or huge values", "give a direction to every beam, in radians")
    mask = np.isfinite(distance) & (distance > 0)
    distance = np.where(mask, distance, 0.0)
    return distance[..., None] * np.stack([np.cos(theta), np.sin(theta)], axis=-1), mask


def _unit(table: Table, path: str | Path) -> Literal["px", "m"]:
    unit = str(table["unit"]) if "unit" in table else "m"
    if unit not in ("px", "m"):
        raise InputError(path, f"unit is {unit!r}", "say 'px' or 'm'")
    return "px" if unit == "px" else "m"


def _planar(table: Table, key: str, num_scans: int, path: str | Path) -> FloatArray | None:
    """Poses (n, 3) x, y, heading out of (n, 3) or homogeneous (n, 3, 3)."""
    if key not in table:
        return None
    poses = table[key]
    if poses.shape not in ((num_scans, 3), (num_scans, 3, 3)) or poses.dtype.kind not in "fiu":
        found = f"{key} are {poses.shape} for {num_scans} scans"
        raise InputError(path, found, "give (n, 3) x, y, heading or (n, 3, 3)")
    values = check_poses(poses.astype(np.float64), f"{path}: {key}")
    return values if values.ndim == 2 else se2.from_matrix(values)
