"""Laws of the refinement of keyframes by DeepMapping; a fit that knows the truth takes its place."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.slam import KeyframeMap, SlamConfig, SlamMethods, map_optimization, refine_keyframes, run_slam
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, scans_of

TRUTH = laps(1, side_m=60.0, step_m=2.0)
KEY = jax.random.key(0)
START = SimpleNamespace(kept="start")


@pytest.fixture(scope="module")
def drifted() -> KeyframeMap:
    methods = SlamMethods(TruthMatcher(TRUTH), TruthGeometry(TRUTH, sigma_m=0.05), SlamConfig())
    return run_slam(methods, scans_of(range(len(TRUTH)))).map


def true_poses(slam_map: KeyframeMap) -> np.ndarray:
    return rigid.inverse(TRUTH[0]) @ TRUTH[[keyframe.scan for keyframe in slam_map.keyframes]]


def read_row(row: int) -> np.ndarray:
    """A cloud that tells its row."""
    return np.array([[row, 0.0, 0.0]])


def use_fit(patch: pytest.MonkeyPatch, slam_map: KeyframeMap, kept: str = "fit") -> None:
    true = true_poses(slam_map)

    def fit(clouds, *, key, start):
        rows = [int(cloud[0, 0]) for cloud in clouds]
        return SimpleNamespace(T_world_scan=start[0] @ rigid.inverse(true[rows[0]]) @ true[rows], kept=kept)

    patch.setattr(map_optimization, "register_clouds", fit)


@pytest.mark.parametrize("num", [1, 2, 31, 32, 33, 56, 57, 200])
def test_windows_cover_all_keyframes(num: int) -> None:
    parts = map_optimization.windows(num)
    assert sorted({row for rows in parts for row in rows}) == list(range(num))
    assert all(b.start == a.stop - map_optimization.OVERLAP for a, b in itertools.pairwise(parts))


def test_refined_motions_and_loops_make_one_map(drifted, monkeypatch) -> None:
    """A fit that knows the truth brings the drifted map to the truth, over the borders of windows."""
    use_fit(monkeypatch, drifted)
    counted = []
    refined = refine_keyframes(drifted, read_row, key=KEY, on_window=lambda done, num: counted.append((done, num)))
    true = true_poses(drifted)
    before, after = (
        absolute_trajectory_error(slam_map.T_world_keyframe[:, :3, 3], true[:, :3, 3])
        for slam_map in (drifted, refined.slam_map)
    )
    assert refined.num_windows > 1
    assert refined.num_improved == refined.num_windows
    assert counted == [(number + 1, refined.num_windows) for number in range(refined.num_windows)]
    assert after < 0.1 * before


def test_a_fit_that_is_no_better_changes_nothing(drifted, monkeypatch) -> None:
    use_fit(monkeypatch, drifted, kept="start")
    refined = refine_keyframes(drifted, read_row, key=KEY)
    assert refined.num_improved == 0
    assert refined.slam_map is drifted


def test_a_stop_leaves_the_remaining_windows_as_they_are(drifted, monkeypatch) -> None:
    use_fit(monkeypatch, drifted)
    asked = iter([False, True, True, True, True])
    refined = refine_keyframes(drifted, read_row, key=KEY, stop=lambda: next(asked))
    assert refined.num_improved == 1


def test_a_map_without_two_keyframes_stays(drifted) -> None:
    assert refine_keyframes(KeyframeMap(), read_row, key=KEY).num_improved == 0


def test_no_window_has_keyframes_of_two_parts(drifted, monkeypatch) -> None:
    """Their relative pose is a guess, from which no fit may start."""
    half = len(drifted) // 2
    edges = [edge for edge in drifted.edges if (edge.source < half) == (edge.target < half)]
    fitted = []
    monkeypatch.setattr(map_optimization, "register_clouds", lambda clouds, **_: fitted.append(clouds) or START)
    refine_keyframes(replace(drifted, edges=tuple(edges)), read_row, key=KEY)
    rows = [[int(cloud[0, 0]) for cloud in clouds] for clouds in fitted]
    assert sorted({row for window in rows for row in window}) == list(range(len(drifted)))
    assert all(window[-1] < half or window[0] >= half for window in rows)
