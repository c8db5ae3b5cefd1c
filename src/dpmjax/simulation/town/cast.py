"""The ray caster: first hits of the rays of a turn among the bodies of each sector and the ground.

A scan of 100,000 rays against 30,000 boxes would need 3e9 tests. The nearest bodies are selected once for each scan,
and each sector of some degrees has a list of them, nearest first. A band of rays is tested against its list until all
its hits are nearer than the remaining bodies.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.simulation.town.culling import NUM_IN_SECTOR, NearBodies, NearWorld, SectorLists, sector_lists
from dpmjax.simulation.town.intersect import Cross, cross_box, cross_cylinder, cross_ground, cross_spheroid, recess
from dpmjax.simulation.town.primitives import GROUND, NOTHING, Bodies

_KINDS: tuple[Cross, ...] = (cross_box, cross_cylinder, cross_spheroid)
# A band of rays is tested against this number of bodies between two checks of the loop condition.
_AT_ONCE = 2
_ON_NOTHING, _ON_GROUND = -2, -1


class Hits(NamedTuple):
    """First hits of the rays of a turn: s sectors of g bands of c columns of b beams.

    Attributes:
        ranges: m; infinite for nothing.
        cosines: of the angle between the ray and the surface's normal; 1 for foliage.
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
        rays: by sector.
        max_range: m.

    Returns:
        The hits, by sector.
    """
    turn, highest = T_world_lidar[:3, :3], jax.lax.Precision.HIGHEST
    turns = jnp.einsum("ij,sjk->sik", turn, rays.T_lidar_sector[:, :3, :3], precision=highest)
    offsets = jnp.einsum("ij,sj->si", turn, rays.T_lidar_sector[:, :3, 3], precision=highest)
    directions = jnp.einsum("sij,sgcbj->sgcbi", turns, rays.directions, precision=highest)
    kinds = (near.boxes, near.cylinders, near.spheroids)
    way = jnp.linalg.norm(offsets, axis=-1).max()
    lists = tuple(
        sector_lists(kind, T_world_lidar, rays.azimuths, capacity, way)
        for kind, capacity in zip(kinds, NUM_IN_SECTOR, strict=True)
    )
    repeated = jax.tree.map(lambda x: jnp.repeat(x, directions.shape[1], axis=0), (offsets, lists))
    directions, depths = (x.reshape(-1, *x.shape[2:]) for x in (directions, rays.depths))
    bands = _Band(directions, depths, *repeated)
    bodies = jax.tree.map(lambda *x: jnp.concatenate(x), *(kind.bodies for kind in kinds))

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
    kinds = (near.boxes, near.cylinders, near.spheroids)
    for kind, lists, cross in zip(kinds, band.lists, _KINDS, strict=True):
        found = _meet_bodies(found, kind, lists, band, cross, first_row)
        first_row += len(kind.distances)
    return _describe(found, bodies, band, len(near.boxes.distances))


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
