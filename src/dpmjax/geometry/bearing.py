"""The frame of a ray: x along the horizontal direction of the ray from the lidar, y to the left of it, z up.

Vectors in it do not change if the scan turns about the vertical.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpmjax.types import AnyArray, DescriptorCloud


def ray_directions(positions: Float[AnyArray, "... d"]) -> Float[Array, "... 2"]:
    """Computes the unit horizontal direction of the ray from the lidar to each position.

    Args:
        positions: in the frame of the lidar, d is 2 or 3.

    Returns:
        Cosine and sine of the azimuth; (1, 0) on the vertical axis of the lidar.
    """
    squared = jnp.sum(positions[..., :2] ** 2, axis=-1)
    is_off_axis = squared > 0
    inverse = lax.rsqrt(jnp.where(is_off_axis, squared, 1))
    cosine = jnp.where(is_off_axis, positions[..., 0] * inverse, 1)
    sine = jnp.where(is_off_axis, positions[..., 1] * inverse, 0)
    return jnp.stack([cosine, sine], axis=-1)


def directions_of(cloud: DescriptorCloud) -> Float[Array, "*b m 2"]:
    """Returns the directions of the rays of a cloud.

    Args:
        cloud: descriptors; without directions it is one scan, and its positions are the ends of its rays.

    Returns:
        Unit vectors in the horizontal plane of the cloud's frame.
    """
    return ray_directions(cloud.positions) if cloud.directions is None else cloud.directions


def to_ray_frame(vectors: Float[AnyArray, "... 3"], directions: Float[AnyArray, "... 2"]) -> Float[Array, "... 3"]:
    """Turns vectors about the vertical into the frames of rays.

    Args:
        vectors: in the frame of the cloud.
        directions: unit direction of the ray of each vector, same frame.

    Returns:
        The vectors in the frames of their rays.
    """
    cosine, sine = directions[..., 0], directions[..., 1]
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)


def from_ray_frame(vectors: Float[AnyArray, "... 3"], directions: Float[AnyArray, "... 2"]) -> Float[Array, "... 3"]:
    """Turns vectors from the frames of rays back, the inverse of `to_ray_frame`.

    Args:
        vectors: each in the frame of its ray.
        directions: unit direction of each ray, in the frame of the cloud.

    Returns:
        The vectors in the frame of the cloud.
    """
    return to_ray_frame(vectors, directions * jnp.array([1, -1], directions.dtype))


def turned_directions(
    directions: Float[AnyArray, "*b m 2"], T_map_cloud: Float[AnyArray, "*b 4 4"]
) -> Float[Array, "*b m 2"]:
    """Turns directions of rays into another frame: they are rotated, projected to the horizontal plane, normalised.

    Args:
        directions: unit horizontal directions in the frame of the cloud.
        T_map_cloud: motion from that frame to the other one.

    Returns:
        Unit horizontal directions in the other frame; (1, 0) for one that becomes vertical.
    """
    R = jnp.asarray(T_map_cloud)[..., None, :2, :2]
    return ray_directions(jnp.sum(R * directions[..., None, :], axis=-1))
