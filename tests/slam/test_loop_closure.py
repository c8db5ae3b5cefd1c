"""Laws of retrieval, of the consistency of loops, and of loops that are taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.deeppointmap import pooled_vector
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.pose_graph import optimize_pose_graph
from dpmjax.scan.lidar.slide import diagonal_information
from dpmjax.slam import KeyframeMap, LoopClosureConfig, SlamConfig, SlamMethods
from dpmjax.slam.keyframe_map import Keyframe, MapEdge, add_keyframe, as_pose_graph, submap_around
from dpmjax.slam.loop_closure import (
    MAX_AGAIN,
    MIN_PATH_SHARE,
    find_loop_candidates,
    most_similar,
    nearest_pairs,
    search_again,
)
from dpmjax.slam.loops import Loop, LoopState, are_consistent, num_accepted, optimize_map
from dpmjax.types import DescriptorCloud
from tests.slam.truth import TruthGeometry, TruthMatcher, compact_of, laps, noise, number_of, pose

CONFIG = LoopClosureConfig()


def map_of(T_world_keyframe: np.ndarray, *, sigma_m: float = 0.0, segments=None, seed: int = 0) -> KeyframeMap:
    """A chain of keyframes 2 m apart."""
    rng = np.random.default_rng(seed)
    slam_map, T = KeyframeMap(), T_world_keyframe[0]
    for row, T_true in enumerate(T_world_keyframe):
        edge = None
        if row:
            step = rigid.inverse(T_world_keyframe[row - 1]) @ T_true @ noise(rng, sigma_m, sigma_m / 10)
            T, edge = T @ step, MapEdge(row, row - 1, step, diagonal_information(0.05, 0.005), "odometry")
        segment = 0 if segments is None else segments[row]
        keyframe = Keyframe(row, T, 2.0 * row, segment, 10.0, compact_of(row))
        slam_map = add_keyframe(slam_map, keyframe, T, np.ones(3), edge)
    return slam_map


def loop_between(truth: np.ndarray, source: int, target: int, error=None, status="accepted") -> Loop:
    T = rigid.inverse(truth[target]) @ truth[source]
    T = T if error is None else T @ error
    return Loop(source, target, "distance", status, 1.0, 0.9, 0.2, T, diagonal_information(0.2, 0.02))


def test_retrieval_returns_the_most_similar_of_those_that_are_allowed() -> None:
    vectors = np.random.default_rng(0).normal(size=(200, 32)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    is_allowed = np.arange(200) > 20
    # The mean is common to all places.
    centred = vectors - vectors.mean(axis=0)
    centred /= np.linalg.norm(centred, axis=1, keepdims=True)
    cosines = np.where(is_allowed, centred @ centred[57], -np.inf)
    rows, found = most_similar(vectors, vectors[57], 5, is_allowed=is_allowed)
    np.testing.assert_array_equal(rows, np.argsort(-cosines)[:5])
    np.testing.assert_allclose(found, cosines[rows], atol=1e-4)
    assert len(most_similar(vectors, vectors[3], 500, is_allowed=is_allowed)[0]) == 179
    assert len(most_similar(vectors[:0], vectors[0], 5)[0]) == 0
    # Of equal vectors the first are returned.
    np.testing.assert_array_equal(most_similar(vectors[[7] * 250], vectors[7], 16)[0], np.arange(16))


def test_pooling_ignores_order_and_padding() -> None:
    rng = np.random.default_rng(0)
    features, positions = rng.normal(size=(10, 4)).astype(np.float32), np.zeros((10, 3), np.float32)
    mask = np.arange(10) < 7
    order = np.append(rng.permutation(7), [7, 8, 9])
    dirty = np.where(mask[:, None], features, np.nan)[order]
    first = pooled_vector(DescriptorCloud(positions, features, mask))
    np.testing.assert_allclose(first, pooled_vector(DescriptorCloud(positions, dirty, mask)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(first), 1.0, atol=1e-6)
    assert not pooled_vector(DescriptorCloud(positions, features, np.zeros(10, bool))).any()


def test_candidates_are_old_and_near() -> None:
    truth = laps(2, side_m=40.0, step_m=2.0)
    slam_map = map_of(truth)
    row = len(truth) - 1
    near = [loop.target for loop in find_loop_candidates(slam_map, row) if loop.found_by == "distance"]
    assert row - len(truth) // 2 in near
    for candidate in near:
        assert slam_map.keyframes[row].path_m - slam_map.keyframes[candidate].path_m > 40.0
    assert not find_loop_candidates(slam_map, 3)


def test_nearest_pairs_are_those_of_a_search_by_hand() -> None:
    truth = laps(2, side_m=40.0, step_m=1.7)
    slam_map = map_of(truth, segments=[0] * 60 + [1] * (len(truth) - 60))
    expected = []
    for row in range(len(truth)):
        apart = []
        for other in range(row):
            is_chained = (row < 60) == (other < 60)
            if not is_chained or 2.0 * (row - other) > MIN_PATH_SHARE * 10.0:
                apart.append((float(np.linalg.norm(truth[row, :3, 3] - truth[other, :3, 3])), other))
        if apart and min(apart)[0] < 10.0:
            expected.append((min(apart)[0], row, min(apart)[1]))
    found = nearest_pairs(slam_map)
    np.testing.assert_allclose([pair[0] for pair in found], sorted(pair[0] for pair in expected), atol=1e-9)
    assert {pair[1] for pair in found} == {pair[1] for pair in expected}
    assert nearest_pairs(map_of(truth[:1])) == []


@pytest.mark.slow
def test_keyframes_that_an_optimisation_brings_together_are_compared_then() -> None:
    truth = laps(2, side_m=40.0, step_m=2.0)
    slam_map, half = map_of(truth), len(truth) // 2
    matcher = TruthMatcher(truth, gross_share=0.0)
    methods = SlamMethods(matcher, TruthGeometry(truth), SlamConfig())
    witness = [loop_between(truth, half + 4, 4), loop_between(truth, len(truth) - 1, half - 1)]
    state = LoopState(tuple(witness), len(truth))
    after = search_again(methods, slam_map, state)
    new = [loop for loop in after.loops if loop not in witness]
    assert 0 < len(new) <= MAX_AGAIN
    assert [loop.source for loop in after.loops] == sorted(loop.source for loop in after.loops)
    assert num_accepted(after.loops) > len(witness)
    for loop in new:
        assert loop.T_target_source is not None
        apart = rigid.inverse(truth[loop.target]) @ truth[loop.source]
        assert np.linalg.norm(apart[:3, 3] - loop.T_target_source[:3, 3]) < 0.6
    # No pair is compared twice, and the comparisons end.
    for _ in range(100):
        before, after = after, search_again(methods, slam_map, after)
        pairs = [(loop.source, loop.target) for loop in after.loops]
        assert len(set(pairs)) == len(pairs)
    assert after.loops == before.loops


def test_right_loops_agree_and_wrong_ones_do_not() -> None:
    truth = laps(2, side_m=40.0, step_m=2.0)
    slam_map = map_of(truth, sigma_m=0.02)
    half = len(truth) // 2
    right = [loop_between(truth, half + row, row, noise(np.random.default_rng(row), 0.1, 0.01)) for row in (5, 8)]
    wrong = loop_between(truth, half + 9, 9, pose(3.0, 0.0, 0.0))
    turned = loop_between(truth, half + 9, 9, pose(0.0, 0.0, 0.5))
    assert are_consistent(slam_map, *right)
    assert not are_consistent(slam_map, right[0], wrong)
    assert not are_consistent(slam_map, right[0], turned)
    # A loop does not support itself, and far loops do not support each other.
    assert not are_consistent(slam_map, right[0], right[0])
    assert not are_consistent(slam_map, right[0], loop_between(truth, half + 60, 60))


def test_a_wrong_loop_is_taken_back() -> None:
    truth = laps(2, side_m=40.0, step_m=2.0)
    slam_map = map_of(truth, sigma_m=0.05)
    half = len(truth) // 2
    loops = [loop_between(truth, half + row, row) for row in range(0, 40, 8)]
    wrong = [loop_between(truth, 70, 20), loop_between(truth, 71, 21)]
    wrong = [loop._replace(T_target_source=pose(1.0, 1.0, 0.3)) for loop in wrong]
    after, state = optimize_map(slam_map, LoopState((*loops, *wrong)))
    assert [loop.status for loop in state.loops] == ["accepted"] * 5 + ["taken back"] * 2
    assert sum(edge.kind == "loop" for edge in after.edges) == 5
    before, found = (
        absolute_trajectory_error(each.T_world_keyframe[:, :3, 3], truth[:, :3, 3]) for each in (slam_map, after)
    )
    assert found < 0.8 * before


def test_a_part_starts_where_a_loop_says() -> None:
    truth = laps(1, side_m=40.0, step_m=2.0)
    slam_map = map_of(truth, segments=[0] * 40 + [1] * 40)
    edges = [edge for edge in slam_map.edges if edge.source != 40]
    T_world_keyframe = slam_map.T_world_keyframe.copy()
    T_world_keyframe[40:] = pose(3000.0, -800.0, 3.0) @ T_world_keyframe[40:]
    apart = KeyframeMap(slam_map.keyframes, T_world_keyframe, slam_map.vectors, tuple(edges))
    loops = tuple(loop_between(truth, 79 - row, row) for row in (0, 3))
    after, state = optimize_map(apart, LoopState(loops))
    assert all(loop.status == "accepted" for loop in state.loops)
    np.testing.assert_allclose(after.T_world_keyframe, truth, atol=1e-3)


@pytest.mark.parametrize("num_keyframes", [1, 4])
def test_a_submap_is_in_the_frame_of_its_centre(num_keyframes) -> None:
    truth = laps(1, side_m=40.0, step_m=2.0)
    submap = submap_around(map_of(truth), 10, num_keyframes)
    numbers = [number_of(scan) for scan in submap.scans]
    assert numbers[0] == 10
    assert len(numbers) == num_keyframes
    expected = rigid.inverse(truth[10]) @ truth[numbers]
    np.testing.assert_allclose(submap.T_submap_keyframe, expected, atol=1e-9)


def test_a_guess_that_loops_replaced_does_not_bend_the_graph() -> None:
    truth = laps(1, side_m=40.0, step_m=2.0)
    truth = rigid.inverse(truth[0]) @ truth
    slam_map = map_of(truth, segments=[0] * 40 + [1] * (len(truth) - 40))
    guess = slam_map.edges[39]._replace(kind="guess", information=diagonal_information(1.0, 0.2))
    guess = guess._replace(T_target_source=guess.T_target_source @ pose(-10.0, 0, 0.6))
    slam_map = replace(slam_map, edges=(*slam_map.edges[:39], guess, *slam_map.edges[40:]))
    assert len(as_pose_graph(slam_map).edges.source) == len(slam_map.edges)
    loops = tuple(loop_between(truth, len(truth) - 1 - row, row) for row in (0, 3, 6))
    joined, _ = optimize_map(slam_map, LoopState(loops))
    solved = optimize_pose_graph(as_pose_graph(joined)).graph.poses
    for poses in (joined.T_world_keyframe, solved):
        np.testing.assert_allclose(poses, truth, atol=1e-6)
