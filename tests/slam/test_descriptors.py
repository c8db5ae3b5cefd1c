"""Laws of SLAM by descriptors alone, with a matcher that knows the truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from dpmjax.cli.slam import SlamOptions, slam_methods
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import turn_rad
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.saved_maps import load_state, save_state
from dpmjax.slam import (
    DescriptorConfig,
    KeyframeMap,
    SlamConfig,
    SlamMethods,
    SlamResult,
    Submap,
    finish_slam,
    init_slam,
    run_slam,
    slam_preset,
    step_slam,
)
from dpmjax.slam.descriptors import find_loop_targets, neighbours_of, verify_match
from dpmjax.slam.interfaces import Match
from dpmjax.slam.keyframe_map import Keyframe, MapEdge, add_keyframe, steps_from
from dpmjax.slam.loops import Loop
from dpmjax.slam.model_methods import UNKNOWN, point_information
from tests.slam.truth import TruthGeometry, TruthMatcher, compact_of, laps, noise, number_of, pose, scans_of

PAPER = slam_preset("paper")


@dataclass(frozen=True)
class PlainGeometry(TruthGeometry):
    """Thins, and refuses to align a surface."""

    def align(self, local_map, scan, T_map_scan):
        raise AssertionError("a surface was aligned")

    def search(self, local_map, scan, T_map_scan):
        raise AssertionError("a surface was aligned")


@dataclass(frozen=True)
class PlainMatcher(TruthMatcher):
    """Registers by descriptors alone, and refuses to verify; error and confidence of some scans are given."""

    gross_share: float = 0.0
    rmse: dict[int, float] = field(default_factory=dict)
    confidence: dict[int, float] = field(default_factory=dict)
    usual_rmse: float = 0.3

    def match(self, source: Submap, target: Submap) -> Match:
        number = number_of(source.scans[0])
        found = super().match(source, target)
        confidence = self.confidence.get(number, found.probability)
        return found._replace(rmse=self.rmse.get(number, self.usual_rmse), probability=confidence)

    def propose(self, source, target, num_motions):
        raise AssertionError("a motion was proposed to the surfaces")

    def register(self, pairs):
        raise AssertionError("a registration was verified by surfaces")


def methods_of(truth: np.ndarray, matcher: TruthMatcher | None = None, config: SlamConfig = PAPER) -> SlamMethods:
    return SlamMethods(matcher or PlainMatcher(truth), PlainGeometry(truth), config)


def run(truth: np.ndarray, matcher: TruthMatcher | None = None, config: SlamConfig = PAPER) -> SlamResult:
    return run_slam(methods_of(truth, matcher, config), scans_of(range(len(truth))))


def straight(num: int, step_m: float = 1.0) -> np.ndarray:
    return np.array([pose(step_m * number, 0.0, 0.0) for number in range(num)])


def errors_m(result: SlamResult, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(result.T_world_scan[:, :3, 3] - (rigid.inverse(truth[0]) @ truth)[:, :3, 3], axis=1)


@pytest.mark.parametrize("rmse", [0.05, 0.2, 0.45])
def test_keyframes_are_those_of_the_dynamic_threshold(rmse) -> None:
    truth = straight(120)
    exact = {"sigma_m": 0.0, "sigma_rad": 0.0, "usual_rmse": rmse}
    result = run(truth, PlainMatcher(truth, **exact))
    keyframes, ratio = [0], 1.0
    for number in range(1, len(truth)):
        if min(number - keyframe for keyframe in keyframes) > max(10 * ratio, 1.0) + 1e-9:
            keyframes.append(number)
        ratio = min(max(0.9 * ratio + 0.2 * (1 - rmse / 0.5) ** 2, 0.0), 2.0)
    assert result.keyframes.tolist() == keyframes


@pytest.mark.parametrize(
    ("confidence", "rmse", "is_accepted"),
    [(0.6, 0.5, True), (0.59, 0.1, False), (0.9, 0.51, False), (0.9, np.inf, False)],
)
def test_a_registration_beyond_a_limit_is_dropped_and_flagged(confidence, rmse, is_accepted) -> None:
    truth = straight(12)
    exact = {"sigma_m": 0.0, "sigma_rad": 0.0}
    result = run(truth, PlainMatcher(truth, rmse={7: rmse}, confidence={7: confidence}, **exact))
    statuses = [report.status for report in result.reports]
    assert statuses == ["first", *["tracked"] * 6, "tracked" if is_accepted else "predicted", *["tracked"] * 4]
    # The dropped scan continues the last motion.
    np.testing.assert_allclose(result.T_world_scan, truth, atol=1e-6)


@pytest.mark.parametrize("best", [10, 12, 14])
def test_of_five_dropped_scans_the_one_of_the_smallest_error_is_accepted(best) -> None:
    truth = straight(20, step_m=3.0)
    rmse = dict.fromkeys(range(10, 15), 0.9) | {best: 0.7}
    matcher = PlainMatcher(truth, rmse=rmse, sigma_m=0.0, sigma_rad=0.0)
    # Keyframes are near each other, so that the accepted scan becomes one.
    config = SlamConfig(method="descriptors", descriptors=DescriptorConfig(keyframe_m=2.0))
    result = run(truth, matcher, config)
    statuses = [report.status for report in result.reports]
    assert statuses[10:15] == [*["predicted"] * 4, "network" if best == 14 else "predicted"]
    assert set(statuses[1:10] + statuses[15:]) == {"tracked"}
    assert f"scan {best} of the dropped" in result.reports[14].reason
    assert set(result.keyframes.tolist()) & set(range(10, 15)) == {best}
    np.testing.assert_allclose(result.T_world_scan, truth, atol=1e-6)


def test_scans_without_any_motion_are_never_accepted() -> None:
    truth = straight(30)
    lost = dict.fromkeys(range(10, 22), np.inf)
    result = run(truth, PlainMatcher(truth, rmse=lost, sigma_m=0.0, sigma_rad=0.0))
    assert [report.scan for report in result.reports if report.status == "predicted"] == list(lost)
    np.testing.assert_allclose(result.T_world_scan, truth, atol=1e-6)


def test_a_worse_registration_with_the_map_is_not_taken() -> None:
    truth = straight(40)

    class Poor(PlainMatcher):
        def match(self, source, target):
            found = super().match(source, target)
            if len(target.scans) == 1:
                return found
            return found._replace(T_target_source=found.T_target_source @ pose(5.0, 0, 0), rmse=0.6)

    matcher = Poor(truth, sigma_m=0.0, sigma_rad=0.0)
    np.testing.assert_allclose(run(truth, matcher).T_world_scan, truth, atol=1e-6)
    # Within the limit it is the pose.
    looser = SlamConfig(method="descriptors", descriptors=DescriptorConfig(max_rmse_m=0.7))
    assert errors_m(run(truth, matcher, looser), truth).max() > 4


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_loops_correct_the_drift_of_odometry(seed) -> None:
    truth = laps(2, side_m=80.0, step_m=2.0)
    matcher = PlainMatcher(truth, sigma_m=0.2, sigma_rad=0.01, seed=seed)
    alone = run(truth, matcher, replace(PAPER, loops=replace(PAPER.loops, is_on=False)))
    closed = run(truth, matcher)
    assert not alone.loops
    accepted = [loop for loop in closed.loops if loop.status == "accepted"]
    assert len(accepted) >= 5
    assert len(closed.map.edges_of("loop")) == len(accepted)
    ates = [absolute_trajectory_error(one.T_world_scan[:, :3, 3], truth[:, :3, 3]) for one in (closed, alone)]
    assert ates[0] < 0.6 * ates[1]
    np.testing.assert_array_equal(closed.map.T_world_keyframe[0], np.eye(4))


def map_of(positions: np.ndarray, headings: np.ndarray, edges: list[tuple[int, int]]) -> KeyframeMap:
    slam_map = KeyframeMap()
    for row, (position, heading) in enumerate(zip(positions, headings, strict=True)):
        T = pose(*position, heading)
        slam_map = add_keyframe(slam_map, Keyframe(row, T, 5.0 * row, 0, 10.0, compact_of(row)), T, np.ones(2), None)
    return replace(slam_map, edges=tuple(MapEdge(*edge, np.eye(4), np.eye(6), "odometry") for edge in edges))


def steps_of(edges: list[tuple[int, int]], row: int, num: int) -> np.ndarray:
    """Breadth-first search, slowly."""
    steps = np.full(num, np.inf)
    steps[row] = 0
    for count in range(num):
        for a, b in edges:
            for one, other in ((a, b), (b, a)):
                if steps[one] == count:
                    steps[other] = min(steps[other], count + 1)
    return steps


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_and_candidates_are_those_of_a_slow_search(seed) -> None:
    rng, num = np.random.default_rng(seed), 60
    positions, headings = np.cumsum(rng.normal(0, 12, (num, 2)), axis=0), rng.uniform(-np.pi, np.pi, num)
    edges = [(row + 1, row) for row in range(num - 1) if row != 14] + [(40, 20)]
    slam_map = map_of(positions, headings, edges)
    row = num - 1
    steps = steps_of(edges, row, num)
    np.testing.assert_array_equal(steps_from(slam_map, row), steps)
    apart = np.linalg.norm(positions - positions[row], axis=1)
    near = sorted(np.flatnonzero(steps <= 5), key=lambda other: (steps[other], apart[other]))[:16]
    assert neighbours_of(slam_map, row).tolist() == near
    assert neighbours_of(slam_map, row, 20.0).tolist() == [other for other in near if apart[other] <= 20]
    last = Loop(num - 3 + seed, 5, "distance", "accepted")
    expected = []
    for other in range(row):
        T = rigid.inverse(slam_map.T_world_keyframe[row]) @ slam_map.T_world_keyframe[other]
        is_distinct = turn_rad(T) >= np.deg2rad(30) and apart[other] >= 10 and 5.0 * (row - last.source) >= 10
        is_near = apart[other] <= 100 and steps[other] > 2 and (steps[other] > 30 or is_distinct)
        if np.isinf(steps[other]) or is_near:
            expected.append(other)
    is_allowed = np.arange(num) < row
    assert find_loop_targets(slam_map, [last], row, steps, is_allowed).tolist() == expected
    assert 0 in expected


@pytest.mark.parametrize(
    ("off", "num_steps", "status"),
    [
        (pose(3 * 0.4 * 3 - 0.01, 0, 0), 9, "accepted"),
        (pose(3 * 0.4 * 3 + 0.01, 0, 0), 9, "against odometry"),
        (pose(0, 0, np.deg2rad(4.4)), 9, "accepted"),
        (pose(0, 0, np.deg2rad(4.6)), 9, "against odometry"),
        (pose(50, 0, 0), 99, "against odometry"),
        (pose(50, 0, 0), 100, "accepted"),
        (pose(50, 0, 2.0), 100, "against odometry"),
        (pose(50, 0, 2.0), 5000, "accepted"),
        (pose(50, 0, 2.0), np.inf, "accepted"),
    ],
)
def test_a_loop_agrees_with_the_graph_within_the_published_limits(off, num_steps, status) -> None:
    slam_map = map_of(np.array([[0.0, 0.0], [8.0, 0.0]]), np.zeros(2), [])
    methods, loop = methods_of(straight(2)), Loop(1, 0, "distance")
    match = Match(pose(8.0, 0, 0) @ off, 0.6, 0.5)
    assert verify_match(methods, slam_map, loop, match, num_steps) == status
    for bad in (match._replace(probability=0.59), match._replace(rmse=0.51)):
        assert verify_match(methods, slam_map, loop, bad, num_steps) == "improbable"


@pytest.mark.parametrize("seed", range(3))
def test_the_information_is_the_sum_over_points_that_meet(seed) -> None:
    rng = np.random.default_rng(seed)
    T = noise(rng, 2.0, 0.5)
    source = rng.uniform(-5, 5, (60, 3))
    target = source[:40] @ T[:3, :3].T + T[:3, 3] + rng.normal(0, 0.3, (40, 3))
    expected = np.zeros((6, 6))
    for point in source:
        moved = [np.linalg.solve(T, [*other, 1.0])[:3] for other in target]
        q = min(moved, key=lambda other: np.linalg.norm(other - point))
        if np.linalg.norm(q - point) <= 1.0:
            x, y, z = q
            G = np.column_stack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
            expected += G.T @ G
    found = point_information(source, target, T)
    np.testing.assert_allclose(found, expected + UNKNOWN, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    # Without a pair, nothing is known, but the graph stays solvable.
    nothing = point_information(source, target + 100.0, T)
    assert 0 < np.linalg.eigvalsh(nothing).min() <= np.linalg.eigvalsh(nothing).max() < 1
    assert np.isfinite(point_information(source, np.zeros((0, 3)), T)).all()


def test_a_killed_run_goes_on_bit_for_bit(tmp_path) -> None:
    truth = laps(1, side_m=40.0, step_m=2.0)
    matcher = PlainMatcher(truth, rmse=dict.fromkeys(range(20, 26), 0.8))
    methods, scans = methods_of(truth, matcher), scans_of(range(len(truth)))
    state, reports, saved = init_slam(), [], None
    for scan in scans:
        state, report = step_slam(methods, state, scan)
        reports.append(report)
        if report.is_keyframe and report.scan < 50:
            saved = save_state(tmp_path / "state.npz", state, reports)
    assert saved is not None
    found = load_state(saved)
    again, repeated = found.state, list(found.reports)
    assert again.front_end.keyframe_ratio is not None
    for scan in scans[len(repeated) :]:
        again, report = step_slam(methods, again, scan)
        repeated.append(report)
    first, second = (finish_slam(*each, methods.config) for each in ((state, reports), (again, repeated)))
    np.testing.assert_array_equal(first.T_world_scan, second.T_world_scan)
    np.testing.assert_array_equal(first.keyframes, second.keyframes)
    assert [loop.status for loop in first.loops] == [loop.status for loop in second.loops]


def test_a_later_drive_extends_a_map_as_soon_as_it_meets_it() -> None:
    truth = laps(1, side_m=60.0, step_m=2.0)
    methods = methods_of(truth, PlainMatcher(truth, sigma_m=0.02, sigma_rad=0.001))
    first = run_slam(methods, scans_of(range(80)))
    second = run_slam(methods, scans_of(range(50, 110)), slam_map=first.map)
    assert second.reports[0].status == "first"
    expected = (rigid.inverse(truth[0]) @ truth[50:110])[:, :3, 3]
    assert np.linalg.norm(second.T_world_scan[:, :3, 3] - expected, axis=1).max() < 2.0


def test_options_of_one_method_are_refused_with_the_other(as_user) -> None:
    with pytest.raises(ValueError, match="--odometry"):
        SlamOptions(preset="paper", odometry="network")
    with pytest.raises(ValueError, match="--max-rmse"):
        SlamOptions(max_rmse=2.5)
    given = slam_methods(SlamOptions(preset="paper", max_rmse=2.5))
    assert given.config.descriptors == DescriptorConfig(max_rmse_m=2.5)
