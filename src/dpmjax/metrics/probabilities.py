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


def expected_calibration_error(
    probability: Float[AnyArray, " n"], is_true: Bool[AnyArray, " n"], *, num_bins: int = 10
) -> float:
    """Computes the expected calibration error (Naeini et al. 2015).

    Args:
        probability: of each event, in [0, 1].
        is_true: outcome of each event.
        num_bins: number of bins of equal width.

    Returns:
        The difference between mean probability and share of true events in a bin, averaged over the events; 0 for a
        calibrated forecast; NaN without events.
    """
    probabilities, labels = np.asarray(probability, np.float64), np.asarray(is_true, np.float64)
    if len(labels) == 0:
        return float("nan")
    bins = np.minimum((probabilities * num_bins).astype(int), num_bins - 1)
    gaps = np.bincount(bins, probabilities - labels, num_bins)
    return float(np.abs(gaps).sum() / len(labels))
