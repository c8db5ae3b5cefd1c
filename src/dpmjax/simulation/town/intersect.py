"""Where one ray enters and leaves one primitive. Solid and soft bodies share one rule: the way that is gone inside.

Every function takes the primitive relative to the ray's start and returns the two distances along the ray; a ray that
misses has entry > exit. A ray that starts inside enters at a negative distance, which the caller treats as a miss: the
sensor's own car is not seen.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

# Directions along an axis are nudged off zero by this: a thousandth of a millimetre at 100 m.
_TINY = 1e-8


class Crossing(NamedTuple):
    """Distances along a ray of unit length: in and out of a convex body; entry > exit where it is missed.

    Attributes:
        entry: where the ray goes in.
        exit: where it comes out.
    """

    entry: Float[Array, "..."]
    exit: Float[Array, "..."]


def _off_zero(value: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(jnp.abs(value) < _TINY, _TINY, value)


def _slab(centre: Array, half_size: Array, inverse: Array) -> tuple[Array, Array]:
    """Between two parallel planes: |x - centre| <= half_size, for x = t / inverse."""
    middle, reach = centre * inverse, half_size * jnp.abs(inverse)
    return middle - reach, middle + reach


def cross_box(
    direction: Float[Array, "... 3"],
    centre: Float[Array, "... 3"],
    half_size: Float[Array, "... 3"],
    heading: Float[Array, "... 2"],
) -> Crossing:
    """A ray from the origin through an upright box (the slab method, Kay and Kajiya 1986).

    Args:
        direction: of the ray, unit length.
        centre: of the box, relative to the ray's start, m.
        half_size: of the box, m.
        heading: cosine and sine of the box's turn about z.

    Returns:
        The crossing, m.
    """
    cos, sin = heading[..., 0], heading[..., 1]
    x_in, x_out = _slab(
        cos * centre[..., 0] + sin * centre[..., 1],
        half_size[..., 0],
        1.0 / _off_zero(cos * direction[..., 0] + sin * direction[..., 1]),
    )
    y_in, y_out = _slab(
        cos * centre[..., 1] - sin * centre[..., 0],
        half_size[..., 1],
        1.0 / _off_zero(cos * direction[..., 1] - sin * direction[..., 0]),
    )
    z_in, z_out = _slab(centre[..., 2], half_size[..., 2], 1.0 / _off_zero(direction[..., 2]))
    return Crossing(jnp.maximum(jnp.maximum(x_in, y_in), z_in), jnp.minimum(jnp.minimum(x_out, y_out), z_out))


def cross_cylinder(
    direction: Float[Array, "... 3"],
    centre: Float[Array, "... 3"],
    radius: Float[Array, "..."],
    half_height: Float[Array, "..."],
) -> Crossing:
    """A ray from the origin through an upright cylinder with lids.

    Args:
        direction: of the ray, unit length.
        centre: of the cylinder, relative to the ray's start, m.
        radius: m.
        half_height: m.

    Returns:
        The crossing, m.
    """
    squared = jnp.maximum(direction[..., 0] ** 2 + direction[..., 1] ** 2, _TINY**2)
    nearest = (direction[..., 0] * centre[..., 0] + direction[..., 1] * centre[..., 1]) / squared
    # The distance from the axis, from a difference: the usual discriminant cancels at 100 m.
    across = (direction[..., 0] * centre[..., 1] - direction[..., 1] * centre[..., 0]) ** 2 / squared
    inside = (radius**2 - across) / squared
    half_chord = jnp.sqrt(jnp.maximum(inside, 0.0))
    z_in, z_out = _slab(centre[..., 2], half_height, 1.0 / _off_zero(direction[..., 2]))
    entry, leave = jnp.maximum(nearest - half_chord, z_in), jnp.minimum(nearest + half_chord, z_out)
    return Crossing(jnp.where(inside > 0, entry, jnp.inf), leave)


def cross_spheroid(
    direction: Float[Array, "... 3"],
    centre: Float[Array, "... 3"],
    radius: Float[Array, "..."],
    half_height: Float[Array, "..."],
) -> Crossing:
    """A ray from the origin through an ellipsoid of revolution about z.

    Args:
        direction: of the ray, unit length.
        centre: of the spheroid, relative to the ray's start, m.
        radius: horizontal semi-axis, m.
        half_height: vertical semi-axis, m.

    Returns:
        The crossing, m.
    """
    # In coordinates where it is the unit sphere; distances along the ray are the same.
    x, y, z = direction[..., 0] / radius, direction[..., 1] / radius, direction[..., 2] / half_height
    u, v, w = centre[..., 0] / radius, centre[..., 1] / radius, centre[..., 2] / half_height
    squared = x * x + y * y + z * z
    nearest = (x * u + y * v + z * w) / squared
    miss = (u - nearest * x) ** 2 + (v - nearest * y) ** 2 + (w - nearest * z) ** 2
    inside = (1.0 - miss) / squared
    half_chord = jnp.sqrt(jnp.maximum(inside, 0.0))
    return Crossing(jnp.where(inside > 0, nearest - half_chord, jnp.inf), nearest + half_chord)
