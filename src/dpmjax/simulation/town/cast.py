"""The ray caster: what each ray of a turn meets first, among the bodies of its sector and the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dpmjax.simulation.town.ground import cross_ground
from dpmjax.simulation.town.intersect import Crossing, cross_box, cross_cylinder, cross_spheroid
from dpmjax.simulation.town.primitives import TownPrimitives
from dpmjax.simulation.town.sectors import Bodies, bodies_by_sector, nearest_bodies
from dpmjax.simulation.town.traffic import traffic_boxes
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
        max_sectors: the turn is cut into so many sectors at most.
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
    """What the rays meet, (s, r): r rays in each of s sectors.

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


class _Best(NamedTuple):
    """The nearest meeting so far: range, and slot in the sector's list (-1: none)."""

    ranges: Float[Array, "s r"]
    slots: Int[Array, "s r"]


def num_sectors(num_azimuths: int, max_sectors: int) -> int:
    """The largest number of equal sectors of whole columns.

    Args:
        num_azimuths: columns in a turn.
        max_sectors: upper limit.

    Returns:
        A divisor of `num_azimuths`.
    """
    return max(count for count in range(1, max_sectors + 1) if num_azimuths % count == 0)


def cast_turn(
    town: TownPrimitives,
    T_world_lidar: Float[Array, "4 4"],
    time: Float[Array, ""],
    directions: Float[Array, "s r 3"],
    sector_azimuths: Float[Array, " s"],
    sector_half_width: float,
    depths: Float[Array, "s r"],
    *,
    max_range: float,
    config: CastConfig,
) -> Hits:
    """Follows all rays of a turn.

    Args:
        town: the world.
        T_world_lidar: pose of the sensor.
        time: s, for the traffic.
        directions: unit directions in axes of the world, by sector.
        sector_azimuths: middle of each sector in the sensor frame, radians.
        sector_half_width: radians.
        depths: for each ray, how many mean ways it goes into what is soft.
        max_range: m.
        config: capacities.

    Returns:
        The hits.
    """
    start = T_world_lidar[:3, 3]
    T_lidar_world = jnp.zeros((4, 4), T_world_lidar.dtype).at[:3, :3].set(T_world_lidar[:3, :3].T).at[3, 3].set(1.0)

    def in_sectors(bodies: Bodies, num_nearest: int, capacity: int) -> Bodies:
        near = nearest_bodies(bodies, num_nearest, max_range)
        return bodies_by_sector(near, T_lidar_world, sector_azimuths, sector_half_width, capacity)

    boxes = in_sectors(_boxes(town, start, time), config.num_boxes, config.boxes_per_sector)
    cylinders = in_sectors(_cylinders(town, start), config.num_cylinders, config.cylinders_per_sector)
    spheroids = in_sectors(_spheroids(town, start), config.num_spheroids, config.spheroids_per_sector)
    hits = _box_hits(boxes, directions, depths, len(town.boxes.mask))
    hits = _nearer(hits, _round_hits(cylinders, directions, depths, _cross_cylinder, POLE))
    hits = _nearer(hits, _round_hits(spheroids, directions, depths, _cross_spheroid, SOFT))
    hits = _nearer(hits, _ground_hits(town, start, directions, max_range))
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
    return Bodies(
        centres=both.centres - start,
        half_sizes=both.half_sizes,
        headings=both.headings,
        softness=both.softness,
        window_depth=both.window_depth,
        index=jnp.arange(len(both.mask)),
        mask=both.mask,
    )


def _upright(
    centres: Float[Array, "n 3"],
    radii: Float[Array, " n"],
    half_heights: Float[Array, " n"],
    softness: Array,
    mask: Array,
) -> Bodies:
    """Round bodies by the boxes round them."""
    zero = jnp.zeros_like(radii)
    return Bodies(
        centres=centres,
        half_sizes=jnp.stack([radii, radii, half_heights], axis=-1),
        headings=jnp.stack([zero + 1.0, zero], axis=-1),
        softness=softness,
        window_depth=zero,
        index=jnp.arange(len(mask)),
        mask=mask,
    )


def _cylinders(town: TownPrimitives, start: Float[Array, " 3"]) -> Bodies:
    poles = town.cylinders
    return _upright(poles.centres - start, poles.radii, poles.half_heights, jnp.zeros_like(poles.radii), poles.mask)


def _spheroids(town: TownPrimitives, start: Float[Array, " 3"]) -> Bodies:
    tufts = town.spheroids
    return _upright(tufts.centres - start, tufts.radii, tufts.half_heights, tufts.softness, tufts.mask)


def _cross_box(direction: Array, body: Bodies) -> Crossing:
    return cross_box(direction, body.centres, body.half_sizes, body.headings)


def _cross_cylinder(direction: Array, body: Bodies) -> Crossing:
    return cross_cylinder(direction, body.centres, body.half_sizes[..., 0], body.half_sizes[..., 2])


def _cross_spheroid(direction: Array, body: Bodies) -> Crossing:
    return cross_spheroid(direction, body.centres, body.half_sizes[..., 0], body.half_sizes[..., 2])


def _first(
    bodies: Bodies, directions: Float[Array, "s r 3"], depths: Float[Array, "s r"], cross: Callable[..., Crossing]
) -> _Best:
    """The first body of each ray: one slot of the lists after the other, all rays at once."""

    def meet(best: _Best, entry: tuple[Array, Bodies]) -> tuple[_Best, None]:
        slot, column = entry
        body = jax.tree.map(lambda x: x[:, None], column)
        crossing = cross(directions, body)
        distance = crossing.entry + body.softness * depths
        is_met = body.mask & (crossing.entry > 0) & (distance <= crossing.exit) & (distance < best.ranges)
        return _Best(jnp.where(is_met, distance, best.ranges), jnp.where(is_met, slot, best.slots)), None

    columns = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), bodies)
    nothing = _Best(jnp.full(depths.shape, jnp.inf, depths.dtype), jnp.full(depths.shape, -1))
    best, _ = jax.lax.scan(meet, nothing, (jnp.arange(bodies.mask.shape[1]), columns))
    return best


def _met(bodies: Bodies, slots: Int[Array, "s r"]) -> Bodies:
    """For each ray, the body in the slot of its sector's list."""
    sectors = jnp.arange(slots.shape[0])[:, None]
    return jax.tree.map(lambda x: x[sectors, jnp.maximum(slots, 0)], bodies)


def _box_hits(
    bodies: Bodies, directions: Float[Array, "s r 3"], depths: Float[Array, "s r"], num_standing: int
) -> Hits:
    best = _first(bodies, directions, depths, _cross_box)
    body = _met(bodies, best.slots)
    is_met = best.slots >= 0
    face = recess(jnp.where(is_met, best.ranges, 0.0), directions, body)
    is_soft = body.softness > 0
    surfaces = jnp.where(body.index >= num_standing, MOVING, jnp.where(is_soft, SOFT, SOLID))
    return Hits(
        ranges=jnp.where(is_met, face.ranges, jnp.inf),
        cosines=jnp.where(is_soft, 1.0, face.cosines),
        surfaces=jnp.where(is_met, surfaces, NOTHING),
        is_glass=face.is_glass & is_met,
    )


def _round_hits(
    bodies: Bodies,
    directions: Float[Array, "s r 3"],
    depths: Float[Array, "s r"],
    cross: Callable[..., Crossing],
    surface: int,
) -> Hits:
    """Poles and tufts: small or rough, the angle of the surface does not count."""
    best = _first(bodies, directions, depths, cross)
    return Hits(
        ranges=best.ranges,
        cosines=jnp.ones_like(best.ranges),
        surfaces=jnp.where(best.slots >= 0, surface, NOTHING),
        is_glass=jnp.zeros(best.slots.shape, bool),
    )


def _ground_hits(
    town: TownPrimitives, start: Float[Array, " 3"], directions: Float[Array, "s r 3"], max_range: float
) -> Hits:
    ranges = cross_ground(town.ground, start, directions, max_range)
    return Hits(
        ranges=ranges,
        cosines=jnp.abs(directions[..., 2]),
        surfaces=jnp.where(jnp.isfinite(ranges), GROUND, NOTHING),
        is_glass=jnp.zeros(ranges.shape, bool),
    )
