"""The scans of a step, and the terms of DeepMapping's loss for them (sections 3.2 to 3.4)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.geometry import se2
from dpmjax.geometry.sampling import sample_free_space
from dpmjax.losses import chamfer_distance, occupancy_loss

# Scans that are drawn together where a set is too large for one step.
_BLOCK = 32


class Batch(NamedTuple):
    """Scans of one step.

    Attributes:
        rows: (w, m) indices of the scans of each block, neighbours in time.
        is_scan: (w, m) False for entries that fill a short last batch.
    """

    rows: Int[Array, "w m"]
    is_scan: Bool[Array, "w m"]


def blocks_of_step(phase: PhaseConfig, num_scans: int, step: Int[Array, ""], *, key: jax.Array) -> Batch:
    """Selects the scans of a step: all windows, or all scans if they are few, else random blocks of neighbours in time.

    Args:
        phase: phase of the fit.
        num_scans: number of scans of the set.
        step: number of steps done in the phase.
        key: key of the step.

    Returns:
        The batch.
    """
    count = phase.scans_per_step
    if phase.scans_per_window is not None:
        rows = jnp.asarray(window_rows(num_scans, phase.scans_per_window))
    elif num_scans <= count:
        rows = jnp.arange(num_scans)[None]
    elif phase.is_as_published:
        # The published order: batches follow each other in time, and the last one is shorter.
        rows = step % num_batches(phase, num_scans) * count + jnp.arange(count)[None]
        return Batch(jnp.minimum(rows, num_scans - 1), rows < num_scans)
    else:
        length = min(_BLOCK, count)
        first = jax.random.randint(key, (count // length, 1), 0, num_scans - length + 1)
        rows = first + jnp.arange(length)
    return Batch(rows, jnp.ones(rows.shape, bool))


def num_batches(phase: PhaseConfig, num_scans: int) -> int:
    """Returns the number of batches that follow each other in time, the steps of an epoch.

    Args:
        phase: phase of the fit.
        num_scans: number of scans of the set.

    Returns:
        The number, at least 1.
    """
    return max(1, -(-num_scans // phase.scans_per_step))


def draw_offsets(phase: PhaseConfig, furthest: int, *, key: jax.Array) -> Int[Array, " o"]:
    """Draws the distances in time of the scans that are compared: always 1, and random others.

    Args:
        phase: phase of the fit; `num_offsets` and `max_offset` are clamped to the available scans.
        furthest: largest available distance.
        key: key of this step.

    Returns:
        Distinct integers, 1 to `furthest`.
    """
    largest = max(1, min(phase.max_offset, furthest))
    count = min(phase.num_offsets, largest) - 1
    if count == largest - 1:
        return jnp.arange(1, largest + 1)
    others = jax.random.choice(key, jnp.arange(2, max(largest, 2) + 1), (count,), replace=False)
    return jnp.concatenate([jnp.ones(1, others.dtype), others])


def window_rows(num_scans: int, scans_per_window: int) -> NDArray[np.intp]:
    """Returns the rows of each window; the last scan of a window is the first of the next one.

    Args:
        num_scans: number of scans of the set, in the order of time.
        scans_per_window: number of scans of a window, at least 2.

    Returns:
        (w, m) indices, where m is the smaller of both numbers. The last window overlaps with the one before, so that
        all have one length.
    """
    length = min(scans_per_window, num_scans)
    count = max(1, -(-(num_scans - 1) // (length - 1))) if length > 1 else 1
    first = np.minimum(np.arange(count) * (length - 1), num_scans - length)
    return first[:, None] + np.arange(length)


def join_windows(poses: Float[Array, "w m 3"], num_scans: int) -> Float[Array, "n 3"]:
    """Joins the poses of the windows in the frame of the first window.

    Args:
        poses: x, y, heading of the scans of each window, in the frame of the window.
        num_scans: number of scans of the set.

    Returns:
        Poses; relative poses within a window are unchanged.
    """
    rows = window_rows(num_scans, poses.shape[1])
    # The last scan of the window before, as an index of this window.
    shared = np.maximum(np.concatenate([rows[:1, 0], rows[:-1, -1]]) - rows[:, 0], 0)
    here = jnp.take_along_axis(poses, jnp.asarray(shared)[:, None, None], axis=1)[:, 0]

    def join(last: Array, window: tuple[Array, Array]) -> tuple[Array, Array]:
        in_window, at_shared = window
        joined = se2.compose(last, se2.relative(at_shared, in_window))
        return joined[-1], joined

    _, joined = jax.lax.scan(join, poses[0, 0], (poses, here))
    window = np.minimum(np.arange(num_scans) // max(rows.shape[1] - 1, 1), len(rows) - 1)
    return joined[window, np.arange(num_scans) - rows[window, 0]]


MapLogits = Callable[[Float[Array, "n d"]], Float[Array, " n"]]


class WorldBatch(NamedTuple):
    """Scans of one step in the world frame, in the order of time; lengths in units of the fit.

    Attributes:
        points: (m, b, d) hits.
        sensors: (m, d) centres of the sensors.
        mask: (m, b) False for beams that measured nothing.
        is_scan: (m,) False for entries that fill a short last batch; they take part in no mean.
        block_length: number of neighbours in time in each block of scans.
        progress: progress of the phase, 0 at its start, 1 at its end.
    """

    points: Float[Array, "m b d"]
    sensors: Float[Array, "m d"]
    mask: Bool[Array, "m b"]
    is_scan: Bool[Array, " m"]
    block_length: int
    progress: Float[Array, ""]


class Terms(NamedTuple):
    """Terms of the loss before weighting.

    Attributes:
        occupancy: eq. 4, in nats.
        chamfer: eq. 7 divided by the number of pairs, in units of the fit; for images compared by projection, 1 less
            the projective consistency.
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


def free_factors(world: WorldBatch, phase: PhaseConfig, *, key: jax.Array) -> Float[Array, "m b s"]:
    """Draws the positions of the free samples on each beam: 0 at the sensor, 1 at the hit.

    Args:
        world: the scans.
        phase: phase of the fit.
        key: key of this step.

    Returns:
        Factors in [0, 1).
    """
    shape = (*world.mask.shape, phase.num_free)
    # One call, because each compiles for a tenth of a second.
    drawn = jax.random.uniform(key, (*world.mask.shape, phase.num_free + (phase.surface_distance is not None)))
    factors = drawn[..., : phase.num_free]
    if phase.is_as_published:
        factors = jnp.broadcast_to(factors[0, 0], shape)
    if phase.surface_distance is None:
        return factors
    distance = interpolate_log(phase.surface_distance, world.progress) * (0.5 + drawn[..., -1])
    beams = jax.lax.stop_gradient(world.points - world.sensors[:, None])
    ranges = jnp.linalg.norm(jnp.where(world.mask[..., None], beams, 1.0), axis=-1)
    near = jnp.maximum(1.0 - distance / ranges, 0.3)
    return jnp.concatenate([factors, near[..., None]], axis=-1)


def occupancy_term(
    world: WorldBatch, map_logits: MapLogits, factors: Float[Array, "m b s"], *, has_equal_scans: bool = False
) -> Float[Array, ""]:
    """Computes DeepMapping eq. 4: hits are occupied, samples on the beams are free; both means have the same weight.

    Args:
        world: the scans.
        map_logits: M-Net with its parameters.
        factors: positions of the free samples.
        has_equal_scans: True for the means of each scan, averaged over the scans, as the equation has it. Otherwise all
            points have the same weight.

    Returns:
        The binary cross entropy, in nats.
    """
    free = jax.vmap(sample_free_space)(world.sensors, world.points, factors)
    num_hits, dimensions = world.mask.size, world.points.shape[-1]
    logits = map_logits(jnp.concatenate([world.points.reshape(-1, dimensions), free.reshape(-1, dimensions)]))
    mask = world.mask & world.is_scan[:, None]
    weights = mask.astype(logits.dtype)
    if has_equal_scans:
        weights /= jnp.maximum(mask.sum(axis=-1, keepdims=True), 1)
    hit = occupancy_loss(logits[:num_hits], jnp.ones(()), weights.reshape(-1))
    free_weights = jnp.broadcast_to(weights[..., None], factors.shape).reshape(-1)
    return hit + occupancy_loss(logits[num_hits:], jnp.zeros(()), free_weights)


def chamfer_term(
    world: WorldBatch, offsets: Int[Array, " o"], limit: tuple[float, float] | None = None
) -> Float[Array, ""]:
    """Computes DeepMapping eq. 7: mean Chamfer distance of each scan to the scans `offsets` later in the block.

    Args:
        world: the scans.
        offsets: distances in time.
        limit: distance to which larger ones are clipped, at the start and at the end of the phase.

    Returns:
        The mean over all pairs, in units of the fit; 0 without a pair.
    """
    num_scans = world.mask.shape[0]
    own = jnp.arange(num_scans)
    max_distance = None if limit is None else interpolate_log(limit, world.progress)

    def compare(offset: Int[Array, ""]) -> tuple[Float[Array, ""], Int[Array, ""]]:
        later = jnp.minimum(own + offset, num_scans - 1)
        is_pair = (own % world.block_length + offset < world.block_length) & world.is_scan[later]
        distance = jax.vmap(partial(chamfer_distance, max_distance=max_distance))(
            world.points, world.points[later], world.mask, world.mask[later]
        )
        return jnp.sum(jnp.where(is_pair, distance, 0.0)), is_pair.sum()

    totals, counts = jax.vmap(compare)(offsets)
    return totals.sum() / jnp.maximum(counts.sum(), 1)
