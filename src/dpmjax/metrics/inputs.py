"""Checks of positions and poses before errors are computed, of arrays of NumPy or of JAX; traced numbers pass."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import numpy as np

from dpmjax.checks import as_float
from dpmjax.geometry.rigid import namespace_of
from dpmjax.types import AnyArray


def checked_positions(estimated: AnyArray, reference: AnyArray, mask: AnyArray | None) -> tuple[Any, Any, Any]:
    """Returns positions, and a weight for each pair: 1, or 0 where it is masked."""
    xp = namespace_of(estimated, reference, mask)
    estimated, reference = as_floats("estimated", estimated, xp), as_floats("reference", reference, xp)
    if estimated.ndim != 2 or estimated.shape[0] < 1 or estimated.shape[1] not in (2, 3):
        raise ValueError(f"estimated: expected positions of shape (n, 2) or (n, 3), n >= 1, got {estimated.shape}")
    _require_same_shape("reference", reference, estimated)
    is_valid = xp.ones(len(estimated), bool) if mask is None else xp.asarray(mask)
    if is_valid.shape != estimated.shape[:1] or is_valid.dtype != bool:
        raise ValueError(f"mask: expected bool of shape {estimated.shape[:1]}, got {is_valid.dtype} {is_valid.shape}")
    if not is_traced(is_valid) and not np.asarray(is_valid).any():
        raise ValueError("mask: expected at least one valid position, got none")
    estimated, reference = (xp.where(is_valid[:, None], value, 0) for value in (estimated, reference))
    require_finite("estimated", estimated)
    require_finite("reference", reference)
    return estimated, reference, is_valid.astype(estimated.dtype)


def checked_poses(name: str, value: AnyArray, xp: ModuleType = np) -> Any:
    """Returns poses as floats; a ValueError names an argument that is not (n, 3, 3) or (n, 4, 4), or not finite."""
    array = as_floats(name, value, xp)
    if array.ndim != 3 or array.shape[0] < 1 or array.shape[1:] not in ((3, 3), (4, 4)):
        raise ValueError(f"{name}: expected poses of shape (n, 3, 3) or (n, 4, 4), n >= 1, got {array.shape}")
    require_finite(name, array)
    return array


def checked_pose_pair(xp: ModuleType = np, **poses: AnyArray) -> tuple[Any, Any]:
    """Returns estimated and reference poses as `checked_poses` does, and checks that they have one shape."""
    (first, estimated), (second, reference) = poses.items()
    estimated, reference = checked_poses(first, estimated, xp), checked_poses(second, reference, xp)
    _require_same_shape(second, reference, estimated)
    return estimated, reference


def as_floats(name: str, value: AnyArray, xp: ModuleType) -> Any:
    """Returns an array of NumPy as float64, an array of JAX in its dtype."""
    return np.asarray(value, np.float64) if xp is np else as_float(name, value)


def require_finite(name: str, array: Any) -> None:
    """Raises a ValueError that names the first row with a number that is not finite."""
    if not is_traced(array) and not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).reshape(len(array), -1).all(axis=1)))
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity in row {row}")


def is_traced(array: Any) -> bool:
    """Returns True for an array whose numbers are traced."""
    return isinstance(array, jax.core.Tracer)


def _require_same_shape(name: str, array: AnyArray, other: AnyArray) -> None:
    """Raises a ValueError where two arrays have different shapes."""
    if array.shape != other.shape:
        raise ValueError(f"{name}: expected shape {other.shape} like the estimated, got {array.shape}")
