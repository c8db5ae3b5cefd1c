"""Poses of 3-D drives on disk: pose files, calibrations, GPS/IMU records; all brought to `T_world_lidar`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.io.errors import InputError

_EARTH_RADIUS_M = 6378137.0


def read_poses(path: str | Path) -> NDArray[np.float64]:
    """Reads poses as they stand in the file, whatever frame they are in.

    Args:
        path: KITTI rows of 12 numbers, TUM rows of 8, or `.npy` of (n, 4, 4) or (n, 12). Lines with # are passed over.

    Returns:
        (n, 4, 4).

    Raises:
        InputError: no such file, another layout, NaN, or what is no rotation.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False).astype(np.float64)
        except (OSError, ValueError, EOFError, TypeError) as error:
            raise InputError(path, f"not a readable NumPy file ({error})", "save it again with numpy.save") from error
        values = values.reshape(len(values), -1) if values.ndim == 3 else values
    else:
        values = read_table(path)
    if values.ndim != 2 or values.shape[1] not in (8, 12, 16):
        raise InputError(path, f"an array of {values.shape}", "give KITTI rows of 12 numbers or TUM rows of 8")
    poses = _from_tum(values, path) if values.shape[1] == 8 else homogeneous(values[:, :12])
    return check_poses(poses, path)


def read_table(path: str | Path, *, skip: int = 0) -> NDArray[np.float64]:
    """Reads rows of numbers, parted by blanks or commas.

    Args:
        path: the file; empty lines and lines with # in front are passed over.
        skip: words to leave out at the start of each row.

    Returns:
        (n, k).

    Raises:
        InputError: no such file, no row, rows of different length, or what is no number.
    """
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path") from error
    rows = [line.replace(",", " ").split()[skip:] for line in text.splitlines() if line.strip()[:1] not in ("", "#")]
    if len({len(row) for row in rows}) != 1:
        widths = " and ".join(map(str, sorted({len(row) for row in rows})))
        raise InputError(path, f"rows of {widths} numbers" if rows else "no row", "give rows of equal length")
    try:
        return np.array(rows, np.float64)
    except ValueError as error:
        raise InputError(path, f"not a number ({error})", "write plain decimal numbers") from error


def check_poses(poses: NDArray[np.float64], source: str | Path) -> NDArray[np.float64]:
    """Refuses poses that are not finite or whose upper part is no rotation.

    Args:
        poses: (n, 4, 4).
        source: for messages.

    Returns:
        The poses.

    Raises:
        InputError: as said.
    """
    bad = ~np.isfinite(poses).all(axis=(1, 2))
    if bad.any():
        raise InputError(source, f"NaN or infinite values in pose {int(np.argmax(bad))}", "give finite poses")
    turn = poses[:, :3, :3]
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (off > 1e-2) | (np.linalg.det(turn) < 0)
    if bad.any():
        raise InputError(source, f"pose {int(np.argmax(bad))} is no rigid motion", "give rotation matrices")
    return poses


def homogeneous(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 4, 4) out of (n, 12) first three rows, row-major."""
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.reshape(-1, 3, 4)
    return matrices


def read_kitti_calibration(path: str | Path) -> NDArray[np.float64]:
    """Reads `Tr`, the lidar's frame to the left grey camera's, out of KITTI's calib.txt.

    Args:
        path: calib.txt.

    Returns:
        (4, 4) `T_cam0_lidar`.

    Raises:
        InputError: no such file, or no line `Tr:` of 12 numbers in it.
    """
    for key in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
        values = _labelled(path).get(key)
        if values is not None and len(values) == 12:
            return check_poses(homogeneous(values[None]), path)[0]
    advice = "take the calib.txt with a line 'Tr:' of 12 numbers (data_odometry_calib); camera poses need it"
    raise InputError(path, "no line 'Tr:' of 12 numbers", advice)


def read_rigid_calibration(path: str | Path) -> NDArray[np.float64]:
    """Reads KITTI raw's `R:` and `T:` lines, as in calib_imu_to_velo.txt.

    Args:
        path: the file.

    Returns:
        (4, 4).

    Raises:
        InputError: no such file, or the lines are missing.
    """
    entries = _labelled(path)
    turn, shift = entries.get("R", np.zeros(0)), entries.get("T", np.zeros(0))
    if len(turn) != 9 or len(shift) != 3:
        raise InputError(path, "no lines 'R:' of 9 and 'T:' of 3 numbers", "take KITTI's calibration file")
    return check_poses(homogeneous(np.column_stack([turn.reshape(3, 3), shift]).reshape(1, 12)), path)[0]


def lidar_poses_from_camera(
    T_world_cam0: NDArray[np.float64], T_cam0_lidar: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Brings KITTI's camera poses into the lidar's frame: `Tr^-1 T Tr`.

    Args:
        T_world_cam0: (n, 4, 4), world = first camera frame.
        T_cam0_lidar: (4, 4), `Tr`.

    Returns:
        (n, 4, 4) `T_world_lidar`, world = first lidar frame, where the first camera pose is the identity.
    """
    return rigid.inverse(T_cam0_lidar) @ T_world_cam0 @ T_cam0_lidar


def from_first(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses in the frame of the first one; takes the 1e6 m of national grids away."""
    return rigid.inverse(poses[0]) @ poses


def interpolate_poses(
    times: NDArray[np.float64], poses: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses at other times: positions linear, rotations on the shortest arc.

    Args:
        times: (n,) increasing.
        poses: (n, 4, 4).
        wanted: (m,) within the times; outside, the ends are held.

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


def poses_from_oxts(records: NDArray[np.float64]) -> NDArray[np.float64]:
    """KITTI raw's GPS/IMU records as poses, by the Mercator projection (Geiger et al. 2013, section III).

    Args:
        records: (n, 6 or more) latitude, longitude (degrees), altitude (m), roll, pitch, yaw (radians).

    Returns:
        (n, 4, 4) `T_world_imu`, world in metres, x east, y north, z up.
    """
    from scipy.spatial.transform import Rotation

    latitude, longitude = np.radians(records[:, 0]), np.radians(records[:, 1])
    scale = np.cos(latitude[0]) * _EARTH_RADIUS_M
    poses = np.tile(np.eye(4), (len(records), 1, 1))
    poses[:, 0, 3] = scale * longitude
    poses[:, 1, 3] = scale * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    poses[:, 2, 3] = records[:, 2]
    poses[:, :3, :3] = Rotation.from_euler("ZYX", records[:, [5, 4, 3]]).as_matrix()
    return poses


def _from_tum(values: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    if not np.isfinite(values).all() or (np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1) > 0.01).any():
        raise InputError(path, "quaternions of another length than 1", "write TUM rows: stamp tx ty tz qx qy qz qw")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = values[:, 1:4], Rotation.from_quat(values[:, 4:]).as_matrix()
    return poses


def _labelled(path: str | Path) -> dict[str, NDArray[np.float64]]:
    """Lines `key: numbers` of a calibration file; others are passed over."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "put the calibration file there") from error
    found = {}
    for key, _, numbers in (line.partition(":") for line in lines):
        try:
            found[key.strip()] = np.array(numbers.split(), np.float64)
        except ValueError:
            continue
    return found
