"""Primitives of a town for the ray caster: boxes, poles, spheroids, a height field, and traffic on lanes.

Lists have a capacity (a power of two) and a mask, so that towns of similar size share one compiled kernel. All
coordinates are in the world frame: metres, z up.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.sequences import FloatArray

LANE_STEP_M = 2.0
# Distance of the nodes of the ground.
CELL_M = 0.5
# Road users nearer to the sensor than this are left out, because the sensor's own car is there.
_CLEARANCE_M = 4.0


# Kinds of surfaces.
NOTHING, GROUND, SOLID, SOFT, POLE, MOVING = range(6)


class Bodies(NamedTuple):
    """Upright boxes, cylinders or ellipsoids of revolution, by the boxes round them, turned about z only.

    Attributes:
        centres: centres in the world, m.
        half_sizes: along the box's own x, y, z, m; of a round body: radius, radius, half height.
        headings: cosine and sine of the angle from the world's x to the box's x.
        softness: mean depth, m, of a beam in hedges, fences and foliage before it is reflected; 0 if solid.
        window_depth: distance of windows and doors behind the faces of a box, m; 0 for faces without any.
        surface: SOLID, SOFT, POLE or MOVING.
        mask: True for bodies, False for padding.
    """

    centres: Float[Array, "n 3"]
    half_sizes: Float[Array, "n 3"]
    headings: Float[Array, "n 2"]
    softness: Float[Array, " n"]
    window_depth: Float[Array, " n"]
    surface: Int[Array, " n"]
    mask: Bool[Array, " n"]


class Ground(NamedTuple):
    """Heights on a square grid, bilinear between the nodes; outside, those of the nearest border.

    Attributes:
        heights: heights[i, j] is z at origin + cell * (j, i), m.
        origin: x and y of heights[0, 0], m.
        cell: distance of the nodes, m.
    """

    heights: Float[Array, "h w"]
    origin: Float[Array, " 2"]
    cell: Float[Array, ""]


class RoadUsers(NamedTuple):
    """Cars that drive and people that walk, each at its own speed along a lane.

    Attributes:
        lane_points: x, y, z of each lane at equal steps; lanes are padded to one length by repeating their end.
        lane_lengths: length of each lane, m.
        lanes: lane of each road user.
        starts: path length along the lane at time 0, m.
        speeds: m/s, positive; at the end of the lane a road user starts again.
        sides: distance to the left of the lane, m.
        half_sizes: half sizes of the box around the road user, m; cars (longer than 1 m) get a cabin on top.
        mask: True for road users, False for padding.
    """

    lane_points: Float[Array, "k s 3"]
    lane_lengths: Float[Array, " k"]
    lanes: Int[Array, " n"]
    starts: Float[Array, " n"]
    speeds: Float[Array, " n"]
    sides: Float[Array, " n"]
    half_sizes: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


class TownPrimitives(NamedTuple):
    """All surfaces of a town for the ray caster.

    Attributes:
        boxes: boxes of static objects.
        cylinders: poles and trunks.
        spheroids: foliage.
        ground: streets, pavements and meadows.
        traffic: moving objects.
    """

    boxes: Bodies
    cylinders: Bodies
    spheroids: Bodies
    ground: Ground
    traffic: RoadUsers


def capacity_for(count: int, *, least: int = 64) -> int:
    """Returns the power of two that holds this number of entries.

    Args:
        count: number of entries.
        least: smallest capacity.

    Returns:
        The capacity.
    """
    return max(least, 1 << max(count - 1, 0).bit_length())


def padded(rows: FloatArray, capacity: int) -> jax.Array:
    """Pads a list of primitives with zeros up to the capacity, as float32.

    Args:
        rows: (n, ...) values.
        capacity: number of rows to return, at least n.

    Returns:
        (capacity, ...) on the device.
    """
    whole = np.zeros((capacity, *rows.shape[1:]), np.float32)
    whole[: len(rows)] = rows
    return jnp.asarray(whole)


def pack_bodies(table: FloatArray, surface: int) -> Bodies:
    """Makes bodies of one kind from rows.

    Args:
        table: (n, 9) x y z, half sizes, heading in radians, softness, window depth.
        surface: SOLID (soft rows become SOFT), SOFT or POLE.

    Returns:
        The bodies, padded.
    """
    table = table.reshape(-1, 9)
    rows = padded(table, capacity_for(len(table)))
    headings = padded(np.column_stack([np.cos(table[:, 6]), np.sin(table[:, 6])]), len(rows))
    surfaces = jnp.where((rows[:, 7] > 0) & (surface == SOLID), SOFT, surface)
    mask = jnp.arange(len(rows)) < len(table)
    return Bodies(rows[:, :3], rows[:, 3:6], headings, rows[:, 7], rows[:, 8], surfaces, mask)


def turn_back(vectors: Float[Array, "... 3"], heading: Float[Array, "... 2"]) -> Float[Array, "... 3"]:
    """Rotates vectors into the axes of a box that is turned about z.

    Args:
        vectors: vectors in axes of the world.
        heading: cosine and sine of the turn.

    Returns:
        The same vectors along the box's own x, y, z.
    """
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    cos, sin = heading[..., 0], heading[..., 1]
    along, across = cos * x + sin * y, cos * y - sin * x
    return jnp.stack([along, across, jnp.broadcast_to(z, along.shape)], axis=-1)


def traffic_boxes(traffic: RoadUsers, sensor: Float[Array, " 3"], time: Float[Array, ""]) -> Bodies:
    """Computes the boxes of the road users at a time.

    Args:
        traffic: lanes and users.
        sensor: position of the sensor in the world, m; road users within 4 m of it are left out.
        time: time, s.

    Returns:
        Two boxes for each: body and cabin (masked for people and lorries).
    """
    way = jnp.mod(traffic.starts + traffic.speeds * time, traffic.lane_lengths[traffic.lanes])
    here, ahead = _on_lane(traffic, way), _on_lane(traffic, way + 0.5 * LANE_STEP_M)
    heading = ahead[:, :2] - here[:, :2]
    heading = heading / jnp.maximum(jnp.linalg.norm(heading, axis=-1, keepdims=True), 1e-6)
    left = jnp.stack([-heading[:, 1], heading[:, 0], jnp.zeros(len(heading))], axis=-1)
    foot = here + traffic.sides[:, None] * left
    is_free = ((foot[:, :2] - sensor[:2]) ** 2).sum(-1) > _CLEARANCE_M**2
    # Shorter road users are people, longer ones are lorries: one box above the street.
    low, high = (0.5, 2.9)
    is_car = (traffic.half_sizes[:, 0] > low) & (traffic.half_sizes[:, 0] < high)
    # Body and cabin of a car divide the height above 0.25 m as 3 : 2.
    room = traffic.half_sizes[:, 2] - 0.125
    body_z, cabin_z = 0.6 * room, 0.4 * room
    half_body = jnp.where(is_car, body_z, traffic.half_sizes[:, 2])
    lift = jnp.where(is_car, 0.25, jnp.where(traffic.half_sizes[:, 0] >= high, 0.5, 0.0))
    up = jnp.array([0.0, 0.0, 1.0], foot.dtype)
    zero = jnp.zeros(len(way), foot.dtype)
    middle, half_sizes = foot + (lift + half_body)[:, None] * up, traffic.half_sizes.at[:, 2].set(half_body)
    surface, mask = jnp.full(len(way), MOVING), traffic.mask & is_free
    body = Bodies(middle, half_sizes, heading, zero, zero, surface, mask)
    cabin = body._replace(
        centres=foot + (lift + 2 * half_body + cabin_z)[:, None] * up,
        half_sizes=traffic.half_sizes * jnp.array([0.55, 0.85, 0.0], foot.dtype) + cabin_z[:, None] * up,
        mask=body.mask & is_car,
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), body, cabin)


def _on_lane(traffic: RoadUsers, way: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Interpolates points of the lanes linearly."""
    at = jnp.clip(way / LANE_STEP_M, 0.0, traffic.lane_points.shape[1] - 1.001)
    low = jnp.floor(at).astype(jnp.int32)
    part = (at - low)[:, None]
    return traffic.lane_points[traffic.lanes, low] * (1 - part) + traffic.lane_points[traffic.lanes, low + 1] * part
