"""Laws of several agents: maps that meet become one graph, and strangers stay apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.slam import (
    AgentsResult,
    LoopClosureConfig,
    OdometryConfig,
    SlamConfig,
    SlamMethods,
    run_agents,
    run_slam,
    slam_preset,
)
from tests.slam.truth import EMPTY, TruthGeometry, TruthMatcher, laps, number_of, scans_of

CONFIG = SlamConfig()
PRESETS = {
    "default": slam_preset("default"),
    "paper": slam_preset("paper"),
    "network": SlamConfig(odometry=OdometryConfig(proposer="network")),
}
TRUTH = laps(1, side_m=80.0, step_m=2.0)
"""160 poses along a square."""
PARTS = (range(70), range(55, 120), [*range(105, 160), *range(15)])
"""Each begins where the one before still drives, and the last meets the first."""


@dataclass(frozen=True)
class ConfusedMatcher(TruthMatcher):
    """Everything looks alike, all overlaps, and no registration is right."""

    gross_share: float = 1.0

    def vector(self, scan: CompactScan) -> np.ndarray:
        return np.ones(4) + 0.01 * np.random.default_rng(number_of(scan)).normal(size=4)

    def overlaps(self, source: CompactScan, targets: list[CompactScan]) -> np.ndarray:
        return np.ones(len(targets))


def methods_of(truth: np.ndarray, matcher: TruthMatcher | None = None, seed: int = 0) -> SlamMethods:
    return SlamMethods(matcher or TruthMatcher(truth, seed=seed), TruthGeometry(truth, seed=seed), CONFIG)


def run(parts=PARTS, *, truth: np.ndarray = TRUTH, matcher: TruthMatcher | None = None, seed: int = 0) -> AgentsResult:
    return run_agents(methods_of(truth, matcher, seed), [scans_of(part) for part in parts])


def joint_error_m(result: AgentsResult, parts, agents, truth: np.ndarray = TRUTH) -> float:
    """ATE of several agents in one frame."""
    found = np.concatenate([result.T_world_scan[agent][:, :3, 3] for agent in agents])
    expected = np.concatenate([truth[list(parts[agent])][:, :3, 3] for agent in agents])
    return absolute_trajectory_error(found, expected)


@pytest.mark.parametrize("config", PRESETS.values(), ids=PRESETS)
def test_three_agents_and_their_maps_are_joined_under_every_preset(config) -> None:
    methods = methods_of(TRUTH, TruthMatcher(TRUTH, gross_share=0.0))._replace(config=config)
    result = run_agents(methods, [scans_of(part) for part in PARTS])
    assert result.component == (0, 0, 0)
    assert joint_error_m(result, PARTS, (0, 1, 2)) < 1.0
    merged = dpmjax.merge_maps(methods, *(agent.map for agent in result.agents))
    assert merged.is_joined
    assert merged.component == (0, 0, 0)


@pytest.fixture(scope="module")
def joined() -> AgentsResult:
    return run()


def test_three_agents_that_meet_make_one_graph(joined) -> None:
    result = joined
    assert result.component == (0, 0, 0)
    assert joint_error_m(result, PARTS, (0, 1, 2)) < 1.0
    np.testing.assert_allclose(result.T_world_scan[0][0], np.eye(4), atol=1e-9)
    accepted = [loop for loop in result.joined.loops if loop.status == "accepted"]
    ends = {frozenset(result.joined.map_of_keyframe[list(loop[:2])].tolist()) for loop in accepted}
    assert ends == {frozenset({0, 1}), frozenset({1, 2}), frozenset({0, 2})}
    for loop in accepted:
        scans = [numbers_of(result)[row] for row in loop[:2]]
        true = rigid.inverse(TRUTH[scans[1]]) @ TRUTH[scans[0]]
        assert np.linalg.norm((rigid.inverse(true) @ loop.T_target_source)[:3, 3]) < 1.0


def numbers_of(result: AgentsResult) -> list[int]:
    """The number of the pose of each keyframe."""
    return [number_of(keyframe.compact) for keyframe in result.joined.slam_map.keyframes]


def test_agents_that_never_meet_stay_apart() -> None:
    far = TRUTH.copy()
    far[:, :3, 3] += [1000.0, 0.0, 0.0]
    truth = np.concatenate([TRUTH, far])
    parts = (range(60), range(200, 260), range(40, 100))
    result = run(parts, truth=truth)
    assert result.component == (0, 1, 0)
    assert joint_error_m(result, parts, (0, 2), truth) < 1.0
    # The stranger has the frame of its own first scan, and the trajectory that it has found alone.
    np.testing.assert_allclose(result.T_world_scan[1], result.agents[1].T_world_scan, atol=1e-9)
    assert len(result.joined.maps[1]) == len(result.agents[1].keyframes)


@pytest.mark.slow
def test_the_order_of_agents_does_not_matter(joined) -> None:
    first, second = joined, run(PARTS[::-1])
    for agent in range(3):
        a, b = first.T_world_scan[agent], second.T_world_scan[2 - agent]
        # Another agent gives the frame.
        T_b_a = second.T_world_scan[2][0] @ rigid.inverse(first.T_world_scan[0][0])
        np.testing.assert_allclose(T_b_a @ a, b, atol=1e-3)
    counts = [sum(loop.status == "accepted" for loop in each.joined.loops) for each in (first, second)]
    assert counts[0] == counts[1]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gross_errors_do_not_join_strangers(seed) -> None:
    far = TRUTH.copy()
    far[:, :3, 3] += [1000.0, 0.0, 0.0]
    truth = np.concatenate([TRUTH, far])
    matcher = ConfusedMatcher(truth, seed=seed)
    result = run((range(60), range(200, 260)), truth=truth, matcher=matcher, seed=seed)
    assert any(loop.T_target_source is not None for loop in result.joined.loops)
    assert result.component == (0, 1)


def test_an_agent_without_scans_is_alone() -> None:
    scans = [scans_of(range(30)), [EMPTY, EMPTY], [], scans_of(range(10, 40))]
    result = run_agents(methods_of(TRUTH), scans)
    assert result.component == (0, 1, 2, 0)
    assert [len(T_world_scan) for T_world_scan in result.T_world_scan] == [30, 2, 0, 30]


@pytest.mark.slow
def test_maps_of_different_days_are_merged() -> None:
    methods = methods_of(TRUTH)
    a, b = (dpmjax.run_slam(methods, scans_of(part)).map for part in PARTS[:2])
    merged = dpmjax.merge_maps(methods, a, b)
    assert merged.is_joined
    (both,) = merged.maps
    assert len(both) == len(a) + len(b)
    # The frame of the first map is kept.
    np.testing.assert_allclose(both.T_world_keyframe[0], a.T_world_keyframe[0], atol=1e-9)
    rows = [number_of(keyframe.compact) for keyframe in both.keyframes]
    assert absolute_trajectory_error(both.T_world_keyframe[:, :3, 3], TRUTH[rows][:, :3, 3]) < 1.0
    # A third drive extends the merged map.
    extended = dpmjax.run_slam(methods, scans_of(PARTS[2]), slam_map=both)
    rows = [number_of(keyframe.compact) for keyframe in extended.map.keyframes]
    found = extended.map.T_world_keyframe[:, :3, 3]
    assert absolute_trajectory_error(found, TRUTH[rows][:, :3, 3]) < 1.0
    assert len({keyframe.scan for keyframe in extended.map.keyframes}) == len(rows)


def test_a_merged_map_has_the_settings_of_the_first() -> None:
    first = methods_of(TRUTH)
    second = first._replace(config=SlamConfig(loops=LoopClosureConfig(min_probability=0.9)))
    a, b = (dpmjax.run_slam(methods, scans_of(part)).map for methods, part in zip((first, second), PARTS, strict=False))
    assert a.origin != b.origin
    assert dpmjax.merge_maps(first, a, b).maps[0].origin == a.origin
    assert dpmjax.merge_maps(second, b, a).maps[0].origin == b.origin


def test_of_three_maps_those_that_meet_become_one() -> None:
    methods = methods_of(TRUTH)
    parts = (range(30), range(80, 110), range(10, 40))
    maps = [dpmjax.run_slam(methods, scans_of(part)).map for part in parts]
    merged = dpmjax.merge_maps(methods, *maps)
    assert merged.component == (0, 1, 0)
    assert not merged.is_joined
    assert len(merged.maps[0]) == len(maps[0]) + len(maps[2])
    assert merged.maps[1] is maps[1]
    assert any(loop.status == "accepted" for loop in merged.loops)


def test_a_lost_agent_is_joined_as_a_whole() -> None:
    # The second agent is kidnapped on its way: its two parts hang together by loops with the first agent alone.
    parts = (range(160), [*range(20, 50), *range(110, 140)])
    result = run(parts)
    assert "restarted" in {report.status for report in result.agents[1].reports}
    assert result.component == (0, 0)
    T_new_old = result.T_world_scan[0][0] @ rigid.inverse(TRUTH[0])
    apart = np.linalg.norm((T_new_old @ TRUTH[list(parts[1])])[:, :3, 3] - result.T_world_scan[1][:, :3, 3], axis=1)
    assert np.median(apart[:30]) < 1.0
    assert np.median(apart[36:]) < 1.0


def test_bad_input_is_named(as_user) -> None:
    methods = methods_of(TRUTH)
    others = [methods_of(TRUTH, TruthMatcher(TRUTH, fingerprint=name)) for name in ("one", "other")]
    a, b = (run_slam(other, scans_of(range(10))).map for other in others)
    for call, message in (
        (lambda: run_agents(methods, []), "sequences: expected"),
        (lambda: dpmjax.merge_maps(methods, a, b), "made with weights one, these are other"),
        (lambda: dpmjax.merge_maps(methods, a, a), "made with weights one, these are truth"),
        (lambda: dpmjax.merge_maps(methods, dpmjax.KeyframeMap()), "maps: expected at least two, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
