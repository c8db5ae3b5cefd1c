"""Rigid motions in space as homogeneous matrices (4x4); the logarithm is jaxlie's.

Tangents are (translation, rotation), in that order. Lengths keep their unit, angles are radians; any leading axes.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from dpmjax.checks import as_float
from dpmjax.geometry import rigid
from dpmjax.types import AnyArray

# Degrees of freedom of a camera: x, z and the angle about y (DeepMapping section 4.2); or a twist in SE(3).
Motion = Literal["planar", "full"]


@jax.jit
def log(T: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6"]:
    """Finds the twist of a motion, the inverse of `rigid.exp`; not smooth at half a turn.

    Args:
        T: (..., 4, 4) homogeneous matrices.

    Returns:
        (..., 6) vx, vy, vz, wx, wy, wz, of angle at most pi.
    """
    T = as_float("T", T)
    # jaxlie computes in 64 bits wherever JAX has them.
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.from_matrix(T).log().astype(T.dtype)


@jax.jit
def log_jacobian(T: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6 6"]:
    """The derivative of log(T @ rigid.exp(step)) by the step, at zero: the inverse right Jacobian.

    It is I + ad / 2 + a ad^2 + b ad^4, where ad is the adjoint of the twist. This is a closed form of the series of
    Bernoulli numbers (Barfoot 2017, section 7.1.5).

    Args:
        T: (..., 4, 4), of angle below pi.

    Returns:
        (..., 6, 6) for tangents (translation, rotation).
    """
    T = as_float("T", T)
    twist = log(T)
    squared = jnp.sum(twist[..., 3:] ** 2, axis=-1)[..., None, None]
    is_small = squared < 5 * rigid.SERIES_BELOW  # where differences of the closed form would lose digits
    safe = jnp.where(is_small, 1, squared)
    half = jnp.sqrt(safe) / 2
    cotangent, cosecant = half / jnp.tan(half), safe / (8 * jnp.sin(half) ** 2)
    second = (2 - 1.5 * cotangent - cosecant) / safe
    fourth = (1 - 0.5 * cotangent - cosecant) / safe**2
    second = jnp.where(is_small, 1 / 12 - squared**2 / 30240 - squared**3 / 604800, second)
    fourth = jnp.where(is_small, -1 / 720 - squared / 15120 - squared**2 / 403200, fourth)
    v, w = _cross_matrix(twist[..., :3]), _cross_matrix(twist[..., 3:])
    ad = jnp.concatenate([jnp.concatenate([w, v], axis=-1), jnp.concatenate([jnp.zeros_like(w), w], axis=-1)], axis=-2)
    squared_ad = rigid.matmul(ad, ad)
    return jnp.eye(6, dtype=T.dtype) + ad / 2 + second * squared_ad + fourth * rigid.matmul(squared_ad, squared_ad)


def _cross_matrix(vector: Any) -> Any:
    xp, (x, y, z) = rigid.namespace_of(vector), (vector[..., 0], vector[..., 1], vector[..., 2])
    zero = xp.zeros_like(x)
    return xp.stack([xp.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=-2)


def adjoint(T_a_b: Any) -> Any:
    """Makes the adjoint of a motion, which moves tangents from b to a.

    Args:
        T_a_b: (..., 4, 4), of NumPy or of JAX.

    Returns:
        (..., 6, 6) for tangents (translation, rotation), of the same kind.
    """
    xp, R = rigid.namespace_of(T_a_b), T_a_b[..., :3, :3]
    top = xp.concatenate([R, rigid.matmul(_cross_matrix(T_a_b[..., :3, 3]), R)], axis=-1)
    return xp.concatenate([top, xp.concatenate([xp.zeros_like(R), R], axis=-1)], axis=-2)


def motion_matrices(values: Float[AnyArray, "n k"]) -> Float[AnyArray, "n 4 4"]:
    """Makes motions in space from the numbers that a fit adjusts.

    Args:
        values: (n, 3) x, z and the angle about y of a level camera, or (n, 6) twists.

    Returns:
        (n, 4, 4) rigid motions.
    """
    if values.shape[-1] == 6:
        return rigid.exp(values)
    xp = rigid.namespace_of(values)
    x, z, cos, sin = values[:, 0], values[:, 1], xp.cos(values[:, 2]), xp.sin(values[:, 2])
    zero, one = xp.zeros_like(x), xp.ones_like(x)
    rows = ((cos, zero, sin, x), (zero, one, zero, zero), (-sin, zero, cos, z), (zero, zero, zero, one))
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def turn_rad(T_a_b: Float[np.ndarray, "4 4"]) -> float:
    """Returns the angle of a rotation.

    Args:
        T_a_b: a motion.

    Returns:
        Radians, from 0 to pi.
    """
    R = T_a_b[:3, :3]
    sine = math.hypot(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return math.atan2(sine, R[0, 0] + R[1, 1] + R[2, 2] - 1)


def are_near(T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"], most_m: float, most_rad: float) -> bool:
    """Returns True if two poses differ by at most a distance and a rotation angle.

    Args:
        T_a: a pose.
        T_b: the second pose, in the same frame.
        most_m: distance.
        most_rad: turn.

    Returns:
        True at the limits, too.
    """
    apart = rigid.inverse(T_a) @ T_b
    return bool(np.linalg.norm(apart[:3, 3]) <= most_m) and turn_rad(apart) <= most_rad


def orthonormal(T_a_b: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
    """Removes the rounding errors of rotations, which would grow from scan to scan.

    Args:
        T_a_b: nearly rigid motions.

    Returns:
        The rigid motions.
    """
    T = np.array(T_a_b, np.float64)
    T[..., :3, :3] = Rotation.from_matrix(T[..., :3, :3]).as_matrix()
    return T
