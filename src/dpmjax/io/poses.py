"""Trajectories on disk: TUM, KITTI and NumPy files, planar and spatial.

A planar pose is x, y, heading of `T_world_scan`; in space its z is zero and the heading turns about z.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.geometry import se2
from dpmjax.io.files import load_arrays, read_lines, read_table, write_atomically
from dpmjax.sequences import FloatArray, InputError

_LAYOUTS = (
    "x y theta, TUM (stamp tx ty tz qx qy qz qw), KITTI (12 numbers a row), or .npy of (n, 3), (n, 3, 3) or (n, 4, 4)"
)
_LARGEST_TILT_DEG = 10.0


def read_poses(path: str | Path) -> FloatArray:
    """Reads poses as they stand in the file, whatever frame they are in.

    Args:
        path: text with rows of x y theta, TUM or KITTI; or `.npy` of (n, 3), (n, 3, 3), (n, 4, 4) or (n, 12).

    Returns:
        (n, 4, 4).

    Raises:
        InputError: no such file, another layout, NaN, or a matrix that is no rigid motion.
    """
    poses = _read(Path(path))
    return planar_to_homogeneous(poses) if poses.ndim == 2 else poses


def read_planar_poses(path: str | Path, num_scans: int, unit: Literal["px", "m"]) -> FloatArray:
    """Reads the planar trajectory of a set of scans.

    Args:
        path: see `read_poses`.
        num_scans: how many poses there must be.
        unit: unit of the scans; a text file whose comment names the other unit is refused.

    Returns:
        (num_scans, 3) float64 x, y in `unit`, heading in radians.

    Raises:
        InputError: see `read_poses`; or a wrong count, the other unit, or poses that leave the plane.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() != ".npy":
        comments = " ".join(line for line in read_lines(path) if line.strip().startswith("#"))
        named = re.search(r"(?:\bunit |\bx_)(px|m)\b", comments)
        if named and named.group(1) != unit:
            raise InputError(path, f"poses in {named.group(1)}, the scans are in {unit}", f"give poses in {unit}")
    poses = _read(path)
    if len(poses) != num_scans:
        raise InputError(path, f"{len(poses)} poses for {num_scans} scans", "give one pose a scan, in the scans' order")
    if poses.ndim == 2:
        return poses
    tilt = np.rad2deg(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))
    if (tilt > _LARGEST_TILT_DEG).any():
        found = f"pose {int(np.argmax(tilt))} is tilted by {tilt.max():.0f} degrees"
        raise InputError(path, found, "give poses of an upright sensor, z up (not of a camera)")
    return np.column_stack([poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])


def write_tum(
    path: str | Path, poses: ArrayLike, *, times: ArrayLike | None = None, unit: str = "m", frame: str = "T_world_scan"
) -> Path:
    """Writes `stamp tx ty tz qx qy qz qw` rows under a comment that names the frame.

    Translations and the quaternion (x y z w) have nine decimals, stamps six.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).
        times: (n,) seconds; the number of the scan where None.
        unit: unit of the translations, for the comment.
        frame: the transform that the poses are, for the comment.

    Returns:
        The path.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    matrices = _as_matrices(poses)
    stamps = np.arange(len(matrices), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    if stamps.shape != (len(matrices),) or not np.isfinite(stamps).all():
        raise ValueError(f"times must be ({len(matrices)},) and finite, got {stamps.shape}")
    rows = [f"# stamp_s tx ty tz qx qy qz qw; {frame}, unit {unit}"]
    for stamp, matrix, quaternion in zip(stamps, matrices, _to_quaternions(matrices[:, :3, :3]), strict=True):
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
        ValueError: see `write_tum`.
    """
    rows = [" ".join(f"{value:.9e}" for value in matrix[:3].ravel()) for matrix in _as_matrices(poses)]
    return write_atomically(path, "".join(f"{row}\n" for row in rows))


def write_poses_npy(path: str | Path, poses: ArrayLike) -> Path:
    """Writes poses as an array of float64, in the shape that they have.

    Args:
        path: file to write, atomically.
        poses: (n, 3) or (n, 4, 4), as `write_tum` takes them.

    Returns:
        The path.

    Raises:
        ValueError: see `write_tum`.
    """
    _as_matrices(poses)
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(poses, np.float64))
    return write_atomically(path, buffer.getvalue())


def planar_to_homogeneous(poses: FloatArray) -> FloatArray:
    """Puts planar poses into space.

    Args:
        poses: (n, 3) x, y, heading in radians.

    Returns:
        (n, 4, 4) `T_world_scan`, z up.
    """
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :2, :2], matrices[:, :2, 3] = se2.rotation(poses[:, 2]), poses[:, :2]
    return matrices


def to_homogeneous(rows: FloatArray) -> FloatArray:
    """Matrices of KITTI rows.

    Args:
        rows: (n, 12) first three rows, row-major.

    Returns:
        (n, 4, 4).
    """
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.reshape(-1, 3, 4)
    return matrices


def check_poses(poses: FloatArray, source: str | Path) -> FloatArray:
    """Refuses poses that are not finite or no rigid motions.

    Args:
        poses: (n, 4, 4), or planar (n, 3, 3) or (n, 3).
        source: for messages.

    Returns:
        The poses.

    Raises:
        InputError: names the first bad pose.
    """
    bad = ~np.isfinite(poses.reshape(len(poses), -1)).all(axis=1)
    if bad.any():
        raise InputError(source, f"NaN or infinite values in pose {int(np.argmax(bad))}", "give a pose to every scan")
    if poses.ndim == 3:
        dim = poses.shape[2] - 1
        turn = poses[:, :dim, :dim]
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(dim)).max(axis=(1, 2))
            bad = ~(off <= 1e-2) | ~(np.linalg.det(turn) > 0)
        if bad.any():
            raise InputError(source, f"pose {int(np.argmax(bad))} is no rigid motion", "give rotation matrices")
    return poses


def interpolate_poses(times: FloatArray, poses: FloatArray, wanted: FloatArray) -> FloatArray:
    """Poses at other times: positions linear, rotations on the shortest arc.

    Args:
        times: (n,) increasing.
        poses: (n, 4, 4).
        wanted: (m,) times; beyond the ends, the first and the last pose are held.

    Returns:
        (m, 4, 4).
    """
    from scipy.spatial.transform import Rotation, Slerp

    at = np.clip(wanted, times[0], times[-1])
    found = np.tile(np.eye(4), (len(at), 1, 1))
    found[:, :3, 3] = np.column_stack([np.interp(at, times, column) for column in poses[:, :3, 3].T])
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    found[:, :3, :3] = (Slerp(times, rotations)(at) if len(times) > 1 else rotations[[0] * len(at)]).as_matrix()
    return found


def _read(path: Path) -> FloatArray:
    """Checked poses of a file: planar (n, 3), or (n, 4, 4)."""
    if path.suffix.lower() == ".npy":
        array = load_arrays(path).get("points", np.zeros(0))
        if array.dtype.kind not in "fiu":
            raise InputError(path, f"an array of {array.dtype}", f"give {_LAYOUTS}")
        values = array.astype(np.float64)
    else:
        values = read_table(path)
    if values.ndim == 3 and values.shape[1:] == (3, 3):
        return se2.from_matrix(check_poses(values, path))
    if values.ndim == 3 and values.shape[1:] == (4, 4):
        values = values.reshape(-1, 16)
    width = values.shape[1] if values.ndim == 2 else 0
    if width not in (3, 8, 12, 16) or not len(values):
        found = f"rows of {width} columns" if width else f"an array of {values.shape}"
        raise InputError(path, found, f"give {_LAYOUTS}")
    if width == 3:
        return check_poses(values, path)
    return check_poses(_from_tum(values, path) if width == 8 else to_homogeneous(values[:, :12]), path)


def _from_tum(rows: FloatArray, path: Path) -> FloatArray:
    from scipy.spatial.transform import Rotation

    if not np.isfinite(rows).all():
        raise InputError(path, "NaN or infinite values", "give a pose to every scan")
    if not (np.abs(np.linalg.norm(np.clip(rows[:, 4:], -2, 2), axis=1) - 1) <= 0.01).all():
        raise InputError(path, "quaternions of another length than 1", "write TUM rows: stamp tx ty tz qx qy qz qw")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = rows[:, 1:4], Rotation.from_quat(rows[:, 4:]).as_matrix()
    return poses


def _to_quaternions(rotations: FloatArray) -> FloatArray:
    """(n, 4) x y z w with w >= 0."""
    from scipy.spatial.transform import Rotation

    if not len(rotations):
        return np.zeros((0, 4))
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)


def _as_matrices(poses: ArrayLike) -> FloatArray:
    """(n, 4, 4) out of (n, 3) or (n, 4, 4)."""
    values = np.asarray(poses, np.float64)
    if not (values.ndim == 2 and values.shape[1] == 3) and values.shape[1:] != (4, 4):
        raise ValueError(f"poses must be (n, 3) or (n, 4, 4), got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("poses must be finite")
    return planar_to_homogeneous(values) if values.ndim == 2 else values
