"""Trajectories on disk: TUM, KITTI and NumPy files, planar and spatial.

A planar pose is x, y, heading of `T_world_scan`; in space its z is zero and the heading turns about z.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dpmjax.geometry import se2
from dpmjax.io.files import load_arrays, read_lines, read_table, write_atomically
from dpmjax.sequences import FloatArray, Unit, counted, homogeneous, require

_LAYOUTS = (
    "x y theta, TUM (stamp tx ty tz qx qy qz qw), EuRoC (with its line of names), KITTI (12 numbers a row), or .npy of "
    "(n, 3), (n, 3, 3) or (n, 4, 4)"
)
# Names of the columns of quaternions that begin with their real part, as of EuRoC: q_RS_w, q_RS_x or qw, qx.
_IS_W_FIRST = re.compile(r"\bq\w*w\b.*\bq\w*x\b", re.IGNORECASE)
_W_FIRST_COLUMNS = [0, 1, 2, 3, 5, 6, 7, 4]


def read_poses(path: str | Path) -> FloatArray:
    """Reads poses in the frame of the file.

    Args:
        path: text with rows of x y theta, TUM, EuRoC or KITTI; or `.npy` of (n, 3), (n, 3, 3), (n, 4, 4) or (n, 12).

    Returns:
        (n, 4, 4).

    Raises:
        InputError: no such file, another layout, NaN, or a matrix that is no rigid motion.
    """
    return read_stamped_poses(path).poses


class StampedPoses(NamedTuple):
    """The poses of a file.

    Attributes:
        poses: (n, 4, 4).
        stamps: (n,) in the unit of the file; None where it has none.
    """

    poses: FloatArray
    stamps: FloatArray | None


def read_stamped_poses(path: str | Path) -> StampedPoses:
    """Reads poses, and the time stamps of TUM files.

    Args:
        path: see `read_poses`.

    Returns:
        The poses, in the frame of the file.

    Raises:
        InputError: see `read_poses`.
    """
    poses, stamps = _read(Path(path))
    return StampedPoses(planar_to_homogeneous(poses) if poses.ndim == 2 else poses, stamps)


def read_planar_poses(path: str | Path, num_scans: int, unit: Unit) -> FloatArray:
    """Reads the planar trajectory of a set of scans.

    Args:
        path: see `read_poses`.
        num_scans: required number of poses.
        unit: unit of the scans; a text file whose comment names a different unit is refused.

    Returns:
        (num_scans, 3) float64 x, y in `unit`, heading in radians.

    Raises:
        InputError: see `read_poses`; or a wrong count, a different unit, or poses that leave the plane.
    """
    path = Path(path)
    text = (
        "" if path.suffix.lower() == ".npy" else " ".join(line for line in read_lines(path) if line.strip()[:1] == "#")
    )
    stated = re.findall(r"(?:\bunit |\bx_)(px|m)\b", text)[:1] or [unit]
    require(stated == [unit], path, f"poses in {stated[0]}, the scans are in {unit}", f"give poses in {unit}")
    poses, _ = _read(path)
    found = f"{counted(len(poses), 'pose')} for {num_scans} scans"
    require(len(poses) == num_scans, path, found, "give one pose a scan, in the scans' order")
    if poses.ndim == 2:
        return poses
    tilt = np.rad2deg(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))
    found = f"pose {tilt.argmax()} is tilted by {tilt.max():.0f} degrees"
    require(tilt.max() <= 10.0, path, found, "give poses of an upright sensor, z up (not of a camera)")
    return np.column_stack([poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])


def write_tum(
    path: str | Path, poses: ArrayLike, *, times: ArrayLike | None = None, unit: str = "m", frame: str = "T_world_scan"
) -> Path:
    """Writes `stamp tx ty tz qx qy qz qw` rows under a comment that names the frame.

    Translations and the quaternion (x y z w) have nine decimals, stamps six.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).
        times: (n,) seconds; None: the number of the scan.
        unit: unit of the translations, for the comment.
        frame: name of the transform, for the comment.

    Returns:
        The path.

    Raises:
        ValueError: wrong shapes, or values that are not finite.
    """
    from scipy.spatial.transform import Rotation

    matrices = _as_matrices(poses)
    stamps = np.arange(len(matrices), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    if stamps.shape != (len(matrices),) or not np.isfinite(stamps).all():
        raise ValueError(f"times must be ({len(matrices)},) and finite, got {stamps.shape}")
    turns = matrices[:, :3, :3]
    quaternions = Rotation.from_matrix(turns).as_quat(canonical=True) if len(turns) else np.zeros((0, 4))
    values = np.column_stack([stamps, matrices[:, :3, 3], quaternions])
    header = f"stamp_s tx ty tz qx qy qz qw; {frame}, unit {unit}"
    return _write_table(path, values, ["%.6f", *["%.9f"] * 7], header)


def write_kitti(path: str | Path, poses: ArrayLike) -> Path:
    """Writes 12 numbers for each pose, the first three rows of `T_world_scan`, row-major, without a header.

    Args:
        path: file to write, atomically.
        poses: (n, 3) x, y, heading, or (n, 4, 4).

    Returns:
        The path.

    Raises:
        ValueError: see `write_tum`.
    """
    return _write_table(path, _as_matrices(poses)[:, :3].reshape(-1, 12), "%.9e")


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
    """Converts planar poses to homogeneous matrices in space.

    Args:
        poses: (n, 3) x, y, heading in radians.

    Returns:
        (n, 4, 4) `T_world_scan`, z up.
    """
    matrices = homogeneous(np.eye(3), np.pad(poses[:, :2], ((0, 0), (0, 1))))
    matrices[:, :2, :2] = se2.rotation(poses[:, 2])
    return matrices


def from_rows(rows: FloatArray, source: str | Path) -> FloatArray:
    """Converts KITTI rows to checked matrices.

    Args:
        rows: (n, 12) or (12,), the first three rows of each matrix, row-major.
        source: source for messages.

    Returns:
        (n, 4, 4).

    Raises:
        InputError: see `check_poses`.
    """
    tops = rows.reshape(-1, 3, 4)
    return check_poses(homogeneous(tops[..., :3], tops[..., 3]), source)


def check_poses(poses: FloatArray, source: str | Path) -> FloatArray:
    """Refuses poses that are not finite or no rigid motions.

    Args:
        poses: (n, 4, 4), or planar (n, 3, 3) or (n, 3).
        source: source for messages.

    Returns:
        The poses.

    Raises:
        InputError: names the first bad pose.
    """
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=tuple(range(1, poses.ndim))))
    found = f"NaN or infinite values in pose {next(iter(bad), None)}"
    require(not len(bad), source, found, "give a pose to every scan, or remove its line")
    if poses.ndim == 3:
        turn = poses[:, :-1, :-1]
        with np.errstate(over="ignore", invalid="ignore"):
            off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(turn.shape[1])).max(axis=(1, 2))
            bad = np.flatnonzero(~(off <= 1e-2) | ~(np.linalg.det(turn) > 0))
        require(not len(bad), source, f"pose {next(iter(bad), None)} is no rigid motion", "give rotation matrices")
    return poses


def planar_rows(values: NDArray[np.generic], num_scans: int, source: str | Path) -> FloatArray:
    """Converts an array of planar poses to checked rows.

    Args:
        values: (n, 3) x, y, heading, or homogeneous (n, 3, 3).
        num_scans: required number of poses.
        source: source for messages.

    Returns:
        (n, 3).

    Raises:
        InputError: another shape, or see `check_poses`.
    """
    is_good = values.shape in ((num_scans, 3), (num_scans, 3, 3)) and values.dtype.kind in "fiu"
    found = f"poses are {values.shape} {values.dtype} for {num_scans} scans"
    require(is_good, source, found, "give (n, 3) x, y, heading or (n, 3, 3)")
    poses = check_poses(values.astype(np.float64), source)
    return poses if poses.ndim == 2 else se2.from_matrix(poses)


def interpolate_poses(times: FloatArray, poses: FloatArray, wanted: FloatArray) -> FloatArray:
    """Interpolates poses: positions linearly, rotations on the shortest arc.

    Args:
        times: (n,) increasing.
        poses: (n, 4, 4).
        wanted: (m,) times; beyond the ends, the first or the last pose.

    Returns:
        (m, 4, 4).
    """
    from scipy.spatial.transform import Rotation, Slerp

    at = np.clip(wanted, times[0], times[-1])
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    turned = Slerp(times, rotations)(at) if len(times) > 1 else rotations[[0] * len(at)]
    positions = np.column_stack([np.interp(at, times, column) for column in poses[:, :3, 3].T])
    return homogeneous(turned.as_matrix(), positions)


def _write_table(path: str | Path, values: FloatArray, form: str | list[str], header: str = "") -> Path:
    buffer = io.StringIO()
    np.savetxt(buffer, values, form, header=header)
    return write_atomically(path, buffer.getvalue())


def _read(path: Path) -> tuple[FloatArray, FloatArray | None]:
    """Reads checked poses of a file, planar (n, 3) or (n, 4, 4), and the stamps of TUM's rows."""
    if path.suffix.lower() == ".npy":
        array = load_arrays(path).get("points", np.zeros(0))
        values = array.astype(np.float64) if array.dtype.kind in "fiu" else np.zeros(0)
    else:
        values = read_table(path)
        if values.shape[1] >= 8 and any(map(_IS_W_FIRST.search, read_lines(path))):
            values = values[:, _W_FIRST_COLUMNS]
    if values.shape[1:] == (3, 3):
        return se2.from_matrix(check_poses(values, path)), None
    values = values.reshape(-1, 16) if values.shape[1:] == (4, 4) else values
    width = values.shape[1] if values.ndim == 2 else 0
    found = f"rows of {width} columns" if width else "no array of poses"
    require(width in (3, 8, 12, 16) and len(values) > 0, path, found, f"give {_LAYOUTS}")
    if width != 8:
        return check_poses(values, path) if width == 3 else from_rows(values[:, :12], path), None
    from scipy.spatial.transform import Rotation

    check_poses(values, path)
    is_unit = (np.abs(np.linalg.norm(np.clip(values[:, 4:], -2, 2), axis=1) - 1) <= 0.01).all()
    require(is_unit, path, "quaternions of another length than 1", "write TUM rows: stamp tx ty tz qx qy qz qw")
    return homogeneous(Rotation.from_quat(values[:, 4:]).as_matrix(), values[:, 1:4]), values[:, 0]


def _as_matrices(poses: ArrayLike) -> FloatArray:
    """Converts (n, 3) or (n, 4, 4) to (n, 4, 4)."""
    values = np.asarray(poses, np.float64)
    if values.shape[1:] not in ((3,), (4, 4)) or not np.isfinite(values).all():
        raise ValueError(f"poses must be (n, 3) or (n, 4, 4) and finite, got {values.shape}")
    return planar_to_homogeneous(values) if values.ndim == 2 else values
