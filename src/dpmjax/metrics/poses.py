"""Errors of poses: rigid alignment, ATE, RPE, point distance, recall of registrations.

Lengths keep their unit; angles are radians. Poses are `T_world_scan`, (n, d+1, d+1) with d = 2 or 3.
NumPy arrays give float64 results. If one array is a JAX array, the result is a JAX array of its dtype, and the function
is traceable: `jit`, `vmap`, `grad` with a finite gradient everywhere. The recall and `align_poses` work in NumPy only.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from dpmjax.checks import as_float, as_mask, require_shape, runs_on_host
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import best_motion
from dpmjax.geometry.rigid import matmul, namespace_of, safe_sqrt
from dpmjax.geometry.traced import is_usable
from dpmjax.types import AnyArray, with_short_repr


@with_short_repr
class RelativePoseError(NamedTuple):
    """Errors of the motion between pairs of poses.

    Attributes:
        translation_rmse: root mean square error of the translation, in the unit of the poses.
        rotation_rmse: root mean square error of the rotation, radians.
        num_pairs: number of compared pairs.
    """

    translation_rmse: float | jax.Array
    rotation_rmse: float | jax.Array
    num_pairs: int


@with_short_repr
class RegistrationRecall(NamedTuple):
    """Errors of registrations of pairs of scans.

    Attributes:
        recall: share of pairs with both errors within the limits.
        translation_errors_m: (n,) error of the translation of each pair.
        rotation_errors_deg: (n,) error of the rotation of each pair, in [0, 180].
        is_right: (n,) True for right pairs; False for a pose that is not finite.
    """

    recall: float
    translation_errors_m: Float[np.ndarray, " n"]
    rotation_errors_deg: Float[np.ndarray, " n"]
    is_right: Bool[np.ndarray, " n"]


def align_rigid(
    estimated: Float[AnyArray, "n d"], reference: Float[AnyArray, "n d"], mask: Bool[AnyArray, " n"] | None = None
) -> Float[AnyArray, "d1 d1"]:
    """Computes the rigid motion, without scale, that brings estimated positions closest to the reference ones.

    Least squares in closed form, as `weighted_svd`. Where the positions leave the rotation open (n = 1; in 3-D all on
    one line), it is one near the identity, with derivative 0.

    Args:
        estimated: (n, 2) or (n, 3) positions.
        reference: the same positions in another frame, the same unit.
        mask: False for positions that are not there; they may hold anything. A traced mask without any position gives
            the identity.

    Returns:
        `T_reference_estimated`, (d+1, d+1): float64, or a JAX array if an input is one.

    Raises:
        ValueError: the shapes differ, are not (n, 2) or (n, 3) with n >= 1, a number is not finite, or no position is
            there.
    """
    return best_motion(*_checked_positions(estimated, reference, mask))


def align_poses(
    T_estimated: Float[AnyArray, "n 4 4"], T_reference: Float[AnyArray, "n 4 4"], *, lever: float
) -> Float[np.ndarray, "4 4"]:
    """Computes the rigid motion, without scale, that brings estimated poses closest to the reference ones.

    The positions and the ends of levers along the axes of each pose are aligned. So positions on one line leave no
    rotation open.

    Args:
        T_estimated: `T_world_scan` of each scan.
        T_reference: the same, in the reference's world.
        lever: length of the levers, in the unit of the poses: the longer, the more the rotations count.

    Returns:
        `T_reference_estimated`.

    Raises:
        ValueError: the shapes differ, or a number is not finite.
    """
    poses = checked_poses(T_estimated=T_estimated, T_reference=T_reference)
    arms = lever * np.concatenate([-np.eye(3), np.eye(3)])
    ends = (_transform(T, np.broadcast_to(arms, (len(T), 6, 3))).reshape(-1, 3) for T in poses)
    return np.asarray(align_rigid(*ends))


def absolute_trajectory_error(
    estimated: Float[AnyArray, "n d"], reference: Float[AnyArray, "n d"], mask: Bool[AnyArray, " n"] | None = None
) -> float | Float[jax.Array, ""]:
    """Computes the root mean square distance of positions after rigid alignment (DeepMapping section 4; Sturm 2012).

    Args:
        estimated: positions, (n, 2) or (n, 3).
        reference: the same positions in another frame, the same unit.
        mask: False for positions that are not there; they may hold anything. A traced mask without any position gives
            0.

    Returns:
        The error, in the unit of the positions: a float, or a JAX number if an input is a JAX array. Its gradient at 0
        is 0.

    Raises:
        ValueError: the shapes differ, are not (n, 2) or (n, 3) with n >= 1, a number is not finite, or no position is
            there.
    """
    estimated, reference, weights = _checked_positions(estimated, reference, mask)
    # Near the origin: float32 at map coordinates of 5e6 m would lose half a metre at every operation.
    first = namespace_of(weights).argmax(weights)
    estimated, reference = estimated - estimated[first], reference - reference[first]
    difference = _transform(best_motion(estimated, reference, weights), estimated) - reference
    return _number(safe_sqrt(_mean((difference**2).sum(axis=1), weights > 0)))


def relative_pose_error(
    estimated: Float[AnyArray, "n d1 d1"], reference: Float[AnyArray, "n d1 d1"], delta: int = 1
) -> RelativePoseError:
    """Computes the errors of the motion from each pose to the one `delta` later (Sturm 2012).

    The error of a pair is inv(inv(Q_i) Q_j) inv(P_i) P_j with P estimated, Q the reference and j = i + delta. It does
    not depend on the frame of either trajectory.

    Args:
        estimated: (n, 3, 3) or (n, 4, 4) `T_world_scan`.
        reference: the same poses in another frame, the same unit.
        delta: number of poses from the first to the second of a pair.

    Returns:
        Root mean squares over all pairs.

    Raises:
        ValueError: the shapes differ, are not (n, 3, 3) or (n, 4, 4), a number is not finite, or `delta` is not in
            [1, n - 1].
    """
    xp = namespace_of(estimated, reference)
    estimated, reference = checked_poses(xp, estimated=estimated, reference=reference)
    if not 1 <= delta < len(estimated):
        raise ValueError(f"delta: expected 1 <= delta < {len(estimated)}, the number of poses, got {delta}")
    moved, true = (_motion_between(T[:-delta], T[delta:]) for T in (estimated, reference))
    error = matmul(rigid.inverse(true), moved)
    squared_lengths = (error[:, :-1, -1] ** 2).sum(axis=1)
    squared_angles = rotation_angle(error[:, :-1, :-1]) ** 2
    translation, rotation = (_number(safe_sqrt(squares.mean())) for squares in (squared_lengths, squared_angles))
    return RelativePoseError(translation, rotation, len(error))


def point_distance(
    points: Float[AnyArray, "n b d"],
    mask: Bool[AnyArray, "n b"],
    T_estimated: Float[AnyArray, "n d1 d1"],
    T_reference: Float[AnyArray, "n d1 d1"],
) -> float | Float[jax.Array, ""]:
    """Computes the mean distance of corresponding map points after alignment of positions (DeepMapping section 4).

    Args:
        points: points of each scan, in its own frame.
        mask: False for points that are not there; they may hold anything. A traced mask without any point gives 0.
        T_estimated: `T_world_scan` of each scan.
        T_reference: the same, in the reference's world.

    Returns:
        The distance, in the unit of the points.

    Raises:
        ValueError: the shapes do not match, a number is not finite, or no point is valid.
    """
    xp = namespace_of(points, mask, T_estimated, T_reference)
    estimated, reference = checked_poses(xp, T_estimated=T_estimated, T_reference=T_reference)
    points = as_floats("points", points, xp)
    dim = estimated.shape[1] - 1
    require_shape("points", points, (len(estimated), *points.shape[1:2], dim))
    mask = valid_mask(mask, points.shape[:2], xp)
    points = xp.where(mask[..., None], points, 0)
    require_finite("points", points)
    if xp is not np:
        mask = mask & is_usable(points)
        points = xp.where(mask[..., None], points, 0)
    estimated, reference = (_moved(T, -T[:1, :dim, dim]) for T in (estimated, reference))
    aligned = matmul(align_rigid(estimated[:, :dim, dim], reference[:, :dim, dim]), estimated)
    difference = _transform(aligned, points) - _transform(reference, points)
    return _number(_mean(safe_sqrt((difference**2).sum(axis=-1)), mask))


@runs_on_host("call relative_pose_error there")
def registration_recall(
    T_estimated: Float[AnyArray, "n 4 4"],
    T_true: Float[AnyArray, "n 4 4"],
    *,
    max_translation_m: float = 2.0,
    max_rotation_deg: float = 5.0,
) -> RegistrationRecall:
    """Computes the share of right motions, and the errors of each motion.

    Args:
        T_estimated: (n, 4, 4) `T_target_source`, metres.
        T_true: the same, true.
        max_translation_m: largest translation error of a right motion.
        max_rotation_deg: largest rotation error of a right motion.

    Returns:
        Recall and errors; the recall is 0 without any pair.

    Raises:
        ValueError: the shapes differ or are not (n, 4, 4).
    """
    estimated, true = np.asarray(T_estimated, np.float64), np.asarray(T_true, np.float64)
    for name, value in (("T_estimated", estimated), ("T_true", true)):
        require_shape(name, value, (len(true), 4, 4))
    translation = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    difference = np.swapaxes(true[:, :3, :3], 1, 2) @ estimated[:, :3, :3]
    rotation = np.degrees(rotation_angle(difference))
    with np.errstate(invalid="ignore"):
        is_right = (translation <= max_translation_m) & (rotation <= max_rotation_deg)
    return RegistrationRecall(float(is_right.mean()) if len(true) > 0 else 0.0, translation, rotation, is_right)


def _number(value: Any) -> Any:
    """Converts a NumPy number to a float; a JAX number stays traceable."""
    return value if isinstance(value, jax.Array) else float(value)


def _mean(values: Any, mask: Any) -> Any:
    """Computes the mean of the valid values; 0 without any."""
    xp = namespace_of(values)
    return xp.where(mask, values, 0).sum() / xp.maximum(mask.sum(), 1)


def _transform(T: Any, points: Any) -> Any:
    dim = points.shape[-1]
    return matmul(points, T[..., :dim, :dim].swapaxes(-1, -2)) + T[..., None, :dim, dim]


def _moved(T: Any, shift: Any) -> Any:
    """Returns motions with another translation."""
    xp, dim = namespace_of(T), T.shape[-1] - 1
    top = xp.concatenate([T[..., :dim, :dim], (T[..., :dim, dim] + shift)[..., None]], axis=-1)
    return xp.concatenate([top, T[..., dim:, :]], axis=-2)


def _motion_between(T_world_first: Any, T_world_second: Any) -> Any:
    """Returns `T_first_second`; the difference of the translations comes first, so that no digit is lost far out."""
    here = T_world_first[..., :-1, -1]
    return matmul(rigid.inverse(_moved(T_world_first, -here)), _moved(T_world_second, -here))


def rotation_angle(R: Any) -> Any:
    """Returns the angle of rotation matrices in [0, pi], exact for small angles (an arc cosine is not)."""
    xp = namespace_of(R)
    skew = (R - xp.swapaxes(R, 1, 2)) / 2
    sin = safe_sqrt((skew**2).sum(axis=(1, 2)) / 2)
    trace = xp.trace(R, axis1=1, axis2=2)
    cos = trace / 2 if R.shape[1] == 2 else (trace - 1) / 2
    return xp.arctan2(sin, cos)


def checked_poses(xp: ModuleType = np, **poses: AnyArray) -> list[Any]:
    """Returns poses (n, 3, 3) or (n, 4, 4) as floats, all of one shape; a ValueError names a bad argument."""
    arrays: list[Any] = []
    for name, value in poses.items():
        array = as_floats(name, value, xp)
        if array.ndim != 3 or array.shape[0] < 1 or array.shape[1:] not in ((3, 3), (4, 4)):
            raise ValueError(f"{name}: expected poses of shape (n, 3, 3) or (n, 4, 4), n >= 1, got {array.shape}")
        require_shape(name, array, arrays[0].shape if arrays else array.shape)
        require_finite(name, array)
        arrays.append(array)
    return arrays


def as_floats(name: str, value: AnyArray, xp: ModuleType) -> Any:
    """Returns an array of NumPy as float64, an array of JAX in its dtype."""
    return np.asarray(value, np.float64) if xp is np else as_float(name, value)


def require_finite(name: str, array: Any) -> None:
    """Raises a ValueError that names the first row with a number that is not finite."""
    if not isinstance(array, jax.core.Tracer) and not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).reshape(len(array), -1).all(axis=1)))
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity in row {row}")


def valid_mask(mask: AnyArray | None, shape: tuple[int, ...], xp: ModuleType) -> Any:
    """Returns the mask; a ValueError where nothing is valid."""
    is_valid = as_mask("mask", mask, shape, xp)
    if not isinstance(is_valid, jax.core.Tracer) and not np.asarray(is_valid).any():
        raise ValueError("mask: expected at least one valid point, got none")
    return is_valid


def _checked_positions(estimated: AnyArray, reference: AnyArray, mask: AnyArray | None) -> tuple[Any, Any, Any]:
    """Returns positions, and a weight for each pair: 1, or 0 where it is masked."""
    xp = namespace_of(estimated, reference, mask)
    pair = {"estimated": as_floats("estimated", estimated, xp), "reference": as_floats("reference", reference, xp)}
    shape = pair["estimated"].shape
    if len(shape) != 2 or shape[0] < 1 or shape[1] not in (2, 3):
        raise ValueError(f"estimated: expected positions of shape (n, 2) or (n, 3), n >= 1, got {shape}")
    require_shape("reference", pair["reference"], shape)
    is_valid = valid_mask(mask, shape[:1], xp)
    for name, values in pair.items():
        pair[name] = xp.where(is_valid[:, None], values, 0)
        require_finite(name, pair[name])
    return pair["estimated"], pair["reference"], is_valid.astype(pair["estimated"].dtype)
