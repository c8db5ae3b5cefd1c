"""Frames of single points: x along a horizontal direction, y to the left of it, z up.

The direction is that of the ray from the lidar to the point, or the normal of the wall that the point is part of.
Vectors in such a frame do not change if the scan turns about the vertical.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpmjax.types import AnyArray, DescriptorCloud

# Weight of a neighbour at the height of the point, in normalised coordinates: that of 6 mm.
MIN_HEIGHT_WEIGHT = 1e-8

# Weight of the ray beside the spread of the neighbours, which is between 0 and 1.
RAY_WEIGHT = 1e-2


def ray_directions(positions: Float[AnyArray, "... d"]) -> Float[Array, "... 2"]:
    """Computes the unit horizontal direction of the ray from the lidar to each position.

    Args:
        positions: positions in the frame of the lidar, d is 2 or 3.

    Returns:
        Cosine and sine of the azimuth; (1, 0) on the vertical axis of the lidar.
    """
    squared = jnp.sum(positions[..., :2] ** 2, axis=-1)
    is_off_axis = squared > 0
    inverse = lax.rsqrt(jnp.where(is_off_axis, squared, 1))
    cosine = jnp.where(is_off_axis, positions[..., 0] * inverse, 1)
    sine = jnp.where(is_off_axis, positions[..., 1] * inverse, 0)
    return jnp.stack([cosine, sine], axis=-1)


def wall_normals(offsets: Float[AnyArray, "... k 3"], rays: Float[AnyArray, "... 2"]) -> Float[Array, "... 2"]:
    """Estimates the horizontal normal of the wall through each point, on the side of the lidar.

    It is the direction in which the neighbours spread least. Each neighbour counts by the square of its height above
    or below the point, so that the ground does not count. Where all directions are alike, it points along the ray back
    to the lidar.

    Args:
        offsets: offsets of the neighbours from each point, normalised coordinates.
        rays: unit directions of the rays to the points, same frame.

    Returns:
        Unit directions, without a derivative.
    """
    offsets, rays = lax.stop_gradient(jnp.asarray(offsets)), lax.stop_gradient(jnp.asarray(rays))
    x, y, z = offsets[..., 0], offsets[..., 1], offsets[..., 2]
    weights = z**2 + MIN_HEIGHT_WEIGHT
    xx, xy, yy = (jnp.sum(weights * product, axis=-1) for product in (x * x, x * y, y * y))
    # Twice the angle of the normal, as a vector: the direction of the smaller eigenvalue of the 2 x 2 covariance.
    spread = jnp.stack([yy - xx, -2 * xy], axis=-1) / jnp.maximum(xx + yy, jnp.finfo(xx.dtype).tiny)[..., None]
    along_ray = jnp.stack([rays[..., 0] ** 2 - rays[..., 1] ** 2, 2 * rays[..., 0] * rays[..., 1]], axis=-1)
    doubled = spread + RAY_WEIGHT * along_ray
    angle = jnp.arctan2(doubled[..., 1], doubled[..., 0]) / 2
    normal = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    is_away = jnp.sum(normal * rays, axis=-1, keepdims=True) > 0
    return jnp.where(is_away, -normal, normal)


def directions_of(cloud: DescriptorCloud) -> Float[Array, "*b m 2"]:
    """Returns the directions of the frames of descriptors.

    Args:
        cloud: descriptors; without directions it is one scan, and they are those of the rays to its positions.

    Returns:
        Unit vectors in the horizontal plane of the cloud's frame.
    """
    return ray_directions(cloud.described.positions) if cloud.directions is None else jnp.asarray(cloud.directions)


def to_ray_frame(vectors: Float[AnyArray, "... 3"], directions: Float[AnyArray, "... 2"]) -> Float[Array, "... 3"]:
    """Turns vectors about the vertical into the frames of rays.

    Args:
        vectors: vectors in the frame of the cloud.
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
        T_map_cloud: motion from that frame to a second one.

    Returns:
        Unit horizontal directions in the second frame; (1, 0) for one that becomes vertical.
    """
    R = jnp.asarray(T_map_cloud)[..., None, :2, :2]
    return ray_directions(jnp.sum(R * directions[..., None, :], axis=-1))
