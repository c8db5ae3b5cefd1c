"""Scans of an optimisation step: all scans, blocks of neighbours in time, or windows that share one scan.

Windows are registered independently and joined at their shared scans. Within a window all scans are near the first one,
so that zero poses are in the basin of convergence of the Chamfer distance. Over a whole trajectory L-Net would have to
separate all scans at once, and may put two similar rooms on top of each other.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.geometry import se2

# Scans that are drawn together where a set is too large for one step.
_BLOCK = 32


def scans_in_block(phase: PhaseConfig, num_scans: int) -> int:
    """Returns the number of neighbours in time in one block of a step.

    Args:
        phase: phase of the fit.
        num_scans: number of scans of the set.

    Returns:
        Number of scans.
    """
    if phase.scans_per_window is not None:
        return min(num_scans, phase.scans_per_window)
    if num_scans <= phase.scans_per_step:
        return num_scans
    return phase.scans_per_step if phase.is_sampled_as_published else _BLOCK


def scans_of_step(
    phase: PhaseConfig, num_scans: int, step: Int[Array, ""], *, key: jax.Array
) -> tuple[Int[Array, " m"], Int[Array, " m"]]:
    """Selects the scans of a step: all windows, or all scans if they are few, else random blocks of neighbours in time.

    Args:
        phase: phase of the fit.
        num_scans: number of scans of the set.
        step: number of steps done in the phase.
        key: key of the step.

    Returns:
        Index of each scan in the set, and index of its block.
    """
    if phase.scans_per_window is not None:
        rows = window_rows(num_scans, phase.scans_per_window)
        return jnp.asarray(rows.reshape(-1)), jnp.repeat(jnp.arange(len(rows)), rows.shape[1])
    if num_scans <= phase.scans_per_step:
        return jnp.arange(num_scans), jnp.zeros(num_scans, jnp.int32)
    if phase.is_sampled_as_published:
        # The published order: batches follow each other in time. The last batch overlaps with the one before, so that
        # all have one length and no scan is left out.
        first = step % -(-num_scans // phase.scans_per_step) * phase.scans_per_step
        first = jnp.minimum(first, num_scans - phase.scans_per_step)
        return first + jnp.arange(phase.scans_per_step), jnp.zeros(phase.scans_per_step, jnp.int32)
    num_blocks = phase.scans_per_step // _BLOCK
    first = jax.random.randint(key, (num_blocks, 1), 0, num_scans - _BLOCK + 1)
    return (first + jnp.arange(_BLOCK)).reshape(-1), jnp.repeat(jnp.arange(num_blocks), _BLOCK)


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


def in_windows(array: Any, rows: NDArray[np.intp]) -> Any:
    """Reshapes rows of an array into windows.

    Args:
        array: (w * m, ...).
        rows: (w, m) of `window_rows`.

    Returns:
        (w, m, ...).
    """
    return array.reshape(*rows.shape, *array.shape[1:])
