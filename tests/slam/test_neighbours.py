"""Laws of edges to keyframes before the last one, with a matcher that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.slam import Alignment, SlamConfig, SlamMethods, SlamResult, make_methods, matcher, run_slam
from dpmjax.slam.keyframes import diagonal_information
from dpmjax.slam.neighbours import join_neighbours
from tests.deeppointmap import toy
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, noise, scans_of

TRUTH = laps(1, side_m=60.0, step_m=2.0)
CONFIG = SlamConfig()


@dataclass(frozen=True)
class AligningMatcher(TruthMatcher):
    """Aligns up to noise; `off_m` puts all alignments beside the truth, `matched_share` says how well scans agree."""

    off_m: float = 0.0
    matched_share: float = 0.6

    def align_scans(self, source: int, target: int, T_target_source: np.ndarray) -> Alignment:
        rng = np.random.default_rng([self.seed, source, target, 9])
        T = rigid.inverse(self.T_world_scan[target]) @ self.T_world_scan[source] @ noise(rng, 0.005, 0.0005)
        T[0, 3] += self.off_m
        return Alignment(T, self.matched_share, 0.0, self.matched_share, diagonal_information(0.005, 0.0005))


def run(matcher: TruthMatcher, seed: int = 0, num_neighbours: int = 3) -> SlamResult:
    front = replace(CONFIG.front_end, num_neighbours=num_neighbours)
    config = replace(CONFIG, front_end=front, loops=replace(CONFIG.loops, is_on=False))
    geometry = TruthGeometry(TRUTH, sigma_m=0.02, sigma_rad=0.003, seed=seed)
    return run_slam(SlamMethods(matcher, geometry, config), scans_of(range(len(TRUTH))))


def skips(result: SlamResult) -> list[tuple[int, int]]:
    edges = result.map.edges
    return [(edge.source, edge.source - edge.target) for edge in edges if edge.source - edge.target > 1]


def test_neighbours_hold_the_chain_straighter() -> None:
    before, after = [], []
    for seed in range(5):
        result = run(AligningMatcher(TRUTH, seed=seed), seed)
        for errors, T in ((before, result.T_odometry_scan), (after, result.T_world_scan)):
            errors.append(absolute_trajectory_error(T[:, :3, 3], TRUTH[:, :3, 3]))
    assert np.mean(after) < 0.7 * np.mean(before)


def test_each_keyframe_is_aligned_with_those_before_the_last_one() -> None:
    result = run(AligningMatcher(TRUTH))
    at = TRUTH[result.keyframes][:, :3, 3]
    expected = [
        (row, hops)
        for row in range(2, len(at))
        for hops in (2, 3, 4)
        if hops <= row and np.linalg.norm(at[row] - at[row - hops]) < 15.0  # 1.5 extents
    ]
    assert skips(result) == expected
    assert {hops for _, hops in expected} == {2, 3, 4}
    assert {edge.kind for edge in result.map.edges} == {"odometry"}
    assert not skips(run(AligningMatcher(TRUTH), num_neighbours=0))


@pytest.mark.parametrize("change", [{"off_m": 1.0}, {"matched_share": 0.2}])
def test_what_odometry_or_the_scans_contradict_is_not_believed(change) -> None:
    result = run(replace(AligningMatcher(TRUTH), **change))
    assert not skips(result)
    np.testing.assert_array_equal(result.T_world_scan, result.T_odometry_scan)


def test_chains_that_nothing_measured_joins_stay_apart() -> None:
    matcher = AligningMatcher(TRUTH)
    result = run(matcher)
    slam_map = result.map
    last = slam_map.keyframes[-1]
    broken = replace(slam_map, keyframes=(*slam_map.keyframes[:-1], last._replace(segment=1)))
    methods = SlamMethods(matcher, TruthGeometry(TRUTH), CONFIG)
    assert join_neighbours(methods, broken) is broken
    assert len(join_neighbours(methods, slam_map).edges) == len(slam_map.edges) + 2


def test_surfaces_in_the_map_are_aligned_from_nearby(monkeypatch) -> None:
    drive = toy.drive(1, num_scans=3, step_m=2.0)
    methods = make_methods(dpmjax.init_model(jax.random.key(0), toy.MODEL))
    scans = [
        methods.matcher.describe(points, methods.geometry.measure(points)) for points in map(drive.read_scan, (0, 2))
    ]
    true = rigid.inverse(drive.T_world_lidar[0]) @ drive.T_world_lidar[2]
    start = true @ noise(np.random.default_rng(0), 0.1, 0.01)
    assert methods.matcher.align_scans(scans[1], scans[0], start) is None  # too sparse
    monkeypatch.setattr(matcher, "MIN_ALIGNED_POINTS", 500)
    found = methods.matcher.align_scans(scans[1], scans[0], start)
    assert np.linalg.norm((rigid.inverse(true) @ found.T_map_scan)[:3, 3]) < 0.05
    assert found.matched_share > 0.5
    assert np.linalg.eigvalsh(found.information).min() > 0
