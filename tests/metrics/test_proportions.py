"""Shares of right answers, against counted outcomes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dpmjax.metrics import mcnemar_p_value


@pytest.mark.parametrize(("only_a", "only_b", "both", "neither"), [(0, 7, 20, 3), (3, 9, 1, 2), (4, 5, 0, 9)])
def test_paired_test_counts_the_outcomes_that_are_as_unlikely(
    only_a: int, only_b: int, both: int, neither: int
) -> None:
    a = np.repeat([True, False, True, False], [only_a, only_b, both, neither])
    b = np.repeat([False, True, True, False], [only_a, only_b, both, neither])
    order = np.random.default_rng(0).permutation(len(a))
    ways = [math.comb(only_a + only_b, count) for count in range(only_a + only_b + 1)]
    expected = sum(number for number in ways if number <= ways[only_a]) / sum(ways)
    assert mcnemar_p_value(a[order], b[order]) == pytest.approx(expected, rel=1e-12)
    assert mcnemar_p_value(b, a) == mcnemar_p_value(a, b)


def test_methods_that_answer_alike_do_not_differ() -> None:
    answers = np.array([True, False, True])
    assert mcnemar_p_value(answers, answers) == 1.0
    assert mcnemar_p_value(answers[:0], answers[:0]) == 1.0
    # One more right answer each.
    assert mcnemar_p_value(np.array([True, False]), np.array([False, True])) == 1.0
