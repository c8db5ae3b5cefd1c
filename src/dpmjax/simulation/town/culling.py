"""Selection of the bodies for a scan: the nearest of each kind, the ground around, and a list for each sector.

The selection has the same shapes in every world, so that the ray caster compiles once for each sensor.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.geometry import rigid, se2
from dpmjax.simulation.town.primitives import CELL_M, Bodies, Ground, TownPrimitives, traffic_boxes, turn_back

# Number of nearest boxes, cylinders and spheroids of a scan, and of those of one sector of the turn.
_NUM_NEAR = (1024, 512, 2048)
NUM_IN_SECTOR = (96, 48, 160)
# Side of the square of ground around the sensor; the heights of its border hold outside.
_GROUND_M = 168
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)


class NearBodies(NamedTuple):
    """Bodies of one kind that lie near the sensor, nearest first.

    Attributes:
        bodies: relative to the sensor.
        distances: lower bounds of the distances from the sensor to the surfaces, m; ascending, infinite for padding.
    """

    bodies: Bodies
    distances: Float[Array, " n"]


class NearWorld(NamedTuple):
    """Bodies and ground near the sensor.

    Attributes:
        boxes: nearest boxes, those of the traffic among them.
        cylinders: nearest cylinders.
        spheroids: nearest spheroids.
        ground: a square of ground, its origin relative to the sensor; heights are those of the world.
    """

    boxes: NearBodies
    cylinders: NearBodies
    spheroids: NearBodies
    ground: Ground


class SectorLists(NamedTuple):
    """The bodies of each sector, nearest first; where a list is full, the farthest are missing.

    Attributes:
        rows: rows of the bodies; those from `counts` on have no meaning.
        counts: number of bodies of a sector.
    """

    rows: Int[Array, "*s c"]
    counts: Int[Array, "*s"]


@partial(jax.jit, static_argnames="max_range")
def near_world(
    town: TownPrimitives, start: Float[Array, " 3"], time: Float[Array, ""], *, max_range: float
) -> NearWorld:
    """Selects the bodies and the ground near the sensor.

    Args:
        town: the world.
        start: position of the sensor, m.
        time: s, for the traffic.
        max_range: bodies beyond this range are left out, m.

    Returns:
        Bodies and ground near the sensor, in the same shapes for every town.
    """
    boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), town.boxes, traffic_boxes(town.traffic, start, time))
    kinds = zip((boxes, town.cylinders, town.spheroids), _NUM_NEAR, strict=True)
    boxes, cylinders, spheroids = (
        nearest_bodies(x._replace(centres=x.centres - start), number, max_range) for x, number in kinds
    )
    return NearWorld(boxes, cylinders, spheroids, _near_ground(town.ground, start))


def _near_ground(ground: Ground, start: Float[Array, " 3"]) -> Ground:
    count = round(_GROUND_M / CELL_M) + 1
    heights = jnp.pad(ground.heights, [(0, max(count - size, 0)) for size in ground.heights.shape], mode="edge")
    corner = jnp.round((start[:2] - ground.origin) / ground.cell - 0.5 * count).astype(jnp.int32)
    corner = jnp.clip(corner, 0, jnp.array([heights.shape[1] - count, heights.shape[0] - count]))
    part = jax.lax.dynamic_slice(heights, (corner[1], corner[0]), (count, count))
    return Ground(part, ground.origin + corner * ground.cell - start[:2], ground.cell)


def nearest_bodies(bodies: Bodies, capacity: int, max_range: float) -> NearBodies:
    """Selects the bodies with the nearest surfaces.

    Args:
        bodies: all of the town, relative to the sensor.
        capacity: number of kept bodies.
        max_range: bodies beyond this are left out, m.

    Returns:
        The nearest bodies, masked where there are fewer.
    """
    outside = jnp.maximum(jnp.abs(turn_back(bodies.centres, bodies.headings)) - bodies.half_sizes, 0.0)
    squared = jnp.where(bodies.mask, (outside**2).sum(-1), jnp.inf)
    missing = max(capacity - len(squared), 0)
    best, order = jax.lax.top_k(-jnp.pad(squared, (0, missing), constant_values=jnp.inf), capacity)
    kept = jax.tree.map(lambda x: x[jnp.minimum(order, len(squared) - 1)], bodies)
    return NearBodies(kept._replace(mask=best >= -(max_range**2)), jnp.sqrt(-best))


def sector_lists(
    near: NearBodies,
    T_world_lidar: Float[Array, "4 4"],
    sector_azimuths: Float[Array, " s"],
    capacity: int,
    way: Float[Array, ""],
) -> SectorLists:
    """Lists the bodies of each sector of a turn.

    Args:
        near: the bodies.
        T_world_lidar: pose of the sensor; only its rotation counts.
        sector_azimuths: middles of equal sectors of the turn in the sensor frame, radians.
        capacity: largest number of bodies of a sector.
        way: largest translation of the sensor during the turn, m; it turns by less than half a sector.

    Returns:
        The lists.
    """
    middle, half_width = _azimuth_intervals(near.bodies, T_world_lidar)
    half_width += jnp.arctan(way / jnp.maximum(near.distances, 1e-3)) + jnp.where(way > 0, 0.05, 0.0)
    apart = jnp.abs(se2.wrap_angle(middle[None] - sector_azimuths[:, None]))
    is_seen = near.bodies.mask[None] & (apart <= half_width[None] + np.pi / len(sector_azimuths))
    place = jnp.cumsum(is_seen, axis=1) - 1
    slot = jnp.where(is_seen & (place < capacity), place, capacity)
    sectors = jnp.arange(len(sector_azimuths))[:, None]
    entries = jnp.broadcast_to(jnp.arange(len(near.distances)), slot.shape)
    rows = jnp.zeros((len(sector_azimuths), capacity + 1), jnp.int32).at[sectors, slot].set(entries)[:, :capacity]
    return SectorLists(rows, jnp.minimum(is_seen.sum(axis=1), capacity))


def _azimuth_intervals(
    bodies: Bodies, T_world_lidar: Float[Array, "4 4"]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Computes middle and half-width of the azimuths of boxes in the sensor frame; pi above or below the sensor."""
    # A box is the convex hull of its corners, and so is its projection to the sensor's x-y plane.
    turn = jnp.zeros((4, 4), T_world_lidar.dtype).at[:3, :3].set(T_world_lidar[:3, :3].T).at[3, 3].set(1.0)
    local = jnp.asarray(_CORNERS)[None] * bodies.half_sizes[:, None]
    turned = turn_back(local, bodies.headings[:, None] * jnp.array([1.0, -1.0]))
    corners = rigid.transform_points(turn, (bodies.centres[:, None] + turned).reshape(-1, 3)).reshape(turned.shape)
    middle = rigid.transform_points(turn, bodies.centres)
    towards = jnp.arctan2(middle[:, 1], middle[:, 0])
    azimuth = se2.wrap_angle(jnp.arctan2(corners[..., 1], corners[..., 0]) - towards[:, None])
    low, high = azimuth.min(-1), azimuth.max(-1)
    half_width = jnp.where(high - low < np.pi, 0.5 * (high - low), np.pi)
    return se2.wrap_angle(towards + 0.5 * (low + high)), half_width
