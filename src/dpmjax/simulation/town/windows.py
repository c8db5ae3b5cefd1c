"""The relief of facades: windows and doors lie behind the wall, so that the position along a front is observable."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.simulation.town.intersect import turn_back
from dpmjax.simulation.town.primitives import Bodies

_STOREY_M = 2.9
_SILL_M = 0.9
_LINTEL_M = 2.2
_TINY = 1e-6


class FaceHits(NamedTuple):
    """Where rays end at faces of boxes.

    Attributes:
        ranges: m, behind the face where the ray goes into a window.
        cosines: of the angle between the ray and the normal.
        is_glass: True in windows and doors.
    """

    ranges: Float[Array, "..."]
    cosines: Float[Array, "..."]
    is_glass: Bool[Array, "..."]


def recess(ranges: Float[Array, "..."], directions: Float[Array, "... 3"], body: Bodies) -> FaceHits:
    """Takes rays that have reached a face on to the window pane behind it, or to the side of the opening.

    Each side face of a box with windows is divided into bays of 2 to 4 m (a width of its own) and storeys of 2.9 m. The
    middle of a bay is open; on the ground floor every third opening is a door.

    Args:
        ranges: distance at which the ray meets the box, m.
        directions: unit directions in axes of the world.
        body: the box of each ray, relative to the sensor.

    Returns:
        The hits.
    """
    offset = turn_back(ranges[..., None] * directions - body.centres, body.headings)
    along = turn_back(directions, body.headings)
    half = jnp.maximum(body.half_sizes, _TINY)
    slack = jnp.stack([half[..., 0] - jnp.abs(offset[..., 0]), half[..., 1] - jnp.abs(offset[..., 1])], -1)
    is_x = slack[..., 0] < slack[..., 1]
    is_side = jnp.minimum(slack[..., 0], slack[..., 1]) < half[..., 2] - jnp.abs(offset[..., 2])
    across = jnp.abs(jnp.where(is_x, along[..., 0], along[..., 1]))
    cosines = jnp.where(is_side, across, jnp.abs(directions[..., 2]))

    length = jnp.where(is_x, half[..., 1], half[..., 0])
    bay = 2.0 * length / jnp.maximum(jnp.floor(2.0 * length / (2.2 + jnp.mod(7.3 * half[..., 2], 1.6))), 1.0)
    place = jnp.where(is_x, offset[..., 1], offset[..., 0]) + length
    height = offset[..., 2] + half[..., 2]
    storey = jnp.floor(height / _STOREY_M)
    is_door = (storey == 0) & (jnp.mod(jnp.floor(place / bay), 3) == 1)
    beside, above = jnp.mod(place, bay), height - storey * _STOREY_M
    left, right = 0.3 * bay, 0.7 * bay
    low, high = jnp.where(is_door, 0.1, _SILL_M), _LINTEL_M
    is_open = (beside > left) & (beside < right) & (above > low) & (above < high) & is_side & (body.window_depth > 0)

    speed, climb = jnp.where(is_x, along[..., 1], along[..., 0]), directions[..., 2]
    to_jamb = jnp.where(speed > 0, right - beside, beside - left) / jnp.maximum(jnp.abs(speed), _TINY)
    to_sill = jnp.where(climb > 0, high - above, above - low) / jnp.maximum(jnp.abs(climb), _TINY)
    to_pane = body.window_depth / jnp.maximum(across, _TINY)
    deeper = jnp.minimum(jnp.minimum(to_jamb, to_sill), to_pane)
    return FaceHits(ranges + jnp.where(is_open, deeper, 0.0), cosines, is_open & (deeper >= to_pane))
