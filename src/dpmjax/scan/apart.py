"""Selection of the best answers that differ from all better ones (non-maximum suppression), for motions of any kind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int


def apart(
    scores: Float[np.ndarray, " m"], is_near: Callable[[int], Bool[np.ndarray, " m"]], count: int
) -> Int[np.ndarray, " k"]:
    """Selects the best answers that are not near a better one.

    Args:
        scores: of the answers, more is better; an answer with the score minus infinity is never selected.
        is_near: returns True for answers near that of a row, the row among them.
        count: largest number of selected answers.

    Returns:
        Their rows, the best one first.
    """
    left, chosen = np.array(scores, np.float64), list[int]()
    while len(chosen) < count and np.isfinite(left).any():
        chosen.append(int(left.argmax()))
        left[is_near(chosen[-1])] = -np.inf
    return np.array(chosen, np.int64)
