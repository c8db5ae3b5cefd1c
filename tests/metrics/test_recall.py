"""Shares of right answers: motions that count as right, and methods that differ."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.metrics import mcnemar_p_value, registration_recall


def motion(angle_deg: float, translation: tuple[float, float, float], axis=(0.0, 0.0, 1.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(angle_deg) * np.asarray(axis)).as_matrix()
    T[:3, 3] = translation
    return T


def test_errors_are_told_and_limits_hold() -> None:
    true = np.stack([motion(170, (1, 2, 3), (0.6, 0.8, 0))] * 4)
    changes = [motion(0, (0, 0, 0)), motion(4.9, (0, 0, 0)), motion(5.1, (0, 0, 0)), motion(180, (0, 0, 0))]
    found = registration_recall(true @ np.stack(changes), true)
    np.testing.assert_allclose(found.rotation_errors_deg, [0, 4.9, 5.1, 180], atol=1e-6)
    np.testing.assert_array_equal(found.is_right, [True, True, False, False])
    assert found.recall == 0.5
    shifted = true.copy()
    shifted[:, 0, 3] += [0, 1.9, 2.1, np.nan]
    np.testing.assert_array_equal(registration_recall(shifted, true).is_right, [True, True, False, False])


def test_small_angles_keep_their_digits() -> None:
    found = registration_recall(motion(1e-6, (0, 0, 0))[None], np.eye(4)[None])
    np.testing.assert_allclose(found.rotation_errors_deg, 1e-6, rtol=1e-6)


def test_without_pairs_nothing_is_right() -> None:
    assert registration_recall(np.zeros((0, 4, 4)), np.zeros((0, 4, 4))).recall == 0


@pytest.mark.parametrize(("only_a", "only_b", "both", "neither"), [(0, 7, 20, 3), (3, 9, 1, 2), (4, 5, 0, 9)])
def test_paired_test_counts_the_outcomes_that_are_as_unlikely(only_a, only_b, both, neither) -> None:
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
