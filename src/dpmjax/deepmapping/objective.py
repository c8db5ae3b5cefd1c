"""What DeepMapping minimises: gamma BCE + (1 - gamma) Chamfer of scans moved by their poses (section 3.2 and 3.4).

Read aloud: move the scans to the world; ask M-Net what it thinks of the hits (occupied) and of places on the beams
(free); compare each scan with its neighbours in time; weigh and add.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.geometry.rays import sample_free_space
from dpmjax.losses import chamfer_distance, occupancy_loss

MapLogits = Callable[[Float[Array, "n d"]], Float[Array, " n"]]


class Batch(NamedTuple):
    """The scans of one step, neighbours in time side by side.

    Attributes:
        points: (m, b, d) in the sensor frames, in reaches.
        mask: (m, b).
        rows: (m,) which scan each is; consecutive within a block.
        block: (m,) which block each belongs to.
    """

    points: Float[Array, "m b d"]
    mask: Bool[Array, "m b"]
    rows: Int[Array, " m"]
    block: Int[Array, " m"]


class Terms(NamedTuple):
    """The parts of the loss before they are weighted.

    Attributes:
        occupancy: eq. 4, in nats.
        chamfer: eq. 7 divided by the number of pairs, in reaches.
    """

    occupancy: Float[Array, ""]
    chamfer: Float[Array, ""]


def to_world(poses: Float[Array, "m 3"], points: Float[Array, "m b 2"]) -> Float[Array, "m b 2"]:
    """Points of each scan in the world."""
    c, s = jnp.cos(poses[:, 2, None]), jnp.sin(poses[:, 2, None])
    x = c * points[..., 0] - s * points[..., 1] + poses[:, 0, None]
    y = s * points[..., 0] + c * points[..., 1] + poses[:, 1, None]
    return jnp.stack([x, y], axis=-1)


def free_factors(
    batch: Batch, config: PhaseConfig, progress: Float[Array, ""], *, key: jax.Array
) -> Float[Array, "m b s"]:
    """Where on each beam it is asked whether the place is free: 0 the sensor, 1 the hit."""
    uniform_key, surface_key = jax.random.split(key)
    num_scans, num_beams = batch.mask.shape
    if config.is_free_factor_shared:
        factors = jnp.broadcast_to(
            jax.random.uniform(uniform_key, (config.num_free,)), (num_scans, num_beams, config.num_free)
        )
    else:
        factors = jax.random.uniform(uniform_key, (num_scans, num_beams, config.num_free))
    if config.surface_distance is None:
        return factors
    first, last = jnp.log(config.surface_distance[0]), jnp.log(config.surface_distance[1])
    distance = jnp.exp(first + progress * (last - first))
    distance = distance * jax.random.uniform(surface_key, batch.mask.shape, minval=0.5, maxval=1.5)
    reach = jnp.linalg.norm(jnp.where(batch.mask[..., None], batch.points, 1.0), axis=-1)
    near = jnp.maximum(1.0 - distance / reach, 0.3)
    return jnp.concatenate([factors, near[..., None]], axis=-1)


def occupancy_term(
    sensors_world: Float[Array, "m d"],
    points_world: Float[Array, "m b d"],
    batch: Batch,
    map_logits: MapLogits,
    factors: Float[Array, "m b s"],
) -> Float[Array, ""]:
    """DeepMapping eq. 4: hits are occupied, places on the beams are free; both means count alike."""
    free = jax.vmap(sample_free_space)(sensors_world, points_world, factors)
    num_hits, dimensions = batch.mask.size, points_world.shape[-1]
    logits = map_logits(jnp.concatenate([points_world.reshape(-1, dimensions), free.reshape(-1, dimensions)]))
    weights = batch.mask.astype(logits.dtype)
    hit = occupancy_loss(logits[:num_hits], jnp.ones(()), weights.reshape(-1))
    free_weights = jnp.broadcast_to(weights[..., None], factors.shape).reshape(-1)
    return hit + occupancy_loss(logits[num_hits:], jnp.zeros(()), free_weights)


def chamfer_term(
    points_world: Float[Array, "m b d"],
    batch: Batch,
    offsets: Int[Array, " o"],
    max_distance: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """DeepMapping eq. 7: mean Chamfer distance between each scan and the scans `offsets` later in its block."""
    num_scans = batch.rows.shape[0]

    def compare(offset: Int[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        later = jnp.minimum(jnp.arange(num_scans) + offset, num_scans - 1)
        is_pair = (batch.rows[later] == batch.rows + offset) & (batch.block[later] == batch.block)
        distance = jax.vmap(partial(chamfer_distance, max_distance=max_distance))(
            points_world, points_world[later], batch.mask, batch.mask[later]
        )
        return jnp.sum(jnp.where(is_pair, distance, 0.0)), is_pair.sum()

    totals, counts = jax.lax.map(compare, offsets)
    return totals.sum() / jnp.maximum(counts.sum(), 1)


def _chamfer_limit(config: PhaseConfig, progress: Float[Array, ""]) -> Float[Array, ""] | None:
    if config.chamfer_limit is None:
        return None
    first, last = jnp.log(config.chamfer_limit[0]), jnp.log(config.chamfer_limit[1])
    return jnp.exp(first + progress * (last - first))


def registration_loss(
    poses: Float[Array, "m 3"],
    batch: Batch,
    map_logits: MapLogits,
    config: PhaseConfig,
    progress: Float[Array, ""],
    *,
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """DeepMapping eq. 6 in the convex form gamma BCE + (1 - gamma) Chamfer.

    Args:
        poses: (m, 3) x, y, heading of the scans of the batch in the world, in reaches and radians.
        batch: the scans.
        map_logits: M-Net with its parameters.
        config: of the phase.
        progress: 0 at the start of the phase, 1 at its end.
        key: of this step.

    Returns:
        The loss, and its terms before weighting.
    """
    return world_loss(poses[:, :2], to_world(poses, batch.points), batch, map_logits, config, progress, key=key)


def world_loss(
    sensors_world: Float[Array, "m d"],
    points_world: Float[Array, "m b d"],
    batch: Batch,
    map_logits: MapLogits,
    config: PhaseConfig,
    progress: Float[Array, ""],
    *,
    key: jax.Array,
) -> tuple[Float[Array, ""], Terms]:
    """The same of scans that are in the world already, planar or spatial: `sensors_world` are their centres."""
    free_key, offset_key = jax.random.split(key)
    others = jax.random.choice(
        offset_key, jnp.arange(2, config.max_offset + 1), (config.num_offsets - 1,), replace=False
    )
    offsets = jnp.concatenate([jnp.ones(1, others.dtype), others])
    chamfer = chamfer_term(points_world, batch, offsets, _chamfer_limit(config, progress))
    gamma = config.occupancy_weight
    if gamma == 0.0:
        return chamfer, Terms(jnp.zeros(()), chamfer)
    factors = free_factors(batch, config, progress, key=free_key)
    occupancy = occupancy_term(sensors_world, points_world, batch, map_logits, factors)
    return gamma * occupancy + (1.0 - gamma) * chamfer, Terms(occupancy, chamfer)
