"""The ray caster: finds what each ray of a turn meets first, among the bodies of its sector and the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dpmjax.simulation.town.intersect import (
    Crossing,
    Hull,
    cross_box,
    cross_cylinder,
    cross_ground,
    cross_spheroid,
)
from dpmjax.simulation.town.primitives import RoundBodies, TownPrimitives, traffic_boxes
from dpmjax.simulation.town.sectors import Bodies, bodies_by_sector, nearest_bodies
from dpmjax.simulation.town.windows import recess

NOTHING, GROUND, SOLID, SOFT, POLE, MOVING = range(6)
"""What a ray can meet."""


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


@flax.struct.dataclass
class Hits:
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


class _Best(NamedTuple):
    """The nearest meeting so far: range, and slot in the sector's list (-1: none)."""

    ranges: Float[Array, "s r"]
    slots: Int[Array, "s r"]


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
    in_world = rays._replace(
        directions=jnp.einsum("ij,srj->sri", T_world_lidar[:3, :3], rays.directions, precision=highest)
    )

    def in_sectors(bodies: Bodies, num_nearest: int, capacity: int) -> Bodies:
        near = nearest_bodies(bodies, num_nearest, max_range)
        return bodies_by_sector(near, T_lidar_world, rays.azimuths, capacity)

    boxes = in_sectors(_boxes(town, start, time), config.num_boxes, config.boxes_per_sector)
    cylinders = in_sectors(_upright(town.cylinders, start), config.num_cylinders, config.cylinders_per_sector)
    spheroids = in_sectors(_upright(town.spheroids, start), config.num_spheroids, config.spheroids_per_sector)
    hits = _box_hits(boxes, in_world, len(town.boxes.mask))
    hits = _nearer(hits, _round_hits(cylinders, in_world, cross_cylinder, POLE))
    hits = _nearer(hits, _round_hits(spheroids, in_world, cross_spheroid, SOFT))
    hits = _nearer(hits, _ground_hits(town, start, in_world, max_range))
    is_seen = hits.ranges <= max_range
    return replace(
        hits, ranges=jnp.where(is_seen, hits.ranges, jnp.inf), surfaces=jnp.where(is_seen, hits.surfaces, NOTHING)
    )


def _nearer(a: Hits, b: Hits) -> Hits:
    is_a = a.ranges <= b.ranges
    return jax.tree.map(lambda x, y: jnp.where(is_a, x, y), a, b)


def _boxes(town: TownPrimitives, start: Float[Array, " 3"], time: Float[Array, ""]) -> Bodies:
    """Boxes that stand and boxes that drive, relative to the sensor."""
    moving = traffic_boxes(town.traffic, start, time)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), town.boxes, moving)
    return Bodies(**{**vars(both), "centres": both.centres - start}, index=jnp.arange(len(both.mask)))


def _upright(bodies: RoundBodies, start: Float[Array, " 3"]) -> Bodies:
    """Round bodies by the boxes round them, relative to the sensor."""
    zero = jnp.zeros_like(bodies.radii)
    return Bodies(
        centres=bodies.centres - start,
        half_sizes=jnp.stack([bodies.radii, bodies.radii, bodies.half_heights], axis=-1),
        headings=jnp.stack([zero + 1.0, zero], axis=-1),
        softness=bodies.softness,
        window_depth=zero,
        mask=bodies.mask,
        index=jnp.arange(len(bodies.mask)),
    )


def _first(bodies: Bodies, rays: Rays, cross: Callable[[Array, Hull], Crossing]) -> _Best:
    """The first body of each ray: one slot of the lists after the other, all rays at once."""

    def meet(best: _Best, entry: tuple[Array, Bodies]) -> tuple[_Best, None]:
        slot, column = entry
        body = jax.tree.map(lambda x: x[:, None], column)
        crossing = cross(rays.directions, Hull(body.centres, body.half_sizes, body.headings))
        distance = crossing.entry + body.softness * rays.depths
        is_met = body.mask & (crossing.entry > 0) & (distance <= crossing.exit) & (distance < best.ranges)
        return _Best(jnp.where(is_met, distance, best.ranges), jnp.where(is_met, slot, best.slots)), None

    columns = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), bodies)
    nothing = _Best(jnp.full(rays.depths.shape, jnp.inf, rays.depths.dtype), jnp.full(rays.depths.shape, -1))
    best, _ = jax.lax.scan(meet, nothing, (jnp.arange(bodies.mask.shape[1]), columns))
    return best


def _box_hits(bodies: Bodies, rays: Rays, num_standing: int) -> Hits:
    best = _first(bodies, rays, cross_box)
    is_met = best.slots >= 0
    # For each ray, the body in the slot of its sector's list.
    sectors = jnp.arange(best.slots.shape[0])[:, None]
    body = jax.tree.map(lambda x: x[sectors, jnp.maximum(best.slots, 0)], bodies)
    face = recess(jnp.where(is_met, best.ranges, 0.0), rays.directions, body)
    is_soft = body.softness > 0
    surfaces = jnp.where(body.index >= num_standing, MOVING, jnp.where(is_soft, SOFT, SOLID))
    return Hits(
        ranges=jnp.where(is_met, face.ranges, jnp.inf),
        cosines=jnp.where(is_soft, 1.0, face.cosines),
        surfaces=jnp.where(is_met, surfaces, NOTHING),
        is_glass=face.is_glass & is_met,
    )


def _round_hits(bodies: Bodies, rays: Rays, cross: Callable[[Array, Hull], Crossing], surface: int) -> Hits:
    """Poles and tufts: small or rough, the angle of the surface does not count."""
    best = _first(bodies, rays, cross)
    return Hits(
        ranges=best.ranges,
        cosines=jnp.ones_like(best.ranges),
        surfaces=jnp.where(best.slots >= 0, surface, NOTHING),
        is_glass=jnp.zeros(best.slots.shape, bool),
    )


def _ground_hits(town: TownPrimitives, start: Float[Array, " 3"], rays: Rays, max_range: float) -> Hits:
    ranges = cross_ground(town.ground, start, rays.directions, max_range)
    return Hits(
        ranges=ranges,
        cosines=jnp.abs(rays.directions[..., 2]),
        surfaces=jnp.where(jnp.isfinite(ranges), GROUND, NOTHING),
        is_glass=jnp.zeros(ranges.shape, bool),
    )
