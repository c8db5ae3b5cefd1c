"""Errors of poses in float64 on the host: rigid alignment, ATE, RPE, point distance, recall of registrations.

Lengths come out in the unit they come in; angles in radians. Poses are `T_world_scan`, (n, d+1, d+1) with d = 2 or 3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from dpmjax.geometry import rigid
from dpmjax.types import AnyArray


class RelativePoseError(NamedTuple):
    """Errors of the motion between pairs of poses.

    Attributes:
        translation_rmse: in the unit of the poses.
        rotation_rmse: radians.
        num_pairs: how many pairs were compared.
    """

    translation_rmse: float
    rotation_rmse: float
    num_pairs: int


class RegistrationRecall(NamedTuple):
    """Errors of registrations of pairs of scans.

    Attributes:
        recall: share of pairs with both errors within the limits.
        translation_errors_m: (n,) of each pair.
        rotation_errors_deg: (n,) of each pair, in [0, 180].
        is_right: (n,) which pairs count; those with a pose that is not finite do not.
    """

    recall: float
    translation_errors_m: Float[np.ndarray, " n"]
    rotation_errors_deg: Float[np.ndarray, " n"]
    is_right: Bool[np.ndarray, " n"]


def align_rigid(estimated: Float[AnyArray, "n d"], reference: Float[AnyArray, "n d"]) -> Float[np.ndarray, "d1 d1"]:
    """The rigid motion, without scale, that brings estimated positions closest to the reference ones.

    Least squares in closed form (Horn 1987). What the positions leave open (n = 1; in 3-D all on one line) is settled
    by the rotation nearest to the identity.

    Args:
        estimated: (n, 2) or (n, 3) positions.
        reference: the same positions in another frame, the same unit.

    Returns:
        `T_reference_estimated`, (d+1, d+1) float64.

    Raises:
        ValueError: the shapes differ, are not (n, 2) or (n, 3) with n >= 1, or a number is not finite.
    """
    estimated = _checked_positions("estimated", estimated)
    reference = _checked_positions("reference", reference)
    require_same_shape("reference", reference, estimated)
    mean_estimated, mean_reference = estimated.mean(axis=0), reference.mean(axis=0)
    covariance = (estimated - mean_estimated).T @ (reference - mean_reference)
    dim = covariance.shape[0]
    scale = np.abs(covariance).max()
    # A pull towards the identity, far below what the data can tell, decides what they leave open.
    U, _, Vt = np.linalg.svd(covariance / scale + 1e-12 * np.eye(dim) if scale > 0 else np.eye(dim))
    sign = np.ones(dim)
    sign[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    T = np.eye(dim + 1)
    T[:dim, :dim] = (Vt.T * sign) @ U.T
    T[:dim, dim] = mean_reference - T[:dim, :dim] @ mean_estimated
    return T


def absolute_trajectory_error(estimated: Float[AnyArray, "n d"], reference: Float[AnyArray, "n d"]) -> float:
    """Root mean square distance of positions after the best rigid alignment (DeepMapping section 4; Sturm 2012).

    Args:
        estimated: positions, (n, 2) or (n, 3).
        reference: the same positions in another frame, the same unit.

    Returns:
        The error, in the unit of the positions.

    Raises:
        ValueError: the shapes differ, are not (n, 2) or (n, 3) with n >= 1, or a number is not finite.
    """
    T = align_rigid(estimated, reference)
    aligned = _transform(T, np.asarray(estimated, np.float64))
    return float(np.sqrt(np.mean(np.sum((aligned - np.asarray(reference, np.float64)) ** 2, axis=1))))


def relative_pose_error(
    estimated: Float[AnyArray, "n d1 d1"], reference: Float[AnyArray, "n d1 d1"], delta: int = 1
) -> RelativePoseError:
    """How wrong the motion from each pose to the one `delta` later is (Sturm 2012).

    The error of a pair is inv(inv(Q_i) Q_j) inv(P_i) P_j with P estimated, Q the reference and j = i + delta. It does
    not depend on the frame of either trajectory.

    Args:
        estimated: (n, 3, 3) or (n, 4, 4) `T_world_scan`.
        reference: the same poses in another frame, the same unit.
        delta: how many poses apart the two of a pair are.

    Returns:
        Root mean squares over all pairs.

    Raises:
        ValueError: the shapes differ, are not (n, 3, 3) or (n, 4, 4), a number is not finite, or `delta` is not in
            [1, n - 1].
    """
    estimated, reference = checked_poses("estimated", estimated), checked_poses("reference", reference)
    require_same_shape("reference", reference, estimated)
    num_poses = len(estimated)
    if not 1 <= delta < num_poses:
        raise ValueError(f"delta: expected 1 <= delta < {num_poses}, the number of poses, got {delta}")
    moved_estimated = rigid.inverse(estimated[:-delta]) @ estimated[delta:]
    moved_reference = rigid.inverse(reference[:-delta]) @ reference[delta:]
    error = rigid.inverse(moved_reference) @ moved_estimated
    angles = rotation_angle(error[:, :-1, :-1])
    squared_lengths = np.sum(error[:, :-1, -1] ** 2, axis=1)
    return RelativePoseError(
        translation_rmse=float(np.sqrt(np.mean(squared_lengths))),
        rotation_rmse=float(np.sqrt(np.mean(angles**2))),
        num_pairs=len(error),
    )


def point_distance(
    points: Float[AnyArray, "n b d"],
    mask: Bool[AnyArray, "n b"],
    T_estimated: Float[AnyArray, "n d1 d1"],
    T_reference: Float[AnyArray, "n d1 d1"],
) -> float:
    """Mean distance of corresponding map points, after the rigid alignment of positions (DeepMapping section 4).

    Args:
        points: of each scan, in its own frame.
        mask: False for points that are not there; they may hold anything.
        T_estimated: `T_world_scan` of each scan.
        T_reference: the same, in the reference's world.

    Returns:
        The distance, in the unit of the points.

    Raises:
        ValueError: the shapes do not match, a number is not finite, or no point is valid.
    """
    estimated, reference = checked_poses("T_estimated", T_estimated), checked_poses("T_reference", T_reference)
    require_same_shape("T_reference", reference, estimated)
    points, mask = np.asarray(points, np.float64), np.asarray(mask)
    dim = estimated.shape[1] - 1
    if points.ndim != 3 or points.shape[0] != len(estimated) or points.shape[2] != dim:
        raise ValueError(f"points: expected shape ({len(estimated)}, b, {dim}), got {points.shape}")
    if mask.shape != points.shape[:2] or mask.dtype != bool:
        raise ValueError(f"mask: expected bool of shape {points.shape[:2]}, got {mask.dtype} of {mask.shape}")
    if not mask.any():
        raise ValueError("mask: expected at least one valid point, got none")
    if not np.isfinite(points[mask]).all():
        raise ValueError("points: expected finite numbers where mask is True, got NaN or infinity")
    aligned = align_rigid(estimated[:, :dim, dim], reference[:, :dim, dim]) @ estimated
    points = np.where(mask[..., None], points, 0)
    distances = np.linalg.norm(_transform(aligned, points) - _transform(reference, points), axis=-1)
    return float(distances[mask].mean())


def registration_recall(
    T_estimated: Float[AnyArray, "n 4 4"],
    T_true: Float[AnyArray, "n 4 4"],
    *,
    max_translation_m: float = 2.0,
    max_rotation_deg: float = 5.0,
) -> RegistrationRecall:
    """The share of motions that are right, and how wrong each is.

    Args:
        T_estimated: (n, 4, 4) `T_target_source`, metres.
        T_true: the same, true.
        max_translation_m: how far the translations may differ.
        max_rotation_deg: how far the rotations may.

    Returns:
        The recall is 0 without any pair.

    Raises:
        ValueError: the shapes differ or are not (n, 4, 4).
    """
    estimated, true = np.asarray(T_estimated, np.float64), np.asarray(T_true, np.float64)
    for name, value in (("T_estimated", estimated), ("T_true", true)):
        if value.ndim != 3 or value.shape[1:] != (4, 4) or len(value) != len(true):
            raise ValueError(f"{name}: expected shape ({len(true)}, 4, 4), got {value.shape}")
    translation = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    difference = np.swapaxes(true[:, :3, :3], 1, 2) @ estimated[:, :3, :3]
    rotation = np.degrees(rotation_angle(difference))
    with np.errstate(invalid="ignore"):
        is_right = (translation <= max_translation_m) & (rotation <= max_rotation_deg)
    return RegistrationRecall(float(is_right.mean()) if len(true) > 0 else 0.0, translation, rotation, is_right)


def _checked_positions(name: str, value: AnyArray) -> NDArray[np.float64]:
    array = np.asarray(value, np.float64)
    if array.ndim != 2 or array.shape[0] < 1 or array.shape[1] not in (2, 3):
        raise ValueError(f"{name}: expected positions of shape (n, 2) or (n, 3), n >= 1, got {array.shape}")
    return _checked_finite(name, array)


def checked_poses(name: str, value: AnyArray) -> NDArray[np.float64]:
    """Returns poses as float64; a ValueError names what is no (n, 3, 3) or (n, 4, 4) or not finite."""
    array = np.asarray(value, np.float64)
    if array.ndim != 3 or array.shape[0] < 1 or array.shape[1:] not in ((3, 3), (4, 4)):
        raise ValueError(f"{name}: expected poses of shape (n, 3, 3) or (n, 4, 4), n >= 1, got {array.shape}")
    return _checked_finite(name, array)


def _checked_finite(name: str, array: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity in row {_first_bad_row(array)}")
    return array


def _first_bad_row(array: NDArray[np.float64]) -> int:
    return int(np.argmin(np.isfinite(array).reshape(len(array), -1).all(axis=1)))


def require_same_shape(name: str, array: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    """Raises a ValueError where two arrays have different shapes."""
    if array.shape != other.shape:
        raise ValueError(f"{name}: expected shape {other.shape} like the estimated, got {array.shape}")


def _transform(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    dim = points.shape[-1]
    return points @ np.swapaxes(T[..., :dim, :dim], -1, -2) + T[..., None, :dim, dim]


def rotation_angle(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the angle of rotation matrices in [0, pi], exact for small angles (an arc cosine is not)."""
    skew = (R - np.swapaxes(R, 1, 2)) / 2
    sin = np.sqrt(np.sum(skew**2, axis=(1, 2)) / 2)
    trace = np.trace(R, axis1=1, axis2=2)
    cos = trace / 2 if R.shape[1] == 2 else (trace - 1) / 2
    return np.arctan2(sin, cos)
