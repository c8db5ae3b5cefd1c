"""Windows of a walk: neighbours in time that are registered by themselves, and joined at the scans that they share.

Within a window all scans are near the first one, so that the Chamfer distance has its minimum within reach from zero
poses. Over a whole walk L-Net has to unroll the chain at once, and may lay two rooms that look alike on each other.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.geometry import se2


def window_rows(num_scans: int, scans_per_window: int) -> NDArray[np.intp]:
    """The scans of each window; the last scan of a window is the first of the next.

    Args:
        num_scans: of the set, in the order of time.
        scans_per_window: at least 2.

    Returns:
        (w, m) indices, m the smaller of both numbers; the last window reaches back, to be as long as the others.
    """
    length = min(scans_per_window, num_scans)
    count = max(1, -(-(num_scans - 1) // (length - 1))) if length > 1 else 1
    first = np.minimum(np.arange(count) * (length - 1), num_scans - length)
    return first[:, None] + np.arange(length)


def join_windows(poses: Float[Array, "w m 3"], num_scans: int) -> Float[Array, "n 3"]:
    """Poses of all scans in one world, that of the first window.

    Args:
        poses: of each window's scans, in a world of its own: x, y, heading.
        num_scans: of the set.

    Returns:
        The poses; neighbours within a window keep their motion.
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
    """The rows of an array side by side, as an array of windows.

    Args:
        array: (w * m, ...).
        rows: (w, m) of `window_rows`.

    Returns:
        (w, m, ...).
    """
    return array.reshape(*rows.shape, *array.shape[1:])
