"""The depth camera: what each ray meets first among boxes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.types import AnyArray

_PARALLEL = 1e-9


@jax.jit
def cast_depth(
    T_world_camera: Float[AnyArray, "4 4"],
    rays: Float[AnyArray, "h w 3"],
    centres: Float[AnyArray, "b 3"],
    half_sizes: Float[AnyArray, "b 3"],
    yaws: Float[AnyArray, " b"],
) -> Float[Array, "h w"]:
    """Depth along z of the first surface that each ray meets; `vmap` over cameras.

    Args:
        T_world_camera: pose of the camera.
        rays: directions in the camera frame with z = 1, so that a length along a ray is a depth.
        centres: of the boxes in the world, metres.
        half_sizes: of the boxes; a box of size 0 is never met.
        yaws: turn of each box about y, radians.

    Returns:
        (h, w) metres; infinite where a ray meets nothing. From within a box its inside is seen.
    """
    T, rays = jnp.asarray(T_world_camera), jnp.asarray(rays)
    directions_world = jnp.einsum("ij,hwj->hwi", T[:3, :3], rays, precision=jax.lax.Precision.HIGHEST)

    def meet(centre: Array, half: Array, yaw: Array) -> Array:
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        R_box_world = jnp.stack([jnp.stack([cos, 0.0, -sin]), jnp.array([0.0, 1.0, 0.0]), jnp.stack([sin, 0.0, cos])])
        origin = jnp.sum(R_box_world * (T[:3, 3] - centre), axis=-1)
        direction = jnp.einsum("ij,hwj->hwi", R_box_world, directions_world, precision=jax.lax.Precision.HIGHEST)
        safe = jnp.where(jnp.abs(direction) < _PARALLEL, _PARALLEL, direction)
        first, second = (-half - origin) / safe, (half - origin) / safe
        enter, leave = jnp.minimum(first, second).max(-1), jnp.maximum(first, second).min(-1)
        depth = jnp.where(enter > 0.0, enter, leave)
        return jnp.where((leave > jnp.maximum(enter, 0.0)) & (half > 0.0).all(), depth, jnp.inf)

    return jax.vmap(meet)(jnp.asarray(centres), jnp.asarray(half_sizes), jnp.asarray(yaws)).min(0)
