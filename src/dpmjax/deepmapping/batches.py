"""Which scans a step sees, and at which distances in time they are compared."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.deepmapping.windows import window_rows

# Scans that are drawn together where a set is too large for one step.
_BLOCK = 32


def scans_in_block(phase: PhaseConfig, num_scans: int) -> int:
    """Neighbours in time that a step sees together.

    Args:
        phase: of the fit.
        num_scans: of the set.

    Returns:
        Their number.
    """
    if phase.scans_per_window is not None:
        return min(num_scans, phase.scans_per_window)
    if num_scans <= phase.scans_per_step:
        return num_scans
    return phase.scans_per_step if phase.is_free_factor_shared else _BLOCK


def draw_rows(
    phase: PhaseConfig, num_scans: int, step: Int[Array, ""], *, key: jax.Array
) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
    """Scans of a step: all windows, or all scans where they are few enough, else blocks of neighbours in time.

    Args:
        phase: of the fit.
        num_scans: of the set.
        step: steps done in the phase.
        key: of the step.

    Returns:
        Index of each scan in the set, and the block it belongs to.
    """
    if phase.scans_per_window is not None:
        rows = window_rows(num_scans, phase.scans_per_window)
        return jnp.asarray(rows.reshape(-1)), jnp.repeat(jnp.arange(len(rows)), rows.shape[1])
    if num_scans <= phase.scans_per_step:
        return jnp.arange(num_scans), jnp.zeros(num_scans, jnp.int32)
    if phase.is_free_factor_shared:
        # The published order: batches follow each other in time, none is mixed.
        # The last one reaches back, so that it is as long as the others and no scan is left out.
        first = step % -(-num_scans // phase.scans_per_step) * phase.scans_per_step
        first = jnp.minimum(first, num_scans - phase.scans_per_step)
        return first + jnp.arange(phase.scans_per_step), jnp.zeros(phase.scans_per_step, jnp.int32)
    num_blocks = phase.scans_per_step // _BLOCK
    first = jax.random.randint(key, (num_blocks, 1), 0, num_scans - _BLOCK + 1)
    return (first + jnp.arange(_BLOCK)).reshape(-1), jnp.repeat(jnp.arange(num_blocks), _BLOCK)


def draw_offsets(phase: PhaseConfig, furthest: int, *, key: jax.Array) -> Int[Array, " o"]:
    """Distances in time of the scans that are compared: 1, so that neighbours always meet, and others at random.

    Args:
        phase: of the fit; `num_offsets` and `max_offset` are clamped to what there is.
        furthest: the largest distance that there is.
        key: of this step.

    Returns:
        Different whole numbers, 1 to `furthest`.
    """
    largest = max(1, min(phase.max_offset, furthest))
    count = min(phase.num_offsets, largest) - 1
    others = jax.random.choice(key, jnp.arange(2, max(largest, 2) + 1), (count,), replace=False)
    return jnp.concatenate([jnp.ones(1, others.dtype), others])
