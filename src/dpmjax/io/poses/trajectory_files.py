"""Trajectories on disk: TUM, KITTI and NumPy files out, and in again as the start of a fit.

A planar pose is x, y, heading of `T_world_scan`; in the spatial formats z is zero and the heading turns about z.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.io.errors import InputError
from dpmjax.io.files import write_atomically

_SHAPES = (
    "x y theta, TUM (stamp tx ty tz qx qy qz qw), KITTI (12 numbers a row), or .npy of (n, 3), (n, 3, 3) or (n, 4, 4)"
)
_LARGEST_TILT_DEG = 10.0


def planar_to_homogeneous(poses: ArrayLike) -> NDArray[np.float64]:
    """Puts planar poses into space.

    Args:
        poses: (n, 3) x, y, heading in radians.

    Returns:
        (n, 4, 4) `T_world_scan`, z up.

    Raises:
        ValueError: another shape.
    """
    planar = np.asarray(poses, np.float64)
    if planar.ndim != 2 or planar.shape[1] != 3:
        raise ValueError(f"poses must be (n, 3), got {planar.shape}")
    cos, sin = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    matrices = np.tile(np.eye(4), (len(planar), 1, 1))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = cos, -sin, sin, cos
    matrices[:, :2, 3] = planar[:, :2]
    return matrices


def write_tum(
    path: str | Path, poses: ArrayLike, *, times: ArrayLike | None = None, unit: str = "m", frame: str = "T_world_scan"
) -> Path:
    """Writes `stamp tx ty tz qx qy qz qw` rows under a comment that tells the frame.

    Translations and the quaternion (x y z w) have nine decimals, stamps six.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).
        times: (n,) seconds; the number of the scan where None.
        unit: unit of the translations, for the comment.
        frame: what the poses map, for the comment.

    Returns:
        The path.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    matrices = _matrices(poses)
    stamps = np.arange(len(matrices), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    if stamps.shape != (len(matrices),) or not np.isfinite(stamps).all():
        raise ValueError(f"times must be ({len(matrices)},) and finite, got {stamps.shape}")
    rows = [f"# stamp_s tx ty tz qx qy qz qw; {frame}, unit {unit}"]
    for stamp, matrix, quaternion in zip(stamps, matrices, _quaternions(matrices[:, :3, :3]), strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*matrix[:3, 3], *quaternion))
        rows.append(f"{stamp:.6f} {numbers}")
    return write_atomically(path, "\n".join(rows) + "\n")


def write_kitti(path: str | Path, poses: ArrayLike) -> Path:
    """Writes 12 numbers a row: the first three rows of `T_world_scan`, row-major; no header, as its readers know none.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).

    Returns:
        The path.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    rows = [" ".join(f"{value:.9e}" for value in matrix[:3].ravel()) for matrix in _matrices(poses)]
    return write_atomically(path, "".join(f"{row}\n" for row in rows))


def write_poses_npy(path: str | Path, poses: ArrayLike) -> Path:
    """Writes poses as they are, (n, 3) or (n, 4, 4), float64.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).

    Returns:
        The path.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    _matrices(poses)
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(poses, np.float64))
    return write_atomically(path, buffer.getvalue())


def read_initial_poses(path: str | Path, num_scans: int, unit: Literal["px", "m"]) -> NDArray[np.float64]:
    """Reads a trajectory to start a fit from.

    Args:
        path: `.npy` of (n, 3), (n, 3, 3) or (n, 4, 4); or text with `#` comments and rows of `x y theta`, TUM or KITTI.
        num_scans: how many poses there must be.
        unit: unit of the scans; the file must be in it, and is refused where its comment names the other.

    Returns:
        (num_scans, 3) float64 x, y in `unit`, heading in radians.

    Raises:
        InputError: no such file, an unknown layout, a wrong count, NaN, the other unit, or poses that leave the plane.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file", f"give a trajectory: {_SHAPES}")
    poses = _read_npy(path) if path.suffix.lower() == ".npy" else _read_text(path, unit)
    if len(poses) != num_scans:
        raise InputError(path, f"{len(poses)} poses for {num_scans} scans", "give one pose a scan, in the scans' order")
    return poses


def _matrices(poses: ArrayLike) -> NDArray[np.float64]:
    """(n, 4, 4) out of (n, 3) or (n, 4, 4)."""
    values = np.asarray(poses, np.float64)
    if not (values.ndim == 2 and values.shape[1] == 3) and values.shape[1:] != (4, 4):
        raise ValueError(f"poses must be (n, 3) or (n, 4, 4), got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("poses must be finite")
    return planar_to_homogeneous(values) if values.ndim == 2 else values


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4) x y z w with w >= 0."""
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return np.zeros((0, 4))
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)


def _read_npy(path: Path) -> NDArray[np.float64]:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(path, f"not a readable NumPy file ({error})", "save it again with numpy.save") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise InputError(path, "no array of numbers", f"give {_SHAPES}")
    values = values.astype(np.float64)
    _check_finite(values, path)
    if values.ndim == 2 and values.shape[1] == 3:
        return values
    if values.ndim == 3 and values.shape[1:] == (3, 3):
        return np.column_stack([values[:, :2, 2], np.arctan2(values[:, 1, 0], values[:, 0, 0])])
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        return _flatten(values[:, :3, 3], values[:, :3, :3], path)
    raise InputError(path, f"an array of {values.shape}", f"give {_SHAPES}")


def _read_text(path: Path, unit: str) -> NDArray[np.float64]:
    lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    comments = " ".join(line for line in lines if line.startswith("#"))
    named = re.search(r"(?:\bunit |\bx_)(px|m)\b", comments)
    if named and named.group(1) != unit:
        raise InputError(path, f"poses in {named.group(1)}, the scans are in {unit}", f"give poses in {unit}")
    rows = [line.replace(",", " ").split() for line in lines if line and not line.startswith("#")]
    widths = {len(row) for row in rows}
    if len(widths) != 1 or not widths <= {3, 8, 12}:
        found = f"rows of {' and '.join(map(str, sorted(widths)))} columns" if rows else "no row"
        raise InputError(path, found, f"give {_SHAPES}")
    try:
        values = np.array(rows, np.float64)
    except ValueError as error:
        raise InputError(path, f"not a number ({error})", f"give {_SHAPES}") from error
    _check_finite(values, path)
    if values.shape[1] == 3:
        return values
    if values.shape[1] == 12:
        matrices = values.reshape(-1, 3, 4)
        return _flatten(matrices[:, :, 3], matrices[:, :, :3], path)
    from scipy.spatial.transform import Rotation

    if (np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1) > 0.01).any():
        raise InputError(path, "quaternions of another length than 1", "write TUM rows: stamp tx ty tz qx qy qz qw")
    return _flatten(values[:, 1:4], Rotation.from_quat(values[:, 4:]).as_matrix(), path)


def _check_finite(values: NDArray[np.float64], path: Path) -> None:
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        raise InputError(
            path, f"NaN or infinite values, the first in row {int(np.argmax(bad))}", "give a pose to every scan"
        )


def _flatten(positions: NDArray[np.float64], rotations: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Planar poses (n, 3) of spatial ones that stand upright."""
    tilt = np.rad2deg(np.arccos(np.clip(rotations[:, 2, 2], -1, 1)))
    if (tilt > _LARGEST_TILT_DEG).any():
        found = f"pose {int(np.argmax(tilt))} is tilted by {tilt.max():.0f} degrees"
        raise InputError(path, found, "give poses of an upright sensor, z up (not of a camera)")
    return np.column_stack([positions[:, :2], np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])])
