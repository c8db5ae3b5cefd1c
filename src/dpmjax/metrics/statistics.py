"""Statistics: comparisons of shares, quality of probabilities, the Cramér-Rao bound of positions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray

from dpmjax.types import AnyArray


def mcnemar_p_value(is_right_a: Bool[AnyArray, " n"], is_right_b: Bool[AnyArray, " n"]) -> float:
    """Returns the p-value of McNemar's exact test: two methods answered the same n questions.

    Only the questions that one of the two answers right count. If both methods are equally good, either one is right in
    such a case with the probability of a half, and their number is binomial (McNemar 1947).

    Args:
        is_right_a: answers of one method.
        is_right_b: answers of a second method to the same questions, in the same order.

    Returns:
        Probability, two-sided, that two equally good methods differ at least as much; 1 where no answer differs.
    """
    from scipy import stats

    a, b = np.asarray(is_right_a, bool), np.asarray(is_right_b, bool)
    num_differ = int((a != b).sum())
    return float(stats.binomtest(int((a & ~b).sum()), num_differ).pvalue) if num_differ else 1.0


def area_under_curve(score: Float[AnyArray, " n"], is_positive: Bool[AnyArray, " n"]) -> float:
    """Computes the area under the ROC curve: how often a positive example scores higher than a negative one.

    Args:
        score: score of each example.
        is_positive: label of each example.

    Returns:
        In [0, 1]; ties count half; NaN without an example of each label.
    """
    from scipy import stats

    scores, labels = np.asarray(score, np.float64), np.asarray(is_positive, bool)
    num_pairs = int(labels.sum() * (~labels).sum())
    # Mann and Whitney's U counts the pairs in which the positive example scores higher.
    u = stats.mannwhitneyu(scores[labels], scores[~labels], method="asymptotic").statistic if num_pairs else np.nan
    return float(u / max(num_pairs, 1))


def brier_score(probability: Float[AnyArray, " n"], is_true: Bool[AnyArray, " n"]) -> float:
    """Computes the mean squared difference of probabilities and outcomes (Brier 1950).

    Args:
        probability: probability of each event, in [0, 1].
        is_true: outcome of each event.

    Returns:
        0 for a certain and right forecast, 0.25 for a half each time; NaN without events.
    """
    errors = np.asarray(probability, np.float64) - np.asarray(is_true, np.float64)
    return float(np.mean(errors**2)) if len(errors) else float("nan")


def expected_calibration_error(probability: Float[AnyArray, " n"], is_true: Bool[AnyArray, " n"]) -> float:
    """Computes the expected calibration error in ten bins of equal width (Naeini et al. 2015).

    Args:
        probability: probability of each event, in [0, 1].
        is_true: outcome of each event.

    Returns:
        The difference between mean probability and share of true events in a bin, averaged over the events; 0 for a
        calibrated forecast; NaN without events.
    """
    probabilities, labels = np.asarray(probability, np.float64), np.asarray(is_true, np.float64)
    gaps = np.bincount(np.minimum((probabilities * 10).astype(int), 9), probabilities - labels)
    return float(np.abs(gaps).sum() / len(labels)) if len(labels) else float("nan")


def position_bound(
    cast_ranges: Callable[[NDArray[np.float64]], NDArray[np.float64]], poses: ArrayLike, *, range_noise: float
) -> Float[np.ndarray, " n"]:
    """Computes the least position error of an unbiased estimate from one scan in a known world (Cramér-Rao bound).

    The information of a scan is J^T J / noise^2, where J is the derivative of its ranges by x, y and heading (Kay 1993,
    eq. 3.31). An estimate that must find the world too cannot do better. The root mean square over the scans of a
    trajectory bounds its absolute trajectory error, up to the alignment of the trajectories (three of 3 n unknowns).

    Args:
        cast_ranges: ranges (m, b) of noise-free scans from poses (m, 3) in the world.
        poses: (n, 3) x, y in the unit of the ranges, heading in radians.
        range_noise: standard deviation of the noise of one range.

    Returns:
        (n,) root of the summed variances of x and y; infinite where the scan leaves a direction open.
    """
    at = np.asarray(poses, np.float64).reshape(-1, 3)
    # Half a pixel in a world of pixels, and a thousandth of a radian.
    steps = np.diag([0.5, 0.5, 1e-3])
    jacobian = np.stack([(cast_ranges(at + d) - cast_ranges(at - d)) / (2.0 * d.sum()) for d in steps], axis=-1)
    # Beams whose range changes faster than ten times the motion of their end jump between obstacles; a radian of
    # heading moves the end of a beam by the length of the beam.
    ranges = cast_ranges(at)
    steepness = np.abs(jacobian) / np.stack([np.ones_like(ranges), np.ones_like(ranges), ranges], axis=-1)
    used = jacobian * (steepness < 10.0).all(axis=-1, keepdims=True)
    information = np.einsum("nbi,nbj->nij", used, used) / range_noise**2
    bound = np.full(len(at), np.inf)
    is_held = np.linalg.eigvalsh(information)[:, 0] > 1e-9 / range_noise**2
    bound[is_held] = np.sqrt(np.trace(np.linalg.inv(information[is_held])[:, :2, :2], axis1=1, axis2=2))
    return bound
