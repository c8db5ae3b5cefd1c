"""Recall of loops on drives made by hand."""

import numpy as np
import pytest

from dpmjax.metrics import find_revisits, loop_recall
from tests.slam.truth import pose

NONE = np.zeros((0, 2), int)


def there_and_back(length_m: float = 100.0, lane_m: float = 3.0) -> np.ndarray:
    """Straight ahead, and back beside it, a metre a scan."""
    way = np.arange(0.0, length_m)
    there = [pose(x, 0.0, 0.0) for x in way]
    return np.array(there + [pose(x, lane_m, np.pi) for x in way[::-1]])


def twice_round(side_m: float = 50.0) -> np.ndarray:
    """A square, driven twice in the same direction, a metre a scan."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side_m
    round_once = [
        pose(*(corners[side] + step * np.array([np.cos(a), np.sin(a)])), a)
        for side in range(4)
        for a in [side * np.pi / 2]
        for step in np.arange(side_m)
    ]
    return np.array(round_once * 2)


def test_the_way_back_is_a_revisit_from_the_other_side() -> None:
    poses = there_and_back()
    found = find_revisits(poses, distance_m=5.0, min_path_m=50.0)
    # About the turn, the path to all near poses is shorter than 50 m.
    assert found.is_revisit[100 + 30 :].all()
    assert not found.is_revisit[: 100 + 15].any()
    np.testing.assert_array_equal(found.is_opposite, found.is_revisit)


def test_revisits_agree_with_all_pairs() -> None:
    poses = np.concatenate([there_and_back(70.0), twice_round(30.0)])
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    expected = ((apart <= 4.0) & (path[:, None] - path[None] >= 40.0)).any(axis=1)
    found = find_revisits(poses, distance_m=4.0, min_path_m=40.0)
    np.testing.assert_array_equal(found.is_revisit, expected)


def test_loops_count_for_the_scans_around_their_newer_end() -> None:
    poses = twice_round()
    revisits = find_revisits(poses, distance_m=2.0, min_path_m=50.0)
    num = int(revisits.is_revisit.sum())
    none = loop_recall(poses, NONE, revisits)
    assert none.recall == 0.0
    one = loop_recall(poses, np.array([[300, 300]]), revisits, reach_m=10.0)
    assert one.recall * num == pytest.approx(21)
    # A loop on the first round is no answer to a revisit.
    assert loop_recall(poses, np.array([[100, 100]]), revisits, reach_m=10.0).recall == 0.0
    whole = loop_recall(poses, np.array([[200, 399]]), revisits, reach_m=10.0)
    assert (whole.recall, whole.same_way) == (1.0, 1.0)
    assert np.isnan(whole.opposite)


def test_without_revisits_there_is_no_recall() -> None:
    poses = there_and_back()[:90]
    found = loop_recall(poses, NONE, find_revisits(poses))
    assert np.isnan([found.recall, found.same_way, found.opposite]).all()
