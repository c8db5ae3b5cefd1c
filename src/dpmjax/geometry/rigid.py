"""Rigid motions as homogeneous matrices, planar (3x3) or spatial (4x4): `T_a_b` maps b-coordinates to a-coordinates."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from dpmjax.checks import as_float, require_value
from dpmjax.types import AnyArray

# Squared angle, in square radians, below which series replace differences that cancel.
SERIES_BELOW = 0.1


def namespace_of(*arrays: Any) -> ModuleType:
    """Returns `jax.numpy` if one array or more is JAX's, else `numpy`."""
    for array in arrays:
        # A question to `jax.Array` takes longer than most operations on a pose.
        if type(array) is not np.ndarray and isinstance(array, jax.Array):
            return jnp
    return np


def matmul(a: Any, b: Any) -> Any:
    """Multiplies matrices at full precision on every device.

    Args:
        a: (..., n, k), of NumPy or of JAX.
        b: (..., k, m).

    Returns:
        (..., n, m), of JAX if one of the two is.
    """
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST) if namespace_of(a, b) is jnp else np.matmul(a, b)


def safe_sqrt(squared: Any) -> Any:
    """Computes square roots whose derivative at 0 is 0.

    Args:
        squared: any shape, of NumPy or of JAX; numbers below 0 count as 0.

    Returns:
        The roots, same shape.
    """
    xp = namespace_of(squared)
    # The slope of the square root is infinite at zero: guard its input, then its output.
    is_zero = squared <= 0
    return xp.where(is_zero, 0, xp.sqrt(xp.where(is_zero, 1, squared)))


def inverse(T_a_b: Any) -> Any:
    """Inverts a rigid motion, exactly in its rotation.

    Args:
        T_a_b: (..., d+1, d+1), of NumPy or of JAX.

    Returns:
        `T_b_a`, of the same kind and shape.
    """
    xp = namespace_of(T_a_b)
    dim = T_a_b.shape[-1] - 1
    R_b_a = xp.swapaxes(T_a_b[..., :dim, :dim], -1, -2)
    translation = -xp.sum(R_b_a * T_a_b[..., None, :dim, dim], axis=-1)
    top = xp.concatenate([R_b_a, translation[..., None]], axis=-1)
    return xp.concatenate([top, T_a_b[..., dim:, :]], axis=-2)


@jax.jit
def exp(tangent: Float[AnyArray, "... k"]) -> Float[Array, "... d1 d1"]:
    """Makes the motion of a twist; the gradient is right at zero too.

    Differences that cancel are computed by series: jaxlie's motion of a small turn is off by half of turn times length.

    Args:
        tangent: (..., 3) vx, vy, angle in the plane, or (..., 6) vx, vy, vz, wx, wy, wz in space.

    Returns:
        (..., 3, 3) or (..., 4, 4) homogeneous matrices, dtype of the twist.

    Raises:
        ValueError: the twist has neither 3 nor 6 numbers.
    """
    tangent = as_float("tangent", tangent)
    require_value(tangent.shape[-1] in (3, 6), "tangent", "shape (..., 3) or (..., 6)", tangent.shape)
    if tangent.shape[-1] == 3:  # the same motion in space, without z
        zero = jnp.zeros_like(tangent)
        T = exp(jnp.concatenate([tangent[..., :2], zero, tangent[..., 2:]], axis=-1))
        kept = np.array([0, 1, 3])
        return T[..., kept[:, None], kept]
    v, w = tangent[..., :3], tangent[..., 3:]
    squared = jnp.sum(w**2, axis=-1, keepdims=True)
    # (1 - cos) / angle^2 and (angle - sin) / angle^3.
    is_small = squared < SERIES_BELOW
    safe = jnp.where(is_small, 1, squared)
    angle = jnp.sqrt(safe)
    first = jnp.where(
        is_small, 1 / 2 - squared / 24 + squared**2 / 720 - squared**3 / 40320, 2 * jnp.sin(angle / 2) ** 2 / safe
    )
    second = jnp.where(
        is_small,
        1 / 6 - squared / 120 + squared**2 / 5040 - squared**3 / 362880,
        (angle - jnp.sin(angle)) / (safe * angle),
    )
    turned = jnp.cross(w, v)
    translation = v + first * turned + second * jnp.cross(w, turned)
    R = jaxlie.SO3.exp(w).as_matrix().astype(tangent.dtype)  # jaxlie computes in 64 bits wherever JAX has them
    top = jnp.concatenate([R, translation[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.array([0, 0, 0, 1], tangent.dtype), (*tangent.shape[:-1], 1, 4))
    return jnp.concatenate([top, last], axis=-2)


@jax.jit
def transform_points(
    T_a_b: Float[AnyArray, "... d1 d1"], points_b: Float[AnyArray, "... n d"]
) -> Float[Array, "... n d"]:
    """Moves points from b to a.

    Args:
        T_a_b: homogeneous matrices; their leading axes broadcast with those of the points.
        points_b: points in b, d = 2 or 3.

    Returns:
        (..., n, d) points in a.

    Raises:
        ValueError: the matrix is not (d+1, d+1).
    """
    T_a_b, points_b = jnp.asarray(T_a_b), jnp.asarray(points_b)
    dim = points_b.shape[-1]
    is_right, shapes = (
        points_b.ndim >= 2 and T_a_b.shape[-2:] == (dim + 1, dim + 1),
        f"{T_a_b.shape} for {points_b.shape}",
    )
    require_value(is_right, "T_a_b", "shape (..., d+1, d+1) for points_b (..., n, d)", shapes)
    # Products and sums rather than a contraction: full precision on every device, and one fused loop for small d.
    points_a = T_a_b[..., None, :dim, dim]
    for axis in range(dim):
        points_a = points_a + T_a_b[..., None, :dim, axis] * points_b[..., axis, None]
    return points_a
