"""The global start: profiles, the exhaustive search of pairs, and maps grown from pairs."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import ScanSequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.registration import (
    AssembleConfig,
    Candidates,
    CorrelativeConfig,
    GlobalConfig,
    Margins,
    PolishConfig,
    Profiles,
    assemble,
    global_start,
    judge_pairs,
    length_scale,
    make_profiles,
    polish,
    search_pairs,
    view_margins,
)
from dpmjax.registration.block_moves import move_blocks, weakest_cuts
from dpmjax.registration.global_registration import _find_stragglers, _leash_between, _place_others, likeness
from dpmjax.registration.line_fitting import LineScans, fit_lines
from dpmjax.registration.pose_scoring import Leash, MapJudge, add_up, make_offers
from dpmjax.simulation import simulate_sequence
from dpmjax.types import ScanSet

# Coarse, so that a test takes a second: what is law does not depend on it.
COARSE = CorrelativeConfig(num_cells=64, cell=0.5, num_turns=72, block=8, num_levels=5, num_candidates=3)
CONFIG = GlobalConfig(search=COARSE)


class Views(NamedTuple):
    sequence: ScanSequence
    lines: LineScans
    profiles: Profiles
    scale: float
    margins: Margins


def look(sequence: ScanSequence) -> Views:
    lines = fit_lines(ScanSet(jnp.asarray(sequence.points), jnp.asarray(sequence.mask)))
    profiles = make_profiles(lines, jnp.asarray(sequence.mask))
    return Views(sequence, lines, profiles, length_scale(lines), view_margins(lines))


@pytest.fixture(scope="module")
def views() -> Views:
    """Seven scans of the office, 60 px apart."""
    return look(simulate_sequence(0, 49, seed=1).take(slice(0, None, 8)))


@pytest.fixture(scope="module")
def found(views) -> Candidates:
    """All pairs, searched."""
    source, target = all_pairs(len(views.sequence))
    return search_pairs(views.profiles, source, target, COARSE, scale=views.scale, margins=views.margins)


def all_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.nonzero(np.tri(count, k=-1, dtype=bool))
    return first.astype(np.int64), second.astype(np.int64)


def ate(poses: np.ndarray, sequence: ScanSequence) -> float:
    return absolute_trajectory_error(poses[:, :2], sequence.reference_poses[:, :2])


def square_room(half: float, num_beams: int = 256) -> np.ndarray:
    angle = 2 * np.pi * np.arange(num_beams) / num_beams
    reach = half / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    return (reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).astype(np.float32)


def test_profile_of_a_square_room_is_its_distance() -> None:
    points = jnp.asarray(square_room(100.0))[None]
    mask = jnp.ones(points.shape[:2], bool)
    profiles = make_profiles(fit_lines(ScanSet(points, mask)), mask)
    bearing = 2 * np.pi * (np.arange(512) + 0.5) / 512
    expected = 100.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    assert bool(profiles.is_seen.all())
    np.testing.assert_allclose(np.asarray(profiles.surface[0]), expected, rtol=1e-3)


def test_profile_sees_nothing_in_a_gap_or_without_beams() -> None:
    points = jnp.asarray(np.stack([square_room(100.0)] * 2))
    mask = np.ones((2, 256), bool)
    mask[0, :128] = False
    mask[1] = False
    profiles = make_profiles(fit_lines(ScanSet(points, jnp.asarray(mask))), jnp.asarray(mask))
    seen = np.asarray(profiles.is_seen)
    assert not seen[0, 4:250].any()
    assert seen[0, 260:500].all()
    assert not seen[1].any()


def test_right_pose_crosses_nothing_and_wrong_pose_does(views: Views) -> None:
    reference = views.sequence.reference_poses
    source, target = np.array([1, 1]), np.array([0, 0])
    right = se2.relative(reference[0], reference[1])
    poses = np.stack([right, right + np.array([0.0, 60.0, 0.5])])
    verdict = judge_pairs(views.profiles, source, target, poses, margins=views.margins)
    assert verdict.crossed[0] <= 2
    assert verdict.crossed[1] > 20
    assert verdict.matched[0] > 2 * verdict.matched[1]


def test_rooms_do_not_match_through_the_wall_between_them() -> None:
    points = jnp.asarray(np.stack([square_room(100.0)] * 2))
    mask = jnp.ones(points.shape[:2], bool)
    profiles = make_profiles(fit_lines(ScanSet(points, mask)), mask)
    # On top of each other; side by side, with one wall in common, a quarter of the beams of both.
    poses = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]])
    verdict = judge_pairs(profiles, np.array([1, 1]), np.array([0, 0]), poses, margins=Margins(2.0, 6.0), stride=1)
    assert verdict.matched[0] > 500
    # Hits at corners have no side.
    assert verdict.matched[1] < 20
    assert verdict.crossed[1] == 0


def test_support_counts_by_rank_and_objections_in_full() -> None:
    rng = np.random.default_rng(0)
    row, value = rng.integers(0, 4, 40), rng.normal(size=40)
    expected = np.zeros(6)
    for k in range(6):
        mine = np.sort(value[row == k])[::-1]
        expected[k] = sum(v / (i + 1) if v > 0 else v for i, v in enumerate(mine))
    np.testing.assert_allclose(add_up(row, value, 6), expected, atol=1e-12)


def test_verdict_is_mutual(views: Views) -> None:
    reference = views.sequence.reference_poses
    pose = se2.relative(reference[0], reference[2])[None]
    one = judge_pairs(views.profiles, np.array([2]), np.array([0]), pose, margins=views.margins, stride=1)
    other = judge_pairs(
        views.profiles, np.array([0]), np.array([2]), se2.inverse(pose), margins=views.margins, stride=1
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1.5)


def test_masked_beams_hold_anything(views: Views) -> None:
    mask = views.sequence.mask & (np.random.default_rng(0).uniform(size=views.sequence.mask.shape) < 0.9)
    results = []
    for filling in (0.0, 1e4):
        points = np.where(mask[..., None], views.sequence.points, np.float32(filling))
        some = look(replace(views.sequence, points=points, mask=mask))
        poses = np.array([[10.0, 5.0, 0.1]])
        results.append(judge_pairs(some.profiles, np.array([1]), np.array([0]), poses, margins=views.margins))
    np.testing.assert_array_equal(np.stack(results[0]), np.stack(results[1]))


@pytest.mark.parametrize("yaw", [0.0, 1.3, 3.1, -2.0])
def test_search_finds_the_relative_pose_from_any_yaw(views: Views, yaw: float) -> None:
    reference = views.sequence.reference_poses[:2].copy()
    points = views.sequence.points[:2].copy()
    c, s = np.cos(-yaw), np.sin(-yaw)
    points[1] = points[1] @ np.array([[c, -s], [s, c]], np.float32).T
    reference[1, 2] += yaw
    some = look(replace(views.sequence, points=points, mask=views.sequence.mask[:2], reference_poses=reference))
    found = search_pairs(some.profiles, np.array([1]), np.array([0]), COARSE, scale=some.scale, margins=some.margins)
    error = se2.relative(se2.relative(reference[0], reference[1]), found.poses[0, 0])
    assert np.hypot(error[0], error[1]) < 3.0
    assert abs(error[2]) < 0.03
    assert found.scores[0, 0] > found.scores[0, 1] + 20


def test_candidates_of_a_pair_are_different_places(views, found) -> None:
    poses = np.where(np.isfinite(found.scores)[..., None], found.poses, np.nan)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        off = poses[:, first] - poses[:, second]
        is_near = np.hypot(off[:, 0], off[:, 1]) < COARSE.apart[0] * views.scale
        assert not (is_near & (np.abs(se2.wrap_angle(off[:, 2])) < COARSE.apart[1])).any()


def test_assembly_rejects_a_false_pair(views, found) -> None:
    lie = int(np.flatnonzero((found.source == 6) & (found.target == 0))[0])
    poses, scores = found.poses.copy(), found.scores.copy()
    poses[lie, 0] = [5.0, -20.0, 2.0]
    scores[lie, 0] = 0.9 * scores.max()
    result = assemble(
        views.profiles, found._replace(poses=poses, scores=scores), scale=views.scale, margins=views.margins
    )
    assert ate(result.poses, views.sequence) < 4.0
    assert not ((result.edges.source == 6) & (result.edges.target == 0)).any()


def test_a_block_at_a_wrong_place_moves_back_as_a_whole(views, found) -> None:
    judge = MapJudge(views.profiles, AssembleConfig(), views.scale, views.margins, 100.0, 0.02, False)
    torn = views.sequence.reference_poses.copy()
    torn[4:] = se2.compose(np.array([300.0, 150.0, 0.4]), torn[4:])
    mended, num_moved = move_blocks(torn, make_offers(found), judge)
    assert num_moved == 1
    assert ate(torn, views.sequence) > 50.0
    assert ate(mended, views.sequence) < 4.0
    _, num_moved = move_blocks(mended, make_offers(found), judge)
    assert num_moved == 0


def test_weakest_cut_is_between_two_groups() -> None:
    values = np.full((5, 5), 100.0)
    values[3:, :3] = 0.0
    values[3, 1] = 10.0
    np.testing.assert_array_equal(weakest_cuts(np.tril(values, k=-1), 2)[0], [False, False, False, True, True])


def test_a_map_of_contradictions_has_cuts_too() -> None:
    assert len(weakest_cuts(np.full((3, 3), -5.0), 6)) == 2


def test_shuffling_the_scans_permutes_the_result(views: Views) -> None:
    order = np.array([3, 0, 6, 2, 5, 1, 4])
    sequence = views.sequence
    shuffled = look(
        replace(
            sequence,
            points=sequence.points[order],
            mask=sequence.mask[order],
            reference_poses=sequence.reference_poses[order],
        )
    )
    one = global_start(views.lines, sequence.mask, CONFIG, is_ordered=False).poses
    other = global_start(shuffled.lines, shuffled.sequence.mask, CONFIG, is_ordered=False).poses
    assert ate(one, sequence) < 4.0
    apart = absolute_trajectory_error(one[order][:, :2], other[:, :2])
    assert apart < 4.0


def test_scans_beyond_the_keyframes_find_their_place(views: Views) -> None:
    config = replace(CONFIG, max_keyframes=4)
    start = global_start(views.lines, views.sequence.mask, config)
    assert len(start.keyframes) == 4
    assert ate(start.poses, views.sequence) < 4.0


def test_polish_without_order_is_exact(views: Views) -> None:
    rng = np.random.default_rng(0)
    poses = views.sequence.reference_poses + rng.normal(size=(len(views.sequence), 3)) * [2.0, 2.0, 0.01]
    assert ate(polish(views.lines, poses, PolishConfig(is_ordered=False)).poses, views.sequence) < 0.05


def test_scans_between_keyframes_are_kept_between_them() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 0.0], [10.0, 0.0, 0.0]])
    leash = _leash_between(poses, np.array([0, 2]), GlobalConfig(), 5.0)
    np.testing.assert_allclose(leash.middle, [[0.0, 0.0], [5.0, 0.0], [10.0, 0.0]])
    np.testing.assert_allclose(leash.length, [2.0, 12.0, 2.0])


def test_no_place_beyond_the_leash_is_worth_anything(views) -> None:
    truth = views.sequence.reference_poses
    leash = Leash(truth[:, :2] + np.array([500.0, 0.0]), np.full(7, 50.0))
    free = MapJudge(views.profiles, AssembleConfig(), views.scale, views.margins, 100.0, 0.02, False)
    scan, everyone = np.array([3]), np.arange(7)
    assert free.against(scan, truth[3:4], everyone, truth)[0] > 0.0
    held = free._replace(leash=leash)
    assert held.against(scan, truth[3:4], everyone, truth)[0] < -1e5
    # Where no scan is near enough to have a say, too.
    assert held.against(scan, truth[3:4] + np.array([0.0, 1e5, 0.0]), everyone, truth)[0] < -1e5


def test_scans_that_are_lost_together_do_not_vouch_for_each_other() -> None:
    there = look(simulate_sequence(0, 24, num_beams=128))
    poses = np.array(there.sequence.reference_poses)
    assert len(_find_stragglers(there.profiles, poses, there.margins, GlobalConfig())) == 0
    poses[[9, 10], :2] += 5000.0
    assert set(_find_stragglers(there.profiles, poses, there.margins, GlobalConfig())) == {9, 10}


def test_a_scan_that_sees_no_keyframe_is_found_by_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    there = look(simulate_sequence(0, 97, seed=2).take(slice(0, None, 16)))
    truth, keyframes, lost = np.asarray(there.sequence.reference_poses), np.array([0, 1]), 5

    def know(profiles: Profiles, source: np.ndarray, target: np.ndarray, *_: object, **__: object) -> Candidates:
        """A search that is right where two scans share a third of their beams or more, and else finds nothing."""
        relative = se2.relative(truth[target], truth[source])
        matched = judge_pairs(profiles, source, target, relative, margins=there.margins).matched
        scores = np.where(matched > 170.0, matched, 0.0)[:, None]
        return Candidates(
            source, target, relative[:, None].repeat(2, 1), np.concatenate([scores, 0.0 * scores], axis=-1)
        )

    monkeypatch.setattr(importlib.import_module("dpmjax.registration.global_registration"), "search_pairs", know)
    others = np.array([2, 3, 4, 6])
    poses = truth.copy()
    poses[lost] += [5000.0, 0.0, 0.0]
    alike, _ = likeness(there.profiles, there.scale)
    placed, more = _place_others(
        there.profiles, alike, keyframes, poses, know(there.profiles, keyframes[1:], keyframes[:1]),
        know(there.profiles, np.array([1, 2, 3, 3]), others), replace(CONFIG, max_stragglers=4),
        scale=there.scale, margins=there.margins, is_ordered=False,
    )  # fmt: skip
    partners = more.source[more.target == lost]
    assert set(keyframes) < set(partners)
    assert len(partners) == 2 * len(keyframes)
    assert ate(placed, there.sequence) < 0.01
