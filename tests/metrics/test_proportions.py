"""Shares of right answers, against SciPy's slower and independent functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from dpmjax.metrics import mcnemar_p_value, wilson_interval


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
@pytest.mark.parametrize(("num_right", "num_all"), [(0, 30), (1, 30), (15, 30), (29, 30), (30, 30), (1, 1), (171, 210)])
def test_interval_is_that_of_scipy(num_right: int, num_all: int, confidence: float) -> None:
    found = wilson_interval(num_right, num_all, confidence=confidence)
    expected = stats.binomtest(num_right, num_all).proportion_ci(confidence, method="wilson")
    np.testing.assert_allclose(found, [num_right / num_all, expected.low, expected.high], atol=1e-12)
    assert 0.0 <= found.low <= found.share <= found.high <= 1.0
    assert found.low < found.high


def test_interval_covers_the_true_share_as_often_as_it_says() -> None:
    """The number of right answers of 60 is binomial; the probability of covering is near 0.95 on average."""
    shares, counts = np.linspace(0.02, 0.98, 97), np.arange(61)
    low, high = np.array([wilson_interval(int(count), 60)[1:] for count in counts]).T
    covers = (low[:, None] <= shares) & (shares <= high[:, None])
    coverage = (covers * stats.binom.pmf(counts[:, None], 60, shares)).sum(axis=0)
    assert abs(coverage.mean() - 0.95) < 0.01
    assert coverage.min() > 0.85


def test_without_answers_nothing_is_known() -> None:
    found = wilson_interval(0, 0)
    assert np.isnan(found.share)
    assert (found.low, found.high) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("only_a", "only_b", "both", "neither"), [(0, 7, 20, 3), (7, 0, 5, 0), (3, 9, 1, 2), (4, 5, 0, 9)]
)
def test_paired_test_is_the_binomial_test_of_scipy(only_a: int, only_b: int, both: int, neither: int) -> None:
    a = np.repeat([True, False, True, False], [only_a, only_b, both, neither])
    b = np.repeat([False, True, True, False], [only_a, only_b, both, neither])
    order = np.random.default_rng(0).permutation(len(a))
    expected = stats.binomtest(only_a, only_a + only_b).pvalue
    assert mcnemar_p_value(a[order], b[order]) == pytest.approx(expected, rel=1e-12)
    assert mcnemar_p_value(b, a) == mcnemar_p_value(a, b)


def test_methods_that_answer_alike_do_not_differ() -> None:
    answers = np.array([True, False, True])
    assert mcnemar_p_value(answers, answers) == 1.0
    assert mcnemar_p_value(answers[:0], answers[:0]) == 1.0
    # One more right answer each.
    assert mcnemar_p_value(np.array([True, False]), np.array([False, True])) == 1.0


@pytest.mark.usefixtures("as_user")
@pytest.mark.parametrize("call", [lambda: wilson_interval(3, 2), lambda: wilson_interval(-1, 2)])
def test_impossible_numbers_are_refused(call) -> None:
    with pytest.raises(ValueError, match="^num_right: expected 0 to 2, got"):
        call()


@pytest.mark.usefixtures("as_user")
def test_other_input_is_refused() -> None:
    with pytest.raises(ValueError, match="confidence"):
        wilson_interval(1, 2, confidence=1.0)
    with pytest.raises(ValueError, match="same shape"):
        mcnemar_p_value(np.ones(3, bool), np.ones(4, bool))
