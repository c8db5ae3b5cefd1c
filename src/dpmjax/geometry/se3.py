"""Rigid motions in space as homogeneous matrices (4x4); exponential and logarithm are jaxlie's.

Tangents are (translation, rotation), in that order. Lengths keep their unit, angles are radians; any leading axes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from dpmjax.types import AnyArray


@jax.jit
def exp(tangent: Float[AnyArray, "... 6"]) -> Float[Array, "... 4 4"]:
    """The motion of a twist (vx, vy, vz, wx, wy, wz); the gradient is right at zero too."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.exp(jnp.asarray(tangent)).as_matrix()


@jax.jit
def log(T: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6"]:
    """The twist (vx, vy, vz, wx, wy, wz) of a motion, of angle at most pi; not smooth at half a turn."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.from_matrix(jnp.asarray(T)).log()


def log_jacobian(T: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6 6"]:
    """The derivative of log(T @ exp(step)) by the step, at zero: the inverse right Jacobian.

    Args:
        T: (..., 4, 4), of angle below pi.

    Returns:
        (..., 6, 6) for tangents (translation, rotation).
    """
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.from_matrix(jnp.asarray(T)).jlog()


def adjoint(T_a_b: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6 6"]:
    """The adjoint of a motion, which moves tangents from b to a.

    Args:
        T_a_b: (..., 4, 4).

    Returns:
        (..., 6, 6) for tangents (translation, rotation).
    """
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.from_matrix(jnp.asarray(T_a_b)).adjoint()


@jax.jit
def rotation_from_quaternion_xyzw(quaternion: Float[AnyArray, "... 4"]) -> Float[Array, "... 3 3"]:
    """The rotation matrix of a quaternion in file order x, y, z, w, of any length; of zero, the identity."""
    xyzw = jnp.asarray(quaternion)
    is_zero = jnp.sum(xyzw**2, axis=-1, keepdims=True) == 0
    xyzw = jnp.where(is_zero, jnp.array([0, 0, 0, 1], xyzw.dtype), xyzw)
    unit = xyzw / jnp.sqrt(jnp.sum(xyzw**2, axis=-1, keepdims=True))
    return jaxlie.SO3.from_quaternion_xyzw(unit).as_matrix()


@jax.jit
def quaternion_xyzw_from_rotation(R: Float[AnyArray, "... 3 3"]) -> Float[Array, "... 4"]:
    """The unit quaternion of a rotation matrix in file order x, y, z, w, with w >= 0."""
    xyzw = jaxlie.SO3.from_matrix(jnp.asarray(R)).as_quaternion_xyzw()
    return jnp.where(xyzw[..., 3:] < 0, -xyzw, xyzw)
