"""The refinement, and the loops before it."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.pose_graph.graph import Edges
from dpmjax.scan import planar_scans
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.simulation import simulate_sequence
from dpmjax.slam import correct_by_loops, refine
from dpmjax.slam.planar import loops as loop_closure
from dpmjax.slam.planar import refine as refinement
from dpmjax.slam.planar.joint import choose_pairs
from dpmjax.slam.planar.loops import count_support, find_candidates
from dpmjax.types import ScanSet
from tests.planar.conftest import ate


@pytest.fixture
def without_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "_is_sound", lambda *_: True)


def shaken(poses: np.ndarray, px: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return poses + np.concatenate([np.zeros((1, 3)), rng.normal(size=(len(poses) - 1, 3)) * [px, px, 0.01 * px]])


@pytest.mark.slow
def test_refinement_is_exact_without_noise(walk, walk_scans, without_loops) -> None:
    # In the world of the start, wherever it is.
    start = se2.compose(np.array([1000.0, -500.0, 2.0]), shaken(walk.reference_poses, 10.0))
    refined = refine(walk_scans, start)
    assert ate(start, walk.reference_poses) > 8.0
    assert ate(refined.poses, walk.reference_poses) < 0.01
    np.testing.assert_allclose(refined.poses[0], start[0], atol=1e-4)


@pytest.mark.slow
def test_refinement_is_bounded_under_noise(noisy_walk, noisy_walk_scans) -> None:
    refined = refine(noisy_walk_scans, shaken(noisy_walk.reference_poses, 5.0))
    assert ate(refined.poses, noisy_walk.reference_poses) < 0.7


@pytest.mark.slow
def test_refinement_never_uses_masked_beams(walk, without_loops) -> None:
    mask = walk.mask & (np.random.default_rng(2).uniform(size=walk.mask.shape) < 0.9)
    start = shaken(walk.reference_poses, 5.0)
    results = []
    some_or_nothing = np.where(np.arange(mask.shape[1]) % 2, 77.0, np.nan)[:, None]
    for filling in (0.0, some_or_nothing):
        points = np.where(mask[..., None], walk.points, filling).astype(np.float32)
        results.append(refine(planar_scans(points, mask), start).poses)
    np.testing.assert_array_equal(results[0], results[1])
    assert ate(results[0], walk.reference_poses) < 0.05


@pytest.mark.slow
def test_two_scans_that_share_nothing_are_refined_without_pairs(walk) -> None:
    """Both stand at one place, where their surroundings contradict each other, by odometry that may be off by far."""
    ends = [0, len(walk.points) // 2]
    scans = planar_scans(walk.points[ends], walk.mask[ends])
    poses = np.zeros((2, 3))
    prior = StepPrior(poses[1:], np.array([[scans.typical_range, scans.typical_range, 1.0]]))
    refined = refine(scans, poses, prior=prior)
    assert np.isfinite(refined.poses).all()


@pytest.mark.slow
def test_scans_as_a_user_has_them_are_those_of_the_record(walk, without_loops) -> None:
    few = walk.take(slice(0, 6))
    arrays = np.where(few.mask[..., None], few.points, np.nan)
    start = shaken(few.reference_poses, 3.0)
    expected = refine(planar_scans(few.points, few.mask), start)
    for scans, poses in ((arrays, start), (ScanSet(few.points, few.mask), se2.to_matrix(start))):
        np.testing.assert_allclose(refine(scans, poses).poses, expected.poses, atol=1e-6)
    np.testing.assert_array_equal(expected.T_world_scan, se2.to_matrix(expected.poses))


@pytest.mark.parametrize(
    ("poses", "message"),
    [(np.zeros((3, 3)), "poses: expected shape"), (np.full((24, 3), np.nan), "poses: expected")],
)
def test_bad_poses_are_named(walk_scans, poses, message) -> None:
    with pytest.raises(ValueError, match=message):
        refine(walk_scans, poses)
    with pytest.raises(ValueError, match="scans: expected shape"):
        refine(np.zeros((24, 3)), poses)


def test_pairs_are_the_nearest_scans_that_look_alike() -> None:
    out = np.stack([10.0 * np.arange(30), np.zeros(30), np.zeros(30)], axis=1)
    back = out[::-1] + np.array([0.0, 1.0, np.pi])
    source, target = choose_pairs(np.concatenate([out, back]), 41.0)
    # The way back sees other walls.
    assert ((source < 30) == (target < 30)).all()
    assert np.bincount(source).tolist() == 2 * [*range(4, 8), *(22 * [8]), *range(7, 3, -1)]
    assert np.abs(source - target).max() == 4


# A walk of five rounds would take minutes; a short way there and back sees every place twice.
@pytest.fixture(scope="module")
def revisit() -> ScanSequence:
    there = simulate_sequence(0, 59, num_beams=64, seed=1).take(slice(0, None, 2))
    order = np.concatenate([np.arange(30), np.arange(28, -1, -1)])
    return ScanSequence(
        "there-and-back", there.points[order], there.mask[order], "px", reference_poses=there.reference_poses[order]
    )


@pytest.mark.slow
def test_a_drifted_trajectory_is_closed(revisit, monkeypatch) -> None:
    # A batch is filled up, and here are few candidates.
    for name, value in {"_BATCH": 128, "_DRIFT": 0.2, "_NUM_ROUNDS": 1}.items():
        monkeypatch.setattr(loop_closure, name, value)
    scans = planar_scans(revisit.points, revisit.mask)
    true = revisit.reference_poses
    steps = se2.relative(true[:-1], true[1:])
    drifted = se2.chain(steps * [1.05, 1.05, 1.0] + [0.0, 0.0, np.radians(0.5)])
    closed, loops, weight = correct_by_loops(scans, drifted)
    assert len(loops.source) == len(weight) > 10
    assert (loops.source > loops.target).all()
    kept = se2.relative(true[loops.target], true[loops.source])[weight > 0.5]
    assert np.median(np.abs(loops.measurements[weight > 0.5] - kept)[:, :2]) < 1.0
    assert ate(closed, true) < 0.5 * ate(drifted, true)


def test_a_trajectory_without_revisits_is_left_alone(walk_scans) -> None:
    line = np.stack([60.0 * np.arange(24), np.zeros(24), np.zeros(24)], -1)
    closed, loops, weight = correct_by_loops(walk_scans, line)
    np.testing.assert_array_equal(closed, line)
    assert len(loops.source) == len(weight) == 0


def test_of_too_many_candidates_those_are_kept_that_are_near(monkeypatch) -> None:
    monkeypatch.setattr(loop_closure, "_DRIFT", 0.0)
    angle = np.linspace(0.0, 4 * np.pi, 400)
    poses = np.stack([30 * np.cos(angle), 30 * np.sin(angle), angle], -1)
    source, target = find_candidates(poses, typical_range=33.0)
    later, earlier = np.tril_indices(400, k=-6)
    apart = np.hypot(*(poses[later] - poses[earlier])[:, :2].T)
    may = (apart < 9.9) & (se2.driven_lengths(poses)[later] - se2.driven_lengths(poses)[earlier] > 2.25 * 33.0)
    assert len(source) == 2000 < 0.5 * may.sum()
    assert np.median(np.hypot(*(poses[source] - poses[target])[:, :2].T)) < 0.6 * np.median(apart[may])


@pytest.mark.slow
def test_a_wrong_loop_has_no_support() -> None:
    poses = np.zeros((40, 3))
    source, target = np.array([30, 31, 32, 33]), np.array([1, 2, 3, 4])
    measured = np.zeros((4, 3))
    measured[2] = [50.0, 0.0, 0.0]
    edges = Edges(source, target, measured, np.zeros((4, 3, 3)))
    assert count_support(edges, poses, 10.0).tolist() == [2, 2, 0, 2]
