"""Whole recordings: the choice of the registered scans, and the poses of the scans between."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import planar_scans
from dpmjax.simulation import make_world, scan_world, simulate_sequence
from dpmjax.slam.planar.recordings import (
    Recording,
    align_between,
    choose_by_motion,
    choose_scans,
    fill_between,
    find_silent_steps,
    in_runs,
)
from dpmjax.types import ScanSet


def drive(num_scans: int = 60, *, seed: int = 0) -> np.ndarray:
    """A wheel odometry of small steps."""
    rng = np.random.default_rng(seed)
    steps = np.column_stack(
        [rng.uniform(0, 0.2, num_scans - 1), np.zeros(num_scans - 1), rng.normal(0, 0.1, num_scans - 1)]
    )
    return se2.chain(steps)


def test_chosen_scans_lie_apart_and_standing_still_adds_none() -> None:
    straight = np.column_stack([0.1 * np.arange(21.0), np.zeros(21), np.zeros(21)])
    still = np.repeat(straight, 3, axis=0)
    np.testing.assert_array_equal(choose_by_motion(straight, 0.499, 1.0), [0, 5, 10, 15, 20])
    assert [row // 3 for row in choose_by_motion(still, 0.499, 1.0)][:-1] == [0, 5, 10, 15, 20]
    turning = np.column_stack([np.zeros(11), np.zeros(11), np.pi - 0.5 + 0.1 * np.arange(11)])
    np.testing.assert_array_equal(choose_by_motion(turning, 1.0, 0.399), [0, 4, 8, 10])


@pytest.mark.parametrize(("seed", "distance"), [(0, 0.05), (1, 0.4), (2, 1.0), (3, 5.0)])
def test_every_scan_is_near_a_chosen_one(seed: int, distance: float) -> None:
    odometry = drive(seed=seed)
    chosen = choose_by_motion(odometry, distance, 0.5)
    assert chosen[0] == 0
    assert chosen[-1] == len(odometry) - 1
    for start, end in pairwise(chosen):
        between = se2.relative(odometry[start], odometry[start:end])
        assert np.hypot(between[:, 0], between[:, 1]).max() < distance
        assert np.abs(se2.wrap_angle(between[:, 2])).max() < 0.5


def test_a_wheel_that_is_too_large_is_corrected_everywhere() -> None:
    """Ways of an odometry that is 10 % too long, straight ahead."""
    true = np.column_stack([0.1 * np.arange(41.0), np.zeros(41), np.zeros(41)])
    chosen = np.array([0, 10, 25, 40])
    filled = fill_between(chosen, true[chosen], true * [1.1, 1.0, 1.0])
    np.testing.assert_allclose(filled, true, atol=1e-6)


def test_chosen_scans_keep_their_poses_and_others_lie_between() -> None:
    odometry, rng = drive(), np.random.default_rng(1)
    chosen = choose_by_motion(odometry, 0.8, 1.0)
    poses = odometry[chosen] + rng.normal(size=(len(chosen), 3)) * [0.05, 0.05, 0.02]
    filled = fill_between(chosen, poses, odometry)
    np.testing.assert_array_equal(filled[chosen], poses)
    off = se2.relative(odometry, filled)
    assert np.abs(off[:, :2]).max() < 0.6  # no jump where two stretches meet
    steps, wheels = se2.relative(filled[:-1], filled[1:]), se2.relative(odometry[:-1], odometry[1:])
    assert np.abs(steps - wheels).max() < 0.15


@pytest.mark.slow
def test_scans_between_are_aligned_with_the_chosen_ones() -> None:
    """A dense walk whose odometry wanders between the chosen scans, which are right."""
    sequence = simulate_sequence(0, 21, seed=5)
    scans, true = planar_scans(sequence.points, sequence.mask), np.asarray(sequence.reference_poses)
    chosen = np.array([0, 10, 20])
    poses = true + np.random.default_rng(0).normal(size=true.shape) * [0.8, 0.8, 0.004]
    poses[chosen] = true[chosen]
    aligned = align_between(scans, chosen, poses)
    np.testing.assert_array_equal(aligned[chosen], true[chosen])
    before, after = (np.hypot(*(some - true)[:, :2].T)[1:-1].mean() for some in (poses, aligned))
    assert after < 0.2 * before


@pytest.mark.slow
def test_a_scan_that_does_not_fit_keeps_its_pose() -> None:
    sequence = simulate_sequence(0, 5, seed=5)
    points, true = np.array(sequence.points), np.asarray(sequence.reference_poses)
    points[2] = 30.0 * points[2] / np.linalg.norm(points[2], axis=-1, keepdims=True)  # a crowd around the robot
    aligned = align_between(planar_scans(points, sequence.mask), np.array([0, 4]), true)
    np.testing.assert_array_equal(aligned[2], true[2])


def test_scans_recorded_twice_and_a_standing_robot_add_no_scan() -> None:
    walk = simulate_sequence(0, 12, num_beams=64, seed=5)
    scans, true = ScanSet(walk.points, walk.mask), np.asarray(walk.reference_poses)
    twice = ScanSet(np.repeat(walk.points, 2, axis=0), np.repeat(walk.mask, 2, axis=0))
    for motion in (None, np.repeat(true, 2, axis=0)):
        found = choose_scans(twice, motion, 1.0, 0.5)
        np.testing.assert_array_equal(found.chosen, np.arange(0, 24, 2))
        np.testing.assert_array_equal(found.between(true), np.repeat(true, 2, axis=0))
    assert len(choose_scans(scans, true, 1.0, 0.5).chosen) == 12
    # The same place with other noise, five times.
    standing = np.repeat(np.arange(12), np.where(np.arange(12) == 4, 5, 1))
    noisy = walk.points[standing] * np.random.default_rng(0).normal(1.0, 1e-3, (16, 64, 1)).astype(np.float32)
    found = choose_scans(ScanSet(noisy, walk.mask[standing]), true[standing], 1.0, 0.5)
    np.testing.assert_array_equal(standing[found.chosen], np.arange(12))
    np.testing.assert_allclose(found.between(true), true[standing], atol=1e-9)


def test_scans_without_an_echo_are_put_between_their_neighbours() -> None:
    walk = simulate_sequence(0, 8)
    mask = walk.mask.copy()
    mask[[0, 3, 4]] = False
    scans = ScanSet(np.where(mask[..., None], walk.points, 0), mask)
    recording = choose_scans(scans, None, 1.0, 1.0)
    np.testing.assert_array_equal(recording.chosen, [1, 2, 5, 6, 7])
    poses = np.column_stack([np.arange(8.0), np.zeros(8), np.zeros(8)])
    found = recording.between(poses[recording.chosen])
    np.testing.assert_allclose(found[1:, 0], np.arange(1.0, 8.0), atol=1e-6)
    np.testing.assert_allclose(found[0], found[1])


def test_runs_of_members_are_found() -> None:
    is_member = np.array([1, 1, 0, 1, 1, 1, 0, 0, 1], bool)
    np.testing.assert_array_equal(np.flatnonzero(in_runs(is_member, 3)), [3, 4, 5])
    np.testing.assert_array_equal(in_runs(is_member, 1), is_member)
    assert not in_runs(is_member, 4).any()
    assert in_runs(np.ones(5, bool), 5).all()


def test_scans_that_follow_a_silent_odometry_are_named() -> None:
    """From scan 8 to 16 the odometry stands while the robot drives on, and the scans between are not registered."""
    walk = simulate_sequence(0, 24)
    true, rows = walk.reference_poses, np.array([0, 8, 16, 23])
    odometry = true.copy()
    odometry[9:16] = odometry[8]
    recording = Recording(ScanSet(walk.points, walk.mask), rows, odometry, np.arange(24))
    poses, lost = recording.aligned(true[rows])
    off = np.linalg.norm(poses[:, :2] - true[:, :2], axis=1)
    assert set(np.flatnonzero(off > 20)) <= set(lost)
    honest = recording._replace(motion=true)
    assert not len(honest.aligned(true[rows])[1])


@pytest.mark.slow
def test_scans_place_what_a_backward_odometry_places_wrongly() -> None:
    """Wheels that count forward alone, while the robot drives back from scan 40 to 80."""
    walk = simulate_sequence(0, 2)
    steps = np.tile([1.5, 0.0, 0.01], (120, 1))
    steps[40:80, 0] *= -1.0
    true = np.asarray(se2.compose(walk.reference_poses[0], se2.chain(steps)))
    points, mask = scan_world(make_world(0).is_obstacle, true, num_beams=256)
    odometry, rows = se2.chain(np.abs(steps)), np.array([0, 40, 80, 120])
    poses, lost = Recording(ScanSet(points, mask), rows, odometry, np.arange(121)).aligned(true[rows])
    assert not len(lost)
    assert np.linalg.norm(poses[:, :2] - true[:, :2], axis=1).max() < 3.0


def test_odometry_is_silent_where_the_robot_moves_and_not_where_it_stands() -> None:
    walk = simulate_sequence(0, 14, num_beams=128, range_noise_px=1.0, seed=5)
    rows = np.r_[0:4, 4:12, np.full(6, 11), 12:14]
    noise = np.random.default_rng(0).normal(0, 1e-3, (len(rows), 128, 1))
    scans = ScanSet((walk.points[rows] * (1 + noise)).astype(np.float32), walk.mask[rows])
    odometry = np.asarray(walk.odometry_poses if walk.odometry_poses is not None else walk.reference_poses)[rows]
    assert not find_silent_steps(scans, odometry).any()
    # Encoders that fail from scan 4 to 11 repeat their pose, as in the six scans of the standing robot after it.
    odometry[4:12] = odometry[4]
    odometry[12:] = odometry[18]
    odometry[12:18] = odometry[12]
    is_silent = find_silent_steps(scans, odometry)
    assert is_silent[4:11].all()
    assert not is_silent[:4].any()
    chosen = choose_scans(scans, odometry, 1.0, 0.5, is_silent).chosen
    assert np.isin(np.arange(4, 12), chosen).all()


def test_a_robot_that_stands_among_people_is_not_silent() -> None:
    walk = simulate_sequence(0, 2, num_beams=128, seed=5)
    points = np.repeat(walk.points[:1], 6, axis=0)
    for row in range(6):
        points[row, 10 + 5 * row : 16 + 5 * row] *= 0.5
    scans = ScanSet(points, np.repeat(walk.mask[:1], 6, axis=0))
    assert not find_silent_steps(scans, np.zeros((6, 3))).any()
