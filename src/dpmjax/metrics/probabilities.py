"""Measures of probabilities that were given to events: how well they sort, and how well they are calibrated."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.types import AnyArray


def area_under_curve(score: Float[AnyArray, " n"], is_positive: Bool[AnyArray, " n"]) -> float:
    """Computes the area under the ROC curve: how often a positive example scores higher than a negative one.

    Args:
        score: of each example.
        is_positive: label of each example.

    Returns:
        In [0, 1]; ties count half; NaN without an example of each label.
    """
    scores, labels = np.asarray(score), np.asarray(is_positive, bool)
    positive, negative = scores[labels], scores[~labels]
    if min(len(positive), len(negative)) == 0:
        return float("nan")
    return float(((positive[:, None] > negative) + 0.5 * (positive[:, None] == negative)).mean())


def brier_score(probability: Float[AnyArray, " n"], is_true: Bool[AnyArray, " n"]) -> float:
    """Computes the mean squared difference of probabilities and outcomes (Brier 1950).

    Args:
        probability: of each event, in [0, 1].
        is_true: outcome of each event.

    Returns:
        0 for a certain and right forecast, 0.25 for a half each time; NaN without events.
    """
    errors = np.asarray(probability, np.float64) - np.asarray(is_true, np.float64)
    return float(np.mean(errors**2)) if len(errors) else float("nan")
