"""Poses: SE(2) as (x, y, heading) or 3x3 matrices, SE(3) as 4x4 matrices.

`T_a_b` maps b-coordinates to a-coordinates. Lengths keep their unit, angles are radians. Every function takes any
batch of leading axes, keeps the dtype, is smooth except where it says otherwise, and compiles once per shape.
Exponential and logarithm are jaxlie's; tangents are (translation, rotation), in that order.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from dpmjax.types import AnyArray


@jax.jit
def wrap_angle(angle: Float[AnyArray, "..."]) -> Float[Array, "..."]:
    """The same angle in [-pi, pi]; small angles come back unchanged, and the derivative is 1 everywhere."""
    angle = jnp.asarray(angle)
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


@jax.jit
def matrix_from_pose2(pose: Float[AnyArray, "... 3"]) -> Float[Array, "... 3 3"]:
    """The homogeneous matrix `T_a_b` of a planar pose (x, y, heading) of b in a."""
    pose = jnp.asarray(pose)
    x, y, heading = pose[..., 0], pose[..., 1], pose[..., 2]
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = [jnp.stack(row, axis=-1) for row in ((cos, -sin, x), (sin, cos, y), (zero, zero, one))]
    return jnp.stack(rows, axis=-2)


@jax.jit
def pose2_from_matrix(T: Float[AnyArray, "... 3 3"]) -> Float[Array, "... 3"]:
    """The planar pose (x, y, heading in [-pi, pi]) of a homogeneous matrix."""
    T = jnp.asarray(T)
    heading = jnp.arctan2(T[..., 1, 0], T[..., 0, 0])
    return jnp.stack([T[..., 0, 2], T[..., 1, 2], heading], axis=-1)


@jax.jit
def compose_pose2(pose_a_b: Float[AnyArray, "... 3"], pose_b_c: Float[AnyArray, "... 3"]) -> Float[Array, "... 3"]:
    """The pose of c in a, from the pose of b in a and that of c in b: `T_a_c = T_a_b @ T_b_c`."""
    pose_a_b, pose_b_c = jnp.asarray(pose_a_b), jnp.asarray(pose_b_c)
    cos, sin = jnp.cos(pose_a_b[..., 2]), jnp.sin(pose_a_b[..., 2])
    x = pose_a_b[..., 0] + cos * pose_b_c[..., 0] - sin * pose_b_c[..., 1]
    y = pose_a_b[..., 1] + sin * pose_b_c[..., 0] + cos * pose_b_c[..., 1]
    return jnp.stack([x, y, wrap_angle(pose_a_b[..., 2] + pose_b_c[..., 2])], axis=-1)


@jax.jit
def inverse_pose2(pose_a_b: Float[AnyArray, "... 3"]) -> Float[Array, "... 3"]:
    """The pose of a in b, from the pose of b in a."""
    pose_a_b = jnp.asarray(pose_a_b)
    x, y, heading = pose_a_b[..., 0], pose_a_b[..., 1], pose_a_b[..., 2]
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    return jnp.stack([-cos * x - sin * y, sin * x - cos * y, wrap_angle(-heading)], axis=-1)


@jax.jit
def relative_pose2(pose_w_a: Float[AnyArray, "... 3"], pose_w_b: Float[AnyArray, "... 3"]) -> Float[Array, "... 3"]:
    """The pose of b in a, from the poses of both in w: `T_a_b = inv(T_w_a) @ T_w_b`."""
    pose_w_a, pose_w_b = jnp.asarray(pose_w_a), jnp.asarray(pose_w_b)
    cos, sin = jnp.cos(pose_w_a[..., 2]), jnp.sin(pose_w_a[..., 2])
    # The difference first: poses far from the origin lose no digits to each other.
    dx, dy = pose_w_b[..., 0] - pose_w_a[..., 0], pose_w_b[..., 1] - pose_w_a[..., 1]
    heading = wrap_angle(pose_w_b[..., 2] - pose_w_a[..., 2])
    return jnp.stack([cos * dx + sin * dy, -sin * dx + cos * dy, heading], axis=-1)


@jax.jit
def transform_points(
    T_a_b: Float[AnyArray, "... d1 d1"], points_b: Float[AnyArray, "... n d"]
) -> Float[Array, "... n d"]:
    """Points in a, from points in b; d = 2 or 3, and the leading axes of both broadcast.

    Raises:
        ValueError: the matrix is not (d+1, d+1).
    """
    T_a_b, points_b = jnp.asarray(T_a_b), jnp.asarray(points_b)
    dim = points_b.shape[-1]
    if points_b.ndim < 2 or T_a_b.shape[-2:] != (dim + 1, dim + 1):
        raise ValueError(
            f"T_a_b: expected shape (..., d+1, d+1) for points_b (..., n, d), got {T_a_b.shape} for {points_b.shape}"
        )
    # Products and sums rather than a contraction: full precision on every device, and one fused loop for small d.
    points_a = T_a_b[..., None, :dim, dim]
    for axis in range(dim):
        points_a = points_a + T_a_b[..., None, :dim, axis] * points_b[..., axis, None]
    return points_a


@jax.jit
def invert(T_a_b: Float[AnyArray, "... d1 d1"]) -> Float[Array, "... d1 d1"]:
    """`T_b_a` of a rigid motion `T_a_b`, 3x3 or 4x4; exact in the rotation, for it is the transpose."""
    T_a_b = jnp.asarray(T_a_b)
    dim = T_a_b.shape[-1] - 1
    R_b_a = jnp.swapaxes(T_a_b[..., :dim, :dim], -1, -2)
    translation = -jnp.sum(R_b_a * T_a_b[..., None, :dim, dim], axis=-1)
    top = jnp.concatenate([R_b_a, translation[..., None]], axis=-1)
    return jnp.concatenate([top, T_a_b[..., dim:, :]], axis=-2)


@jax.jit
def exp_se2(tangent: Float[AnyArray, "... 3"]) -> Float[Array, "... 3 3"]:
    """The motion of a planar twist (vx, vy, angle); the gradient is right at zero too."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE2.exp(jnp.asarray(tangent)).as_matrix()


@jax.jit
def log_se2(T: Float[AnyArray, "... 3 3"]) -> Float[Array, "... 3"]:
    """The planar twist (vx, vy, angle in [-pi, pi]) of a motion; not smooth at half a turn."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE2.from_matrix(jnp.asarray(T)).log()


@jax.jit
def exp_se3(tangent: Float[AnyArray, "... 6"]) -> Float[Array, "... 4 4"]:
    """The motion of a twist (vx, vy, vz, wx, wy, wz); the gradient is right at zero too."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.exp(jnp.asarray(tangent)).as_matrix()


@jax.jit
def log_se3(T: Float[AnyArray, "... 4 4"]) -> Float[Array, "... 6"]:
    """The twist (vx, vy, vz, wx, wy, wz) of a motion, of angle at most pi; not smooth at half a turn."""
    with jax.default_matmul_precision("highest"):
        return jaxlie.SE3.from_matrix(jnp.asarray(T)).log()


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
