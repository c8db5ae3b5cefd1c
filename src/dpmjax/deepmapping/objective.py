"""Terms of DeepMapping's loss for scans in the world frame (sections 3.2 and 3.4).

`occupancy_term` compares M-Net with the hits (occupied) and with samples on the beams (free). `chamfer_term` compares
each scan with later ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.config import CHAMFER, ChamferComparison, Comparison, PhaseConfig
from dpmjax.geometry.sampling import sample_free_space
from dpmjax.losses import chamfer_distance, occupancy_loss

MapLogits = Callable[[Float[Array, "n d"]], Float[Array, " n"]]


class WorldBatch(NamedTuple):
    """Scans of one step in the world frame, in the order of time; lengths in typical ranges.

    Attributes:
        points: (m, b, d) hits.
        sensors: (m, d) centres of the sensors.
        mask: (m, b) False for beams that measured nothing.
        rows: (m,) index of each scan in the set; consecutive within a block.
        block: (m,) index of the block of each scan.
        progress: progress of the phase, 0 at its start, 1 at its end.
    """

    points: Float[Array, "m b d"]
    sensors: Float[Array, "m d"]
    mask: Bool[Array, "m b"]
    rows: Int[Array, " m"]
    block: Int[Array, " m"]
    progress: Float[Array, ""]


class Terms(NamedTuple):
    """Terms of the loss before weighting.

    Attributes:
        occupancy: eq. 4, in nats.
        chamfer: eq. 7 divided by the number of pairs, in typical ranges; for images compared by projection, 1 less
            the projective consistency; for clouds compared by planes, the misfit.
    """

    occupancy: Float[Array, ""]
    chamfer: Float[Array, ""]


def interpolate_log(ends: tuple[float, float], progress: Float[Array, ""]) -> Float[Array, ""]:
    """Interpolates between two values linearly in the logarithm.

    Args:
        ends: values at the start and at the end, above 0.
        progress: 0 to 1.

    Returns:
        The value.
    """
    return ends[0] * (ends[1] / ends[0]) ** progress


def free_factors(
    world: WorldBatch, phase: PhaseConfig, surface_distance: Float[Array, ""] | None, *, key: jax.Array
) -> Float[Array, "m b s"]:
    """Draws the positions of the free samples on each beam: 0 at the sensor, 1 at the hit.

    Args:
        world: the scans.
        phase: phase of the fit.
        surface_distance: mean distance of one more sample from the hit; None: no such sample.
        key: key of this step.

    Returns:
        Factors in [0, 1).
    """
    uniform_key, surface_key = jax.random.split(key)
    shape = (*world.mask.shape, phase.num_free)
    if phase.is_sampled_as_published:
        factors = jnp.broadcast_to(jax.random.uniform(uniform_key, shape[2:]), shape)
    else:
        factors = jax.random.uniform(uniform_key, shape)
    if surface_distance is None:
        return factors
    distance = surface_distance * jax.random.uniform(surface_key, world.mask.shape, minval=0.5, maxval=1.5)
    beams = jax.lax.stop_gradient(world.points - world.sensors[:, None])
    ranges = jnp.linalg.norm(jnp.where(world.mask[..., None], beams, 1.0), axis=-1)
    near = jnp.maximum(1.0 - distance / ranges, 0.3)
    return jnp.concatenate([factors, near[..., None]], axis=-1)


def occupancy_term(world: WorldBatch, map_logits: MapLogits, factors: Float[Array, "m b s"]) -> Float[Array, ""]:
    """Computes DeepMapping eq. 4: hits are occupied, samples on the beams are free; both means have the same weight.

    Args:
        world: the scans.
        map_logits: M-Net with its parameters.
        factors: positions of the free samples.

    Returns:
        The binary cross entropy, in nats.
    """
    free = jax.vmap(sample_free_space)(world.sensors, world.points, factors)
    num_hits, dimensions = world.mask.size, world.points.shape[-1]
    logits = map_logits(jnp.concatenate([world.points.reshape(-1, dimensions), free.reshape(-1, dimensions)]))
    weights = world.mask.astype(logits.dtype)
    hit = occupancy_loss(logits[:num_hits], jnp.ones(()), weights.reshape(-1))
    free_weights = jnp.broadcast_to(weights[..., None], factors.shape).reshape(-1)
    return hit + occupancy_loss(logits[num_hits:], jnp.zeros(()), free_weights)


def chamfer_term(world: WorldBatch, offsets: Int[Array, " o"], comparison: Comparison = CHAMFER) -> Float[Array, ""]:
    """Computes DeepMapping eq. 7: mean Chamfer distance of each scan to the scans `offsets` later in the block.

    Args:
        world: the scans.
        offsets: distances in time.
        comparison: comparison of the phase, with its limit of the distances.

    Returns:
        The mean over all pairs, in typical ranges; 0 without a pair.

    Raises:
        ValueError: the comparison is of another type.
    """
    if not isinstance(comparison, ChamferComparison):
        raise ValueError(f"comparison: expected a ChamferComparison of these scans, got {comparison}")
    num_scans = world.rows.shape[0]
    max_distance = None if comparison.limit is None else interpolate_log(comparison.limit, world.progress)

    def compare(offset: Int[Array, ""]) -> tuple[Float[Array, ""], Int[Array, ""]]:
        later = jnp.minimum(jnp.arange(num_scans) + offset, num_scans - 1)
        is_pair = (world.rows[later] == world.rows + offset) & (world.block[later] == world.block)
        distance = jax.vmap(partial(chamfer_distance, max_distance=max_distance))(
            world.points, world.points[later], world.mask, world.mask[later]
        )
        return jnp.sum(jnp.where(is_pair, distance, 0.0)), is_pair.sum()

    totals, counts = jax.vmap(compare)(offsets)
    return totals.sum() / jnp.maximum(counts.sum(), 1)
