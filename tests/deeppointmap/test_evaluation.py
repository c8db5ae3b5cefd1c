"""Pairs of a drive, registered stage by stage and compared with the truth; overlap of pairs."""

from dataclasses import replace

import numpy as np
import pytest

import dpmjax
from dpmjax import deeppointmap as dpm
from dpmjax.deeppointmap.confidence import gather_evidence
from dpmjax.metrics import area_under_curve, brier_score, expected_calibration_error
from dpmjax.sequences import LidarSequence
from tests.deeppointmap import toy


@pytest.mark.slow
def test_head_and_regression_answer_for_the_same_pairs(model) -> None:
    always = dpm.LogisticModel(dpm.OVERLAP_FEATURES, (0.0,) * len(dpm.OVERLAP_FEATURES), 1.0)
    both = model.replace(config=replace(model.config, overlap=always))
    found, alone = dpm.evaluate_overlap(both, toy.drive(), 4), dpm.evaluate_overlap(model, toy.drive(), 4)
    np.testing.assert_allclose(found.probability, 1 / (1 + np.exp(-1)), rtol=1e-5)
    np.testing.assert_array_equal(found.by_head, alone.probability)
    assert alone.by_head is None


def test_a_scan_without_a_reference_hides_no_revisit() -> None:
    there = toy.drive(num_scans=40).T_world_lidar
    poses = np.concatenate([there, there[::-1]])
    drive = replace(drive_along(np.zeros((80, 2))), T_world_lidar=poses)
    near, far, has_revisits = dpm.overlap_candidates(drive)
    poses = poses.copy()
    poses[5] = np.nan
    near_known, far_known, has_known = dpm.overlap_candidates(replace(drive, T_world_lidar=poses))
    assert has_revisits
    assert has_known
    np.testing.assert_array_equal(near_known, [pair for pair in near.tolist() if 5 not in pair])
    np.testing.assert_array_equal(far_known, [pair for pair in far.tolist() if 5 not in pair])


def test_clouds_have_the_evidence_of_their_own_best_motion(model) -> None:
    drive = toy.drive()
    (pair,) = dpm.read_scan_pairs(drive, dpm.draw_scan_pairs(drive, "near", 1))
    clouds = [dpmjax.encode(model, points) for points in (pair.source, pair.target)]
    expected = gather_evidence(dpm.match_clouds(model, *clouds, config=model.config.matching), 0, None)
    T_target_source, evidence = dpm.register_clouds(model, *clouds)
    np.testing.assert_allclose(evidence.of_clouds, expected.of_clouds, rtol=1e-5)
    assert evidence.of_elements is None  # these clouds have fewer than 512
    assert evidence.of_scans is None
    refined = dpmjax.register(model, *clouds, refine=True)
    np.testing.assert_allclose(T_target_source, refined.T_target_source, atol=1e-5)


def test_pairs_have_the_motion_of_their_poses() -> None:
    """World points that both scans see coincide under the true motion, whatever the yaws."""
    drive = toy.drive()
    (pair,) = dpm.read_scan_pairs(drive, dpm.draw_scan_pairs(drive, "near", 1, seed=3), seed=3)
    moved = pair.source @ pair.T_target_source[:3, :3].T + pair.T_target_source[:3, 3]
    distances = np.linalg.norm(moved[:, None] - pair.target[None], axis=2).min(axis=1)
    assert np.quantile(distances, 0.3) < 1e-3


@pytest.mark.parametrize(("band", "low", "high"), [("near", 2, 10), ("middle", 10, 20), ("far", 60, np.inf)])
def test_pairs_are_as_far_apart_as_their_band_says(band: str, low: float, high: float) -> None:
    drive = toy.drive()
    pairs = dpm.draw_scan_pairs(drive, band, 7)
    assert len(pairs) == 7
    distances = np.linalg.norm(np.diff(drive.T_world_lidar[pairs, :3, 3], axis=1)[:, 0], axis=1)
    assert ((distances >= low) & (distances <= high)).all()
    np.testing.assert_array_equal(pairs, dpm.draw_scan_pairs(drive, band, 7))


def test_the_refined_motion_is_that_of_register(model) -> None:
    drive = toy.drive()
    pairs = list(dpm.read_scan_pairs(drive, dpm.draw_scan_pairs(drive, "near", 3)))
    for pair in pairs:
        match = dpmjax.register(model, pair.source, pair.target, refine=True)
        np.testing.assert_allclose(match.T_target_source, dpm.register_in_stages(model, pair).refined, atol=1e-4)


def test_without_pairs_an_evaluation_is_empty(model) -> None:
    none = dpm.evaluate_overlap(model, toy.drive(num_scans=4), 5)
    assert len(none.probability) == 0
    assert np.isnan(area_under_curve(none.probability, none.is_overlap))


def test_a_drive_without_poses_has_no_pairs() -> None:
    with pytest.raises(ValueError, match="expected a true pose for each scan, got none in toy 0"):
        dpm.draw_scan_pairs(replace(toy.drive(), T_world_lidar=None), "near", 1)
    with pytest.raises(ValueError, match="expected a true pose for each scan"):
        dpm.split_places(replace(toy.drive(), T_world_lidar=None))


def test_area_under_curve_counts_pairs_and_ties_count_half() -> None:
    rng = np.random.default_rng(0)
    score, label = rng.integers(0, 5, 60), rng.random(60) < 0.4
    slow = np.mean([(p > n) + 0.5 * (p == n) for p in score[label] for n in score[~label]])
    assert area_under_curve(score.astype(float), label) == pytest.approx(slow)
    assert np.isnan(area_under_curve(np.ones(3), np.ones(3, bool)))


def test_calibration_error_is_the_gap_of_each_bin() -> None:
    probability = np.array([0.95, 1.0, 0.91, 0.2, 0.25])
    is_true = np.array([True, True, False, False, True])
    expected = (abs(0.95 + 1.0 + 0.91 - 2) + abs(0.2 + 0.25 - 1)) / 5
    assert expected_calibration_error(probability, is_true) == pytest.approx(expected)
    assert np.isnan(expected_calibration_error(np.zeros(0), np.zeros(0, bool)))


def test_brier_score_is_the_mean_squared_error() -> None:
    assert brier_score(np.array([1.0, 0.0, 0.5]), np.array([True, True, False])) == pytest.approx((0 + 1 + 0.25) / 3)
    assert np.isnan(brier_score(np.zeros(0), np.zeros(0, bool)))


def drive_along(positions: np.ndarray) -> LidarSequence:
    """A drive with these positions, whose scans are never read."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :2, 3] = positions
    return LidarSequence("made up", tuple(map(str, range(len(poses)))), lambda _: np.zeros((0, 3), np.float32), poses)


def line(num: int, step_m: float) -> np.ndarray:
    return np.stack([step_m * np.arange(num), np.zeros(num)], axis=1)


@pytest.mark.parametrize(("num", "step_m", "margin_m"), [(401, 2.0, 20.0), (101, 1.0, 10.0)])
def test_the_last_tenth_of_the_path_is_held_out_with_a_margin(num: int, step_m: float, margin_m: float) -> None:
    split = dpm.split_places(drive_along(line(num, step_m)))
    length_m = (num - 1) * step_m
    assert np.all(split.held_out * step_m > 0.9 * length_m)
    assert len(split.held_out) == round(0.1 * (num - 1))
    assert split.held_out[0] * step_m - split.training.max() * step_m >= margin_m
    np.testing.assert_array_equal(split.training, np.arange(len(split.training)))


def test_an_earlier_pass_of_a_held_out_place_is_not_trained_on() -> None:
    angles = np.linspace(0, 4 * np.pi, 800, endpoint=False)
    circle = 100 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    split = dpm.split_places(drive_along(circle))
    apart = np.linalg.norm(circle[split.training][:, None] - circle[split.held_out], axis=2)
    assert apart.min() >= 20.0
    assert split.held_out.min() > 700
    assert {row < 400 for row in split.training.tolist()} == {True, False}


@pytest.mark.parametrize("positions", [np.zeros((30, 2)), line(1, 1.0), np.zeros((0, 2))], ids=["room", "one", "none"])
def test_where_too_little_would_remain_nothing_is_held_out(positions: np.ndarray) -> None:
    split = dpm.split_places(drive_along(positions))
    assert (len(split.training), len(split.held_out)) == (len(positions), 0)
