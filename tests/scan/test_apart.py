"""Laws of the suppression of near duplicates."""

from __future__ import annotations

import numpy as np

from dpmjax.scan.apart import apart


def test_selected_answers_lie_apart_the_best_first() -> None:
    places = np.array([0.0, 0.1, 2.0, 5.0, 2.1])
    scores = np.array([1.0, 2.0, 3.0, -np.inf, 0.5])
    chosen = apart(scores, lambda best: np.abs(places - places[best]) < 0.5, 4)
    np.testing.assert_array_equal(chosen, [2, 1])
    assert len(apart(scores, lambda best: np.abs(places - places[best]) < 0.5, 1)) == 1
    assert len(apart(np.full(5, -np.inf), lambda _: np.ones(5, bool), 4)) == 0
