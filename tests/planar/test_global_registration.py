"""Global registration: the exhaustive search of pairs, maps grown from pairs, and sequences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.scan import PlanarScans, planar_scans
from dpmjax.scan.planar import propose as pair_search
from dpmjax.scan.planar.propose import (
    CorrelativeConfig,
    Hypotheses,
    search_pairs,
)
from dpmjax.simulation import simulate_sequence
from dpmjax.slam import incremental_icp, nearest_tour, refine, register_globally
from dpmjax.slam.planar import global_registration
from dpmjax.slam.planar.global_registration import find_unregistered
from dpmjax.slam.planar.map_assembly import add_up, agreeing_edges, assemble, weakest_cuts
from tests.planar.conftest import ate, scans_of

# Coarse, so that a test takes a second. The laws do not depend on it.
COARSE = CorrelativeConfig(num_cells=64, cell=0.075, num_turns=72, block=8, num_levels=5, num_candidates=3)


@pytest.fixture(autouse=True)
def coarse_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_registration, "_SEARCH", COARSE)


@pytest.fixture(scope="module")
def sequence() -> ScanSequence:
    """Seven scans of the office, 60 px apart."""
    return simulate_sequence(0, 49, seed=1).take(slice(0, None, 8))


@pytest.fixture(scope="module")
def truth(sequence) -> np.ndarray:
    return sequence.reference_poses


@pytest.fixture(scope="module")
def scans(sequence) -> PlanarScans:
    return scans_of(sequence)


@pytest.fixture(scope="module")
def found(scans) -> Hypotheses:
    """All pairs, searched."""
    return search_pairs(scans, *np.tril_indices(len(scans), k=-1), COARSE)


def test_support_counts_by_rank_and_contradictions_in_full() -> None:
    # 3 + 2 / 2 - 1; nothing; all that contradicts.
    scores = np.array([[2.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 0.0], [-1.0, -2.0, 0.0, -4.0]])
    np.testing.assert_allclose(add_up(scores), [3.0, 0.0, -7.0], atol=1e-12)


@pytest.mark.slow
def test_search_finds_the_relative_pose_from_any_yaw(sequence, truth) -> None:
    # Scan 0, and scan 1 turned by each yaw: all are searched at once.
    yaws = np.array([0.0, 1.3, 3.1, -2.0])
    turned = [se2.transform_points(np.array([0.0, 0.0, -yaw]), sequence.points[1]) for yaw in yaws]
    some = planar_scans(np.stack([sequence.points[0], *turned]), sequence.mask[[0, 1, 1, 1, 1]])
    found = search_pairs(some, np.arange(1, 5), np.zeros(4, int), COARSE)
    expected = se2.relative(truth[0], truth[1] + yaws[:, None] * [0.0, 0.0, 1.0])
    first = np.unique(found.pair, return_index=True)[1]
    error = se2.relative(expected, found.poses[first])
    assert (np.hypot(error[:, 0], error[:, 1]) < 3.0).all()
    assert (np.abs(error[:, 2]) < 0.03).all()
    assert (found.scores[first] > found.scores[first + 1] + 20).all()


@pytest.mark.slow
def test_only_the_given_turns_are_searched(scans) -> None:
    turns = np.zeros((1, COARSE.num_turns), bool)
    turns[0, 18] = True
    found = search_pairs(scans, np.array([1]), np.array([0]), COARSE, turns=turns)
    # Refinement moves a heading by less than a turn.
    np.testing.assert_allclose(found.poses[:, 2], np.pi / 2, atol=2 * 2 * np.pi / COARSE.num_turns)


@pytest.mark.slow
def test_assembly_rejects_a_wrong_pair(sequence, scans, found) -> None:
    wrong = int(np.flatnonzero((found.source == 6) & (found.target == 0))[0])
    poses, scores = found.poses.copy(), found.scores.copy()
    poses[wrong] = [5.0, -20.0, 2.0]
    scores[wrong] = 0.9 * scores.max()
    candidates = found._replace(poses=poses, scores=scores)
    assembled = assemble(scans, candidates, is_ordered=False)
    assert ate(assembled, sequence.reference_poses) < 4.0
    edges = agreeing_edges(assembled, candidates, scans)
    assert not ((edges.source == 6) & (edges.target == 0)).any()


def test_weakest_cut_is_between_two_groups() -> None:
    values = np.full((5, 5), 100.0)
    values[3:, :3] = 0.0
    values[3, 1] = 10.0
    np.testing.assert_array_equal(weakest_cuts(np.tril(values, k=-1), 2)[0], [False, False, False, True, True])
    # A map of contradictions has cuts, too.
    assert len(weakest_cuts(np.full((3, 3), -5.0), 6)) == 2


@pytest.mark.slow
def test_shuffling_the_scans_permutes_the_result(sequence) -> None:
    order = np.array([3, 0, 6, 2, 5, 1, 4])
    one = register_globally(scans_of(sequence, is_ordered=False))
    shuffled = planar_scans(sequence.points[order], sequence.mask[order], is_ordered=False)
    other = register_globally(shuffled)
    assert ate(one, sequence.reference_poses) < 4.0
    assert absolute_trajectory_error(one[order][:, :2], other[:, :2]) < 4.0


def half_circle(sequence: ScanSequence) -> ScanSequence:
    """The same scans by a sensor that sees 180 degrees."""
    is_seen = np.abs(np.arctan2(sequence.points[..., 1], sequence.points[..., 0])) < np.pi / 2
    return replace(sequence, mask=sequence.mask & is_seen)


@pytest.mark.slow
@pytest.mark.parametrize(("is_ordered", "noise"), [(True, 2.0), (False, 0.0), (False, 2.0)])
def test_scans_are_registered_at_180_degrees_and_with_noise(is_ordered: bool, noise: float) -> None:
    # 30 px apart, so that half circles overlap; the world is 1024 px wide.
    walk = half_circle(simulate_sequence(0, 37, seed=1, range_noise_px=noise).take(slice(0, None, 4)))
    assert walk.mask.mean() < 0.6
    found = register_globally(scans_of(walk, is_ordered=is_ordered))
    assert ate(found, walk.reference_poses) < 4.0
    np.testing.assert_array_equal(found[0], np.zeros(3))


@pytest.mark.slow
def test_scans_beyond_the_keyframes_find_their_poses(sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_registration, "_MAX_KEYFRAMES", 4)
    assert ate(register_globally(scans_of(sequence, is_ordered=False)), sequence.reference_poses) < 4.0


@pytest.mark.slow
def test_refinement_without_order_is_exact(truth) -> None:
    sequence = simulate_sequence(0, 49, seed=1, num_beams=128).take(slice(0, None, 8))
    poses = truth + np.random.default_rng(0).normal(size=truth.shape) * [2.0, 2.0, 0.01]
    assert ate(refine(scans_of(sequence, is_ordered=False), poses).poses, sequence.reference_poses) < 0.05


@pytest.mark.slow
def test_unregistered_scans_do_not_support_each_other(walk, walk_scans) -> None:
    poses = np.array(walk.reference_poses)
    assert len(find_unregistered(walk_scans, poses)) == 0
    poses[[9, 10], :2] += 5000.0
    assert set(find_unregistered(walk_scans, poses)) == {9, 10}


def test_a_tour_goes_from_each_pose_to_the_nearest_left() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [1.0, 0.0, 3.0], [-2.5, 0.0, 0.0]])
    np.testing.assert_array_equal(nearest_tour(poses), [0, 2, 3, 1])


@pytest.fixture(scope="module")
def there() -> ScanSequence:
    """Thirteen scans of the office, 30 px apart."""
    return simulate_sequence(0, 49, seed=1).take(slice(0, None, 4))


@pytest.mark.slow
@pytest.mark.parametrize("num_torn", [1, 12])
def test_torn_steps_are_healed_from_the_scans_alone(there, monkeypatch: pytest.MonkeyPatch, num_torn: int) -> None:
    """One weak step starts the search of all pairs of few scans. Many scans need many weak steps."""
    walk, max_keyframes = (there.take(slice(0, None, 2)), 32) if num_torn == 1 else (there, 6)
    truth = np.asarray(walk.reference_poses)
    torn = se2.relative(truth[0], truth)
    for step in range(1, num_torn + 1):
        torn[step:] = se2.compose(np.array([400.0, -300.0, 1.0]), torn[step:])
    known = incremental_icp(scans_of(walk.take(slice(2))))
    monkeypatch.setattr(global_registration, "incremental_icp", lambda _: known._replace(poses=torn))
    monkeypatch.setattr(global_registration, "_MAX_KEYFRAMES", max_keyframes)
    assert ate(torn, truth) > 50.0
    assert ate(register_globally(scans_of(walk)), truth) < 4.0


@pytest.mark.slow
def test_a_sequence_of_strong_steps_needs_no_other_search(there, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(global_registration, "search_pairs", None)
    assert ate(register_globally(scans_of(there)), np.asarray(there.reference_poses)) < 1.0


@pytest.mark.slow
def test_a_robot_may_go_out_and_back_between_two_keyframes(there, monkeypatch: pytest.MonkeyPatch) -> None:
    out = there.take(slice(5))
    truth = np.asarray(out.reference_poses)
    turns = np.arange(1, 5) * np.pi / 4
    poses = np.concatenate(
        [truth, truth[-1] + turns[:, None] * [0.0, 0.0, 1.0], truth[-2::-1] + np.array([0.0, 0.0, np.pi])]
    )
    rows = np.concatenate([np.arange(5), np.full(4, 4), np.arange(3, -1, -1)])
    turned = se2.transform_points(se2.relative(poses, out.reference_poses[rows]), out.points[rows])
    # Both keyframes lie where the robot starts and ends.
    monkeypatch.setattr(global_registration, "_MAX_KEYFRAMES", 2)
    scans = planar_scans(turned.astype(np.float32), out.mask[rows])
    assert ate(register_globally(scans), poses) < 2.0
    # The sequence tells nothing.
    monkeypatch.setattr(global_registration, "weak_steps", lambda *_: np.ones(len(scans) - 1, bool))
    assert ate(register_globally(scans), poses) < 4.0


@pytest.mark.slow
def test_pairs_in_batches_are_those_of_one_search(there, monkeypatch: pytest.MonkeyPatch) -> None:
    scans, source, target = scans_of(there), np.array([5, 1, 3, 1, 2]), np.array([4, 0, 2, 3, 1])
    turns = np.zeros((5, COARSE.num_turns), bool)
    turns[:, [0, 1, -1]] = True
    search = COARSE._replace(num_levels=1)
    whole = search_pairs(scans, source, target, search, turns=turns)
    monkeypatch.setattr(pair_search, "_SEARCH_BATCH", 2)
    batched = search_pairs(scans, source, target, search, turns=turns)
    np.testing.assert_array_equal(whole.source[np.unique(whole.pair, return_index=True)[1]], source)
    np.testing.assert_array_equal(batched.target, whole.target)
    np.testing.assert_allclose(batched.poses, whole.poses, atol=1e-4)
    np.testing.assert_allclose(batched.scores, whole.scores, rtol=1e-4)
