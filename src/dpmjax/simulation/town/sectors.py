"""Which bodies a ray can meet at all: the nearest ones, and of these the ones in the ray's own sector of the turn.

A scan of 100,000 rays against 30,000 boxes would be 3e9 tests. The nearest thousand boxes are picked once a scan, and
each sector of some degrees gets its own short list of them, nearest first: 100 tests a ray are left. Bodies beyond a
capacity are the farthest ones.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.geometry import rigid

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)


@flax.struct.dataclass
class Bodies:
    """Bodies of one kind near the sensor, by the boxes round them, in axes of the world with the sensor as origin.

    Attributes:
        centres: relative to the sensor, m.
        half_sizes: of the box round the body, m.
        headings: cosine and sine of the box's turn about z.
        softness: mean way into the body, m.
        window_depth: m.
        index: which body of the town this is.
        mask: which entries exist.
    """

    centres: Float[Array, "k 3"]
    half_sizes: Float[Array, "k 3"]
    headings: Float[Array, "k 2"]
    softness: Float[Array, " k"]
    window_depth: Float[Array, " k"]
    index: Int[Array, " k"]
    mask: Bool[Array, " k"]


def nearest_bodies(bodies: Bodies, capacity: int, max_range: float) -> Bodies:
    """The bodies with the nearest surfaces.

    Args:
        bodies: all of the town, relative to the sensor.
        capacity: how many to keep at most.
        max_range: bodies beyond this are left out, m.

    Returns:
        The nearest bodies, nearest first.
    """
    outside = jnp.maximum(jnp.abs(_to_box(bodies)) - bodies.half_sizes, 0.0)
    squared = jnp.where(bodies.mask, (outside**2).sum(-1), jnp.inf)
    best, order = jax.lax.top_k(-squared, min(capacity, len(squared)))
    kept = jax.tree.map(lambda x: x[order], bodies)
    return kept.replace(mask=best >= -(max_range**2))


def _to_box(bodies: Bodies) -> Float[Array, "k 3"]:
    """The sensor in each box's own axes."""
    cos, sin = bodies.headings[:, 0], bodies.headings[:, 1]
    x, y, z = -bodies.centres[:, 0], -bodies.centres[:, 1], -bodies.centres[:, 2]
    return jnp.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)


def azimuth_intervals(
    bodies: Bodies, T_lidar_world: Float[Array, "4 4"]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """The azimuths under which the boxes are seen, in the sensor frame.

    A box is the hull of its corners, and so is its shadow on the sensor's x-y plane. Where that shadow holds the
    sensor, the interval is the whole turn.

    Args:
        bodies: relative to the sensor, in axes of the world.
        T_lidar_world: only its rotation counts.

    Returns:
        Middle and half-width of each interval, radians; half-width pi for all directions.
    """
    turn = T_lidar_world.at[:3, 3].set(0.0)
    local = _CORNERS[None] * bodies.half_sizes[:, None]
    cos, sin = bodies.headings[:, None, 0], bodies.headings[:, None, 1]
    turned = jnp.stack(
        [cos * local[..., 0] - sin * local[..., 1], sin * local[..., 0] + cos * local[..., 1], local[..., 2]], axis=-1
    )
    corners = rigid.transform_points(turn, (bodies.centres[:, None] + turned).reshape(-1, 3)).reshape(turned.shape)
    middle = rigid.transform_points(turn, bodies.centres)
    towards = jnp.arctan2(middle[:, 1], middle[:, 0])
    azimuth = wrap(jnp.arctan2(corners[..., 1], corners[..., 0]) - towards[:, None])
    low, high = azimuth.min(-1), azimuth.max(-1)
    half_width = jnp.where(high - low < np.pi, 0.5 * (high - low), np.pi)
    return wrap(towards + 0.5 * (low + high)), half_width


def wrap(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """The angle in [-pi, pi)."""
    return jnp.mod(angle + np.pi, 2 * np.pi) - np.pi


def bodies_by_sector(
    bodies: Bodies,
    T_lidar_world: Float[Array, "4 4"],
    sector_azimuths: Float[Array, " s"],
    sector_half_width: float,
    capacity: int,
) -> Bodies:
    """Gives each sector its own list of bodies, in the order of the bodies.

    Args:
        bodies: nearest first, relative to the sensor.
        T_lidar_world: only its rotation counts.
        sector_azimuths: middle of each sector in the sensor frame, radians.
        sector_half_width: radians.
        capacity: how many bodies a sector holds.

    Returns:
        Bodies with arrays (s, capacity, ...).
    """
    middle, half_width = azimuth_intervals(bodies, T_lidar_world)
    apart = jnp.abs(wrap(middle[None] - sector_azimuths[:, None]))
    is_seen = bodies.mask[None] & (apart <= half_width[None] + sector_half_width)
    place = jnp.cumsum(is_seen, axis=1) - 1
    slot = jnp.where(is_seen & (place < capacity), place, capacity)
    rows = jnp.arange(len(sector_azimuths))[:, None]
    entries = jnp.broadcast_to(jnp.arange(len(bodies.mask)), slot.shape)
    chosen = jnp.full((len(sector_azimuths), capacity + 1), -1).at[rows, slot].set(entries)[:, :capacity]
    listed = jax.tree.map(lambda x: x[chosen], bodies)
    return listed.replace(mask=chosen >= 0)
