"""Scores of trajectories, the choice among them, and trust, without the truth."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import planar_scans
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.simulation import scan_world, simulate_sequence
from dpmjax.slam import assess_trajectory, choose_trajectory
from dpmjax.slam.planar import assess as quality
from dpmjax.slam.planar.assess import map_code_length, view_misfit


def shaken(poses: np.ndarray, px: float, seed: int = 0) -> np.ndarray:
    return poses + np.random.default_rng(seed).normal(size=poses.shape) * [px, px, 0.002 * px]


def test_larger_errors_need_more_nats(walk, walk_scans) -> None:
    true = walk.reference_poses
    lengths = [map_code_length(walk_scans, shaken(true, px)) for px in (0.0, 0.5, 1.0, 4.0, 16.0)]
    assert lengths == sorted(lengths)
    turned = true.copy()
    turned[15, 2] += 0.3
    assert lengths[0] < map_code_length(walk_scans, turned)


@pytest.mark.parametrize("offset", [(300.0, -1234.5, 0.7), (-17.3, 5.1, 3.0)])
def test_code_length_does_not_depend_on_the_world_frame(walk, walk_scans, offset) -> None:
    moved = se2.compose(np.array([offset]), walk.reference_poses)
    expected = map_code_length(walk_scans, walk.reference_poses)
    assert map_code_length(walk_scans, moved) == pytest.approx(expected, rel=0.03)


def test_the_better_of_two_trajectories_is_chosen(walk, walk_scans) -> None:
    true = walk.reference_poses
    torn = true.copy()
    torn[12:] += [60.0, -40.0, 0.3]
    # Nearly the same map: its surfaces decide. Another map, though each half is sharp: its code length decides.
    for worse in (shaken(true, 0.3), torn):
        chosen, scores = choose_trajectory(walk_scans, {"worse": worse, "true": true})
        assert chosen == "true"
        assert set(scores) == {"worse", "true"}
    assert scores["worse"].code_length > 1.1 * scores["true"].code_length


def test_the_sharper_map_is_not_chosen_where_it_is_the_wrong_map(walk, walk_scans) -> None:
    # All scans far from each other: no surface contradicts another, and no map needs more words.
    true = walk.reference_poses
    scattered = true + 5000.0 * np.arange(len(true))[:, None] * [1.0, 0.0, 0.0]
    assert choose_trajectory(walk_scans, {"scattered": scattered, "shaken": shaken(true, 1.0)})[0] == "shaken"


@pytest.mark.slow
@pytest.mark.parametrize("world", ["grove", 0])
def test_the_sharper_of_two_near_maps_is_chosen_with_and_without_walls(world) -> None:
    sequence = simulate_sequence(world, 41, seed=2, num_beams=128, range_noise_px=2.0).take(slice(0, None, 4))
    scans, true = planar_scans(sequence.points, sequence.mask), sequence.reference_poses
    misfits = [view_misfit(scans, shaken(true, px)) for px in (0.0, 1.0, 3.0, 9.0)]
    assert misfits == sorted(misfits)
    assert choose_trajectory(scans, {"shaken": shaken(true, 1.0), "true": true})[0] == "true"


@pytest.mark.parametrize(("noise_px", "expected"), [(1.0, "sharp"), (15.0, "short")])
def test_surfaces_decide_only_where_the_noise_lets_them(noise_px: float, expected: str, monkeypatch) -> None:
    sequence = simulate_sequence(0, 21, seed=2, num_beams=128, range_noise_px=noise_px).take(slice(0, None, 4))
    scans, true = planar_scans(sequence.points, sequence.mask), sequence.reference_poses
    scores = {0: (1.0, 0.5), 1: (1.05, 0.4), 2: (1.2, 0.3)}

    def score(poses: np.ndarray) -> tuple[float, float]:
        return scores[round(poses[0, 0] - true[0, 0])]

    monkeypatch.setattr(quality, "map_code_length", lambda _, poses: score(poses)[0])
    monkeypatch.setattr(quality, "view_misfit", lambda _, poses: score(poses)[1])
    candidates = {"short": true, "sharp": true + 1.0, "long": true + 2.0}
    assert choose_trajectory(scans, candidates)[0] == expected


@pytest.mark.slow
def test_misfit_is_the_share_of_the_visible_beams_in_a_square_room() -> None:
    room = np.ones((202, 202), bool)
    room[1:-1, 1:-1] = False
    poses = np.array([[101.0, 101.0, 0.0], [101.0, 101.0, 0.5]])
    scans = planar_scans(*scan_world(room, poses))
    assert view_misfit(scans, poses) < 0.1
    moved = poses + np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    # A quarter of the beams ends 5 px before a wall, and a quarter behind one, out of view.
    assert view_misfit(scans, moved) == pytest.approx(1 / 3, abs=0.05)
    # Two scans a world apart share no visible surface.
    assert view_misfit(scans, poses + np.array([[0.0, 0.0, 0.0], [5000.0, 0.0, 0.0]])) == pytest.approx(1.0)


def test_scans_of_single_beams_have_a_code_length(walk) -> None:
    """Every second beam is missing: no beam lies on a line."""
    mask = np.array(walk.mask)
    mask[:, 1::2] = False
    assert np.isfinite(map_code_length(planar_scans(walk.points, mask), walk.reference_poses))


def test_truth_is_trusted_in_any_frame_and_torn_or_collapsed_maps_are_not(walk, walk_scans) -> None:
    scans, true = walk_scans, walk.reference_poses
    one, other = (assess_trajectory(scans, true + offset) for offset in (0.0, np.array([500.0, -300.0, 0.0])))
    assert one.is_trusted
    assert one.contradiction < 0.01
    assert one.weakest_connection == pytest.approx(other.weakest_connection, abs=1e-3)
    is_second_half = (np.arange(len(true)) >= len(true) // 2)[:, None]
    for wrong in (true + is_second_half * [80.0, 0.0, 0.0], true + is_second_half * [0.0, 0.0, 0.6], 0.0 * true):
        assert not assess_trajectory(scans, wrong).is_trusted


@pytest.mark.slow
@pytest.mark.parametrize(("num_lost", "is_trusted"), [(2, True), (3, False)])
def test_a_way_that_is_lost_is_not_trusted(num_lost: int, is_trusted: bool) -> None:
    sequence = simulate_sequence(0, 41, seed=1)
    scans, poses = planar_scans(sequence.points, sequence.mask), sequence.reference_poses.copy()
    prior = StepPrior.of_poses(poses, scans.typical_range)
    poses[20 : 20 + num_lost, 0] += 1e4 * np.arange(1, 1 + num_lost)
    found = assess_trajectory(scans, poses, prior=prior)
    assert found.is_trusted == is_trusted
    assert found.uncertain_scans == tuple(range(20, 20 + num_lost))


def test_a_map_drowned_in_noise_is_not_trusted() -> None:
    sequence = simulate_sequence(0, 41, seed=1, range_noise_px=12.0).take(slice(0, None, 4))
    scans = planar_scans(sequence.points, sequence.mask)
    assert not assess_trajectory(scans, sequence.reference_poses).is_trusted


@pytest.mark.slow
@pytest.mark.parametrize("noise_m", [0.0, 0.005])
def test_round_walls_constrain_no_turn(noise_m: float) -> None:
    """The truth fits as well as each turn about the middle: only odometry tells them apart."""
    angle, rng = 2 * np.pi * np.arange(256) / 256, np.random.default_rng(0)
    beams = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heading = 0.1 * np.arange(12)
    poses = np.column_stack([2.5 * np.cos(heading), 2.5 * np.sin(heading), heading])
    along = beams @ np.array([2.5, 0.0])
    ranges = -along + np.sqrt(along**2 - 2.5**2 + 5.0**2) + rng.normal(0, noise_m, (12, 256))
    scans = planar_scans((ranges[..., None] * beams).astype(np.float32))
    found = assess_trajectory(scans, poses)
    assert not found.is_trusted
    assert found.uncertain_scans == tuple(range(12))
    assert assess_trajectory(scans, poses, prior=StepPrior.of_poses(poses, scans.typical_range)).uncertain_scans == ()
