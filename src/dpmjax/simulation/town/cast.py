"""The ray caster: first hits of the rays of a turn among the bodies near the sensor and the ground.

A scan of 100,000 rays against 30,000 boxes would need 3e9 tests. The nearest bodies are selected once for each scan,
and each sector of some degrees has a list of them, nearest first. A band of rays is tested against its list until all
its hits are nearer than the remaining bodies. The selection has the same shapes in every world, so that the ray caster
compiles once for each sensor.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.geometry import rigid, se2
from dpmjax.simulation.town.intersect import Cross, cross_box, cross_cylinder, cross_ground, cross_spheroid, recess
from dpmjax.simulation.town.primitives import (
    CELL_M,
    GROUND,
    NOTHING,
    Bodies,
    Ground,
    TownPrimitives,
    traffic_boxes,
    turn_back,
)

# Side of the square of ground around the sensor; the heights of its border hold outside.
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
_KINDS: tuple[Cross, ...] = (cross_box, cross_cylinder, cross_spheroid)
# A band of rays is tested against this number of bodies between two checks of the loop condition.
_AT_ONCE = 2
_ON_NOTHING, _ON_GROUND = -2, -1


class NearBodies(NamedTuple):
    """Bodies of one kind that lie near the sensor, nearest first.

    Attributes:
        bodies: bodies, relative to the sensor.
        distances: lower bounds of the distances from the sensor to the surfaces, m; ascending, infinite for padding.
    """

    bodies: Bodies
    distances: Float[Array, " n"]


class NearWorld(NamedTuple):
    """Bodies and ground near the sensor.

    Attributes:
        kinds: nearest boxes, those of the traffic among them, nearest cylinders, and nearest spheroids.
        ground: a square of ground, its origin relative to the sensor; heights are those of the world.
    """

    kinds: tuple[NearBodies, ...]
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
        time: time of the traffic, s.
        max_range: bodies beyond this range are left out, m.

    Returns:
        Bodies and ground near the sensor, in the same shapes for every town.
    """
    boxes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), town.boxes, traffic_boxes(town.traffic, start, time))
    # The nearest boxes, cylinders and spheroids of a scan.
    kinds = zip((boxes, town.cylinders, town.spheroids), (1024, 512, 2048), strict=True)
    near = (_nearest_bodies(x._replace(centres=x.centres - start), number, max_range) for x, number in kinds)
    return NearWorld(tuple(near), _near_ground(town.ground, start))


def _near_ground(ground: Ground, start: Float[Array, " 3"]) -> Ground:
    # The heights of the border of the square hold outside.
    count = round(168 / CELL_M) + 1
    heights = jnp.pad(ground.heights, [(0, max(count - size, 0)) for size in ground.heights.shape], mode="edge")
    corner = jnp.round((start[:2] - ground.origin) / ground.cell - 0.5 * count).astype(jnp.int32)
    corner = jnp.clip(corner, 0, jnp.array([heights.shape[1] - count, heights.shape[0] - count]))
    part = jax.lax.dynamic_slice(heights, (corner[1], corner[0]), (count, count))
    return Ground(part, ground.origin + corner * ground.cell - start[:2], ground.cell)


def _nearest_bodies(bodies: Bodies, capacity: int, max_range: float) -> NearBodies:
    """Selects the bodies with the nearest surfaces.

    Args:
        bodies: all bodies of the town, relative to the sensor.
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


def _sector_lists(
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


class Hits(NamedTuple):
    """First hits of the rays of a turn: s sectors of g bands of c columns of b beams.

    Attributes:
        ranges: m; infinite without a hit.
        cosines: cosine of the angle between the ray and the surface's normal; 1 for foliage.
        surfaces: NOTHING, GROUND, SOLID, SOFT, POLE or MOVING.
        is_glass: True in windows.
    """

    ranges: Float[Array, "*s g c b"]
    cosines: Float[Array, "*s g c b"]
    surfaces: Int[Array, "*s g c b"]
    is_glass: Bool[Array, "*s g c b"]


class Rays(NamedTuple):
    """The rays of a turn: s equal sectors of g bands of elevation, each of c columns of b beams.

    Attributes:
        directions: unit directions in the sensor frame at the time of the sector.
        azimuths: middle of each sector, radians.
        depths: optical depth at which each ray is reflected in foliage.
        T_lidar_sector: pose of the sensor at the time of each sector, in its frame at the time of the scan.
    """

    directions: Float[Array, "s g c b 3"]
    azimuths: Float[Array, " s"]
    depths: Float[Array, "s g c b"]
    T_lidar_sector: Float[Array, "s 4 4"]


class _Band(NamedTuple):
    """Rays with a common origin, in axes of the world, and the bodies of their sector."""

    directions: Float[Array, "n c b 3"]
    depths: Float[Array, "n c b"]
    offset: Float[Array, "n 3"]
    lists: tuple[SectorLists, ...]


class _Found(NamedTuple):
    """First hits so far: range, row of the body (of all kinds together) and remaining optical depth."""

    ranges: Float[Array, "c b"]
    rows: Int[Array, "c b"]
    depths: Float[Array, "c b"]


def cast_turn(near: NearWorld, T_world_lidar: Float[Array, "4 4"], rays: Rays, *, max_range: float) -> Hits:
    """Casts all rays of a turn to their first hits, without noise and loss.

    Args:
        near: bodies and ground near the sensor.
        T_world_lidar: pose of the sensor.
        rays: rays by sector.
        max_range: largest range, m.

    Returns:
        The hits, by sector.
    """
    turn, highest = T_world_lidar[:3, :3], jax.lax.Precision.HIGHEST
    turns = jnp.einsum("ij,sjk->sik", turn, rays.T_lidar_sector[:, :3, :3], precision=highest)
    offsets = jnp.einsum("ij,sj->si", turn, rays.T_lidar_sector[:, :3, 3], precision=highest)
    directions = jnp.einsum("sij,sgcbj->sgcbi", turns, rays.directions, precision=highest)
    way = jnp.linalg.norm(offsets, axis=-1).max()
    # Those of one sector of the turn.
    lists = tuple(
        _sector_lists(kind, T_world_lidar, rays.azimuths, capacity, way)
        for kind, capacity in zip(near.kinds, (96, 48, 160), strict=True)
    )
    repeated = jax.tree.map(lambda x: jnp.repeat(x, directions.shape[1], axis=0), (offsets, lists))
    directions, depths = (x.reshape(-1, *x.shape[2:]) for x in (directions, rays.depths))
    bands = _Band(directions, depths, *repeated)
    bodies = jax.tree.map(lambda *x: jnp.concatenate(x), *(kind.bodies for kind in near.kinds))

    def cast_band(band: _Band) -> Hits:
        return _cast_band(near, bodies, T_world_lidar[2, 3], band, max_range)

    # On a CPU, a single band ends early and stays in the cache; a GPU takes all bands at once.
    hits = jax.lax.platform_dependent(bands, cpu=partial(jax.lax.map, cast_band), default=jax.vmap(cast_band))
    return jax.tree.map(lambda x: x.reshape(rays.depths.shape), hits)


def _cast_band(near: NearWorld, bodies: Bodies, height: Float[Array, ""], band: _Band, max_range: float) -> Hits:
    """Finds the first hits of the rays of a band; `height` is the sensor's, `bodies` those of all kinds."""
    down = cross_ground(near.ground, band.offset.at[2].add(height), band.directions, max_range)
    is_down = down <= max_range
    rows = jnp.where(is_down, _ON_GROUND, _ON_NOTHING)
    found = _Found(jnp.where(is_down, down, max_range), rows, band.depths)
    first_row = 0
    for kind, lists, cross in zip(near.kinds, band.lists, _KINDS, strict=True):
        found = _meet_bodies(found, kind, lists, band, cross, first_row)
        first_row += len(kind.distances)
    return _describe(found, bodies, band, len(near.kinds[0].distances))


def _meet_bodies(
    found: _Found, kind: NearBodies, lists: SectorLists, band: _Band, cross: Cross, first_row: int
) -> _Found:
    """Tests the rays against the bodies of one kind, nearest first, until none can be nearer than the hits so far."""
    reach = jnp.linalg.norm(band.offset)

    def is_open(carry: tuple[Array, _Found]) -> Array:
        slot, found = carry
        nearest = kind.distances[lists.rows[jnp.minimum(slot, len(lists.rows) - 1)]] - reach
        return (slot < lists.counts) & (nearest < found.ranges.max())

    def meet(carry: tuple[Array, _Found]) -> tuple[Array, _Found]:
        slot, found = carry
        for ahead in range(_AT_ONCE):
            row = lists.rows[jnp.minimum(slot + ahead, len(lists.rows) - 1)]
            body = jax.tree.map(lambda x, row=row: x[row], kind.bodies)
            crossing = cross(band.directions, body._replace(centres=body.centres - band.offset))
            thickness = (crossing.exit - crossing.entry) / jnp.maximum(body.softness, 1e-6)
            is_crossed = (slot + ahead < lists.counts) & (crossing.entry > 0) & (crossing.entry <= crossing.exit)
            distance = crossing.entry + body.softness * found.depths
            is_met = is_crossed & (found.depths * (body.softness > 0) <= thickness) & (distance < found.ranges)
            is_passed = is_crossed & ~is_met & (crossing.exit < found.ranges)
            depths = jnp.where(is_passed, found.depths - thickness, found.depths)
            ranges = jnp.where(is_met, distance, found.ranges)
            found = _Found(ranges, jnp.where(is_met, first_row + row, found.rows), depths)
        return slot + _AT_ONCE, found

    return jax.lax.while_loop(is_open, meet, (jnp.zeros((), jnp.int32), found))[1]


def _describe(found: _Found, bodies: Bodies, band: _Band, num_boxes: int) -> Hits:
    """Computes ranges, incidence cosines and surfaces of the hits, with windows of boxes."""
    is_body = found.rows >= 0
    body = jax.tree.map(lambda x: x[jnp.maximum(found.rows, 0)], bodies)
    body = body._replace(centres=body.centres - band.offset)
    deeper, cosines, is_glass = recess(found.ranges, band.directions, body)
    is_face = is_body & (found.rows < num_boxes) & (body.softness == 0)
    on_ground = jnp.where(found.rows == _ON_GROUND, jnp.abs(band.directions[..., 2]), 1.0)
    ranges = jnp.where(is_face, deeper, jnp.where(found.rows == _ON_NOTHING, jnp.inf, found.ranges))
    surfaces = jnp.where(is_body, body.surface, jnp.where(found.rows == _ON_GROUND, GROUND, NOTHING))
    return Hits(ranges, jnp.where(is_face, cosines, on_ground), surfaces, is_glass & is_face)
