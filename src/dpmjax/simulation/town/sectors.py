"""Which bodies a ray can meet: the nearest ones, and of these the ones in the ray's sector of the turn.

A scan of 100,000 rays against 30,000 boxes would need 3e9 tests. The nearest thousand boxes are picked once a scan, and
each sector of some degrees gets a short list of them, nearest first: 100 tests a ray remain. Where a list is full, the
farthest bodies are missing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.geometry import rigid, se2
from dpmjax.simulation.town.intersect import turn_back
from dpmjax.simulation.town.primitives import Bodies

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)


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
    return kept.replace(mask=best >= -(max_range**2))


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
    return listed.replace(mask=chosen >= 0)
