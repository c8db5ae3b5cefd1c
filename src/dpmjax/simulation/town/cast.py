"""The ray caster: finds what each ray of a turn meets first, among the bodies of its sector and the ground.

A scan of 100,000 rays against 30,000 boxes would need 3e9 tests. The nearest thousand boxes are picked once a scan, and
each sector of some degrees gets a short list of them, nearest first: 100 tests a ray remain. Where a list is full, the
farthest bodies are missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from dpmjax.geometry import rigid, se2
from dpmjax.simulation.town.intersect import Cross, cross_box, cross_cylinder, cross_ground, cross_spheroid, recess
from dpmjax.simulation.town.primitives import GROUND, NOTHING, Bodies, TownPrimitives, traffic_boxes, turn_back

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)


@dataclass(frozen=True)
class CastConfig:
    """How much of the town a scan looks at.

    Attributes:
        num_boxes: nearest boxes that take part.
        num_cylinders: nearest cylinders.
        num_spheroids: nearest spheroids.
        boxes_per_sector: boxes that one sector of the turn holds.
        cylinders_per_sector: cylinders of a sector.
        spheroids_per_sector: spheroids of a sector.
        max_sectors: largest number of sectors of a turn.
    """

    num_boxes: int = 1024
    num_cylinders: int = 256
    num_spheroids: int = 1024
    boxes_per_sector: int = 64
    cylinders_per_sector: int = 16
    spheroids_per_sector: int = 48
    max_sectors: int = 72

    def __post_init__(self) -> None:
        if min(vars(self).values()) < 1:
            raise ValueError(f"all capacities must be at least 1, got {self}")


class Hits(NamedTuple):
    """First hits of r rays in each of s sectors.

    Attributes:
        ranges: m; infinite for nothing.
        cosines: of the angle between the ray and the surface's normal; 1 for foliage.
        surfaces: NOTHING, GROUND, SOLID, SOFT, POLE or MOVING.
        is_glass: True in windows.
    """

    ranges: Float[Array, "s r"]
    cosines: Float[Array, "s r"]
    surfaces: Int[Array, "s r"]
    is_glass: Float[Array, "s r"]


class Rays(NamedTuple):
    """The rays of a turn: r rays in each of s equal sectors.

    Attributes:
        directions: unit directions in the sensor frame.
        azimuths: middle of each sector, radians.
        depths: how many mean ways each ray goes into foliage.
    """

    directions: Float[Array, "s r 3"]
    azimuths: Float[Array, " s"]
    depths: Float[Array, "s r"]


def cast_turn(
    town: TownPrimitives,
    T_world_lidar: Float[Array, "4 4"],
    time: Float[Array, ""],
    rays: Rays,
    *,
    max_range: float,
    config: CastConfig,
) -> Hits:
    """Follows all rays of a turn to what they meet first, without noise and loss.

    Args:
        town: the world.
        T_world_lidar: pose of the sensor.
        time: s, for the traffic.
        rays: by sector.
        max_range: m.
        config: capacities.

    Returns:
        The hits, by sector.
    """
    start = T_world_lidar[:3, 3]
    T_lidar_world = jnp.zeros((4, 4), T_world_lidar.dtype).at[:3, :3].set(T_world_lidar[:3, :3].T).at[3, 3].set(1.0)
    highest = jax.lax.Precision.HIGHEST
    directions = jnp.einsum("ij,srj->sri", T_world_lidar[:3, :3], rays.directions, precision=highest)
    in_world = rays._replace(directions=directions)

    def first_hits(bodies: Bodies, num_nearest: int, capacity: int, cross: Cross) -> Hits:
        near = nearest_bodies(bodies._replace(centres=bodies.centres - start), num_nearest, max_range)
        return _body_hits(bodies_by_sector(near, T_lidar_world, rays.azimuths, capacity), in_world, cross)

    boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), town.boxes, traffic_boxes(town.traffic, start, time))
    hits = first_hits(boxes, config.num_boxes, config.boxes_per_sector, cross_box)
    poles = first_hits(town.cylinders, config.num_cylinders, config.cylinders_per_sector, cross_cylinder)
    tufts = first_hits(town.spheroids, config.num_spheroids, config.spheroids_per_sector, cross_spheroid)
    down = cross_ground(town.ground, start, directions, max_range)
    surfaces, is_glass = jnp.where(jnp.isfinite(down), GROUND, NOTHING), jnp.zeros(down.shape, bool)
    ground = Hits(down, jnp.abs(directions[..., 2]), surfaces, is_glass)
    for others in (poles, tufts, ground):
        hits = _nearer(hits, others)
    is_seen = hits.ranges <= max_range
    ranges, surfaces = jnp.where(is_seen, hits.ranges, jnp.inf), jnp.where(is_seen, hits.surfaces, NOTHING)
    return hits._replace(ranges=ranges, surfaces=surfaces)


def _nearer(a: Hits, b: Hits) -> Hits:
    is_a = a.ranges <= b.ranges
    return jax.tree.map(lambda x, y: jnp.where(is_a, x, y), a, b)


def _first(bodies: Bodies, rays: Rays, cross: Cross) -> tuple[Float[Array, "s r"], Int[Array, "s r"]]:
    """Range of the first body of each ray, and its slot in the sector's list (-1: none): all rays, slot by slot."""

    def meet(best: tuple[Array, Array], entry: tuple[Array, Bodies]) -> tuple[tuple[Array, Array], None]:
        (ranges, slots), (slot, column) = best, entry
        body = jax.tree.map(lambda x: x[:, None], column)
        crossing = cross(rays.directions, body)
        distance = crossing.entry + body.softness * rays.depths
        is_met = body.mask & (crossing.entry > 0) & (distance <= crossing.exit) & (distance < ranges)
        return (jnp.where(is_met, distance, ranges), jnp.where(is_met, slot, slots)), None

    columns = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), bodies)
    nothing = (jnp.full(rays.depths.shape, jnp.inf, rays.depths.dtype), jnp.full(rays.depths.shape, -1))
    best, _ = jax.lax.scan(meet, nothing, (jnp.arange(bodies.mask.shape[1]), columns))
    return best


def _body_hits(bodies: Bodies, rays: Rays, cross: Cross) -> Hits:
    """The first bodies of all rays; boxes have windows, and the angle of a face counts, unless it is soft."""
    ranges, slots = _first(bodies, rays, cross)
    is_met = slots >= 0
    # For each ray, the body in the slot of its sector's list.
    body = jax.tree.map(lambda x: x[jnp.arange(len(slots))[:, None], jnp.maximum(slots, 0)], bodies)
    surfaces = jnp.where(is_met, body.surface, NOTHING)
    if cross is not cross_box:
        return Hits(ranges, jnp.ones_like(ranges), surfaces, jnp.zeros(is_met.shape, bool))
    deeper, cosines, is_glass = recess(jnp.where(is_met, ranges, 0.0), rays.directions, body)
    cosines = jnp.where(body.softness > 0, 1.0, cosines)
    return Hits(jnp.where(is_met, deeper, jnp.inf), cosines, surfaces, is_glass & is_met)


def nearest_bodies(bodies: Bodies, capacity: int, max_range: float) -> Bodies:
    """The bodies with the nearest surfaces.

    Args:
        bodies: all of the town, relative to the sensor.
        capacity: how many to keep at most.
        max_range: bodies beyond this are left out, m.

    Returns:
        The nearest bodies, nearest first.
    """
    outside = jnp.maximum(jnp.abs(turn_back(bodies.centres, bodies.headings)) - bodies.half_sizes, 0.0)
    squared = jnp.where(bodies.mask, (outside**2).sum(-1), jnp.inf)
    best, order = jax.lax.top_k(-squared, min(capacity, len(squared)))
    kept = jax.tree.map(lambda x: x[order], bodies)
    return kept._replace(mask=best >= -(max_range**2))


def _azimuth_intervals(
    bodies: Bodies, T_lidar_world: Float[Array, "4 4"]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Middle and half-width, radians, of the azimuths under which the boxes are seen in the sensor frame.

    Args:
        bodies: relative to the sensor, in axes of the world.
        T_lidar_world: only its rotation counts.

    Returns:
        Middles and half-widths; half-width pi, the whole turn, where the box lies over or under the sensor.
    """
    # A box is the hull of its corners, and so is its shadow on the sensor's x-y plane.
    turn = T_lidar_world.at[:3, 3].set(0.0)
    local = jnp.asarray(_CORNERS)[None] * bodies.half_sizes[:, None]
    turned = turn_back(local, bodies.headings[:, None] * jnp.array([1.0, -1.0]))
    corners = rigid.transform_points(turn, (bodies.centres[:, None] + turned).reshape(-1, 3)).reshape(turned.shape)
    middle = rigid.transform_points(turn, bodies.centres)
    towards = jnp.arctan2(middle[:, 1], middle[:, 0])
    azimuth = se2.wrap_angle(jnp.arctan2(corners[..., 1], corners[..., 0]) - towards[:, None])
    low, high = azimuth.min(-1), azimuth.max(-1)
    half_width = jnp.where(high - low < np.pi, 0.5 * (high - low), np.pi)
    return se2.wrap_angle(towards + 0.5 * (low + high)), half_width


def bodies_by_sector(
    bodies: Bodies, T_lidar_world: Float[Array, "4 4"], sector_azimuths: Float[Array, " s"], capacity: int
) -> Bodies:
    """Gives each sector its own list of bodies, in the order of the bodies.

    Args:
        bodies: nearest first, relative to the sensor.
        T_lidar_world: only its rotation counts.
        sector_azimuths: middles of equal sectors of the turn in the sensor frame, radians.
        capacity: how many bodies a sector holds.

    Returns:
        Bodies with arrays (s, capacity, ...).
    """
    middle, half_width = _azimuth_intervals(bodies, T_lidar_world)
    apart = jnp.abs(se2.wrap_angle(middle[None] - sector_azimuths[:, None]))
    is_seen = bodies.mask[None] & (apart <= half_width[None] + np.pi / len(sector_azimuths))
    place = jnp.cumsum(is_seen, axis=1) - 1
    slot = jnp.where(is_seen & (place < capacity), place, capacity)
    rows = jnp.arange(len(sector_azimuths))[:, None]
    entries = jnp.broadcast_to(jnp.arange(len(bodies.mask)), slot.shape)
    chosen = jnp.full((len(sector_azimuths), capacity + 1), -1).at[rows, slot].set(entries)[:, :capacity]
    listed = jax.tree.map(lambda x: x[chosen], bodies)
    return listed._replace(mask=chosen >= 0)
