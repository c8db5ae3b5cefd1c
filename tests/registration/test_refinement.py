"""The polish, and the loops before it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.pose_graph.planar import Edges
from dpmjax.registration import LoopConfig, PolishConfig, close_loops, length_scale, polish
from dpmjax.registration.line_fitting import fit_lines
from dpmjax.registration.loop_closure import count_support, find_candidates, step_edges
from dpmjax.registration.refinement import choose_pairs, match_steps
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet

WITHOUT_LOOPS = PolishConfig(loops=None)


def ate(poses: np.ndarray, reference: np.ndarray) -> float:
    return absolute_trajectory_error(poses[:, :2], reference[:, :2])


def shaken(poses: np.ndarray, px: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return poses + np.concatenate([np.zeros((1, 3)), rng.normal(size=(len(poses) - 1, 3)) * [px, px, 0.01 * px]])


@pytest.mark.parametrize("px", [5.0, 10.0])
def test_polish_is_exact_without_noise(walk, walk_lines, px: float) -> None:
    start = shaken(walk.reference_poses, px)
    polished = polish(walk_lines, start, WITHOUT_LOOPS)
    assert ate(start, walk.reference_poses) > 0.8 * px
    assert ate(polished.poses, walk.reference_poses) < 0.01
    assert polished.rmse < 0.05
    np.testing.assert_allclose(polished.poses[0], start[0], atol=1e-4)


def test_polish_is_bounded_under_noise(noisy_walk, noisy_walk_lines) -> None:
    assert (
        ate(polish(noisy_walk_lines, shaken(noisy_walk.reference_poses, 5.0)).poses, noisy_walk.reference_poses) < 0.7
    )


def test_polish_never_uses_masked_beams(walk) -> None:
    mask = walk.mask & (np.random.default_rng(2).uniform(size=walk.mask.shape) < 0.9)
    start = shaken(walk.reference_poses, 5.0)
    results = []
    for filling in (0.0, 77.0, np.nan):
        points = np.where(mask[..., None], walk.points, np.float32(filling))
        results.append(polish(fit_lines(ScanSet(jnp.asarray(points), jnp.asarray(mask))), start, WITHOUT_LOOPS).poses)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])
    assert ate(results[0], walk.reference_poses) < 0.05


def test_polish_stays_in_the_world_of_the_start(walk, walk_lines) -> None:
    offset = np.array([[1000.0, -500.0, 2.0]])
    polished = polish(walk_lines, se2.compose(offset, walk.reference_poses), WITHOUT_LOOPS)
    np.testing.assert_allclose(polished.poses, se2.compose(offset, walk.reference_poses), atol=0.05)


def test_pairs_are_neighbours_in_time_and_of_other_visits() -> None:
    out = np.stack([10.0 * np.arange(30), np.zeros(30), np.zeros(30)], -1)
    poses = np.concatenate([out, out[::-1] + np.array([0.0, 1.0, 0.0])])
    source, target = choose_pairs(poses, PolishConfig(num_spatial=2), scale=10.0)
    temporal = {(s, t) for s, t in zip(source, target, strict=True) if 1 <= s - t <= 3}
    assert len(temporal) == 59 + 58 + 57
    assert (5, 54) in set(zip(source.tolist(), target.tolist(), strict=True))
    away = np.abs(source - target) > 3
    assert np.hypot(*(poses[source[away]] - poses[target[away]])[:, :2].T).max() <= 40.0
    assert (np.bincount(source[away], minlength=60) <= 2).all()


# A walk of five rounds would take minutes; a short way there and back sees every place twice.
@pytest.fixture(scope="module")
def revisit() -> ScanSequence:
    there = simulate_sequence(0, 30, num_beams=64, seed=1)
    order = np.concatenate([np.arange(30), np.arange(28, -1, -1)])
    return ScanSequence(
        "there-and-back", there.points[order], there.mask[order], "px", reference_poses=there.reference_poses[order]
    )


def test_a_drifted_trajectory_is_closed(revisit, monkeypatch) -> None:
    monkeypatch.setattr(
        "dpmjax.registration.loop_closure._BATCH", 128
    )  # a batch is filled up, and here are few candidates
    lines = fit_lines(ScanSet(jnp.asarray(revisit.points), jnp.asarray(revisit.mask)))
    scale = length_scale(lines)
    true = revisit.reference_poses
    steps = se2.relative(true[:-1], true[1:])
    drifted = se2.chain(steps * [1.05, 1.05, 1.0] + [0.0, 0.0, np.radians(0.5)])
    config = LoopConfig(min_way=2.0, drift=0.2, num_rounds=1, max_candidates=128)
    closed, loops, weight = close_loops(lines, drifted, step_edges(drifted, None, config, scale), config)
    assert len(loops.source) == len(weight) > 10
    assert (loops.source > loops.target).all()
    kept = se2.relative(true[loops.target], true[loops.source])[weight > 0.5]
    assert np.median(np.abs(loops.poses[weight > 0.5] - kept)[:, :2]) < 1.0
    assert ate(closed, true) < 0.5 * ate(drifted, true)


def test_a_trajectory_without_revisits_is_left_alone(walk_lines) -> None:
    line = np.stack([60.0 * np.arange(24), np.zeros(24), np.zeros(24)], -1)
    config = LoopConfig()
    closed, loops, weight = close_loops(walk_lines, line, step_edges(line, None, config, 10.0), config)
    np.testing.assert_array_equal(closed, line)
    assert len(loops.source) == len(weight) == 0


def test_candidates_are_near_in_space_and_far_along_the_way() -> None:
    angle = np.linspace(0.0, 4 * np.pi, 60)
    poses = np.stack([30 * np.cos(angle), 30 * np.sin(angle), angle], -1)
    source, target = find_candidates(poses, LoopConfig(min_way=15.0, drift=0.0), scale=5.0)
    assert len(source)
    assert (np.hypot(*(poses[source] - poses[target])[:, :2].T) < 10.0).all()
    assert (source - target > 5).all()
    few, _ = find_candidates(poses, LoopConfig(min_way=15.0, drift=0.0, max_candidates=7), scale=5.0)
    assert len(few) == 7


def test_a_lie_has_no_company() -> None:
    poses = np.zeros((40, 3))
    source, target = np.array([30, 31, 32, 33]), np.array([1, 2, 3, 4])
    said = np.zeros((4, 3))
    said[2] = [50.0, 0.0, 0.0]
    edges = Edges(source, target, said, np.zeros((4, 3, 3)))
    assert count_support(edges, poses, LoopConfig(), 10.0).tolist() == [2, 2, 0, 2]


def test_steps_are_matched_where_they_are(walk, walk_lines) -> None:
    matches = match_steps(walk_lines, walk.reference_poses, scale=length_scale(walk_lines))
    true = se2.relative(walk.reference_poses[:-1], walk.reference_poses[1:])
    assert np.median(np.abs(matches.poses - true)[:, :2]) < 0.01
