"""Range profiles, and what two scans match or contradict of each other."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import PlanarScans, planar_scans
from dpmjax.scan.planar.compare import _bearing, compare_pairs

NUM_BEAMS = 256
ANGLE = 2 * np.pi * np.arange(NUM_BEAMS) / NUM_BEAMS
DIRECTION = np.stack([np.cos(ANGLE), np.sin(ANGLE)], -1)


def square_room(half: float) -> np.ndarray:
    return (half / np.abs(DIRECTION).max(-1, keepdims=True) * DIRECTION).astype(np.float32)


def round_room(radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A sensor away from the middle of round walls sees this."""
    along = DIRECTION @ np.asarray(centre)
    reach = -along + np.sqrt(along**2 - np.dot(centre, centre) + radius**2)
    return (DIRECTION * reach[:, None]).astype(np.float32)


def compare(source: np.ndarray, target: np.ndarray, pose=(0.0, 0.0, 0.0), mask=None) -> tuple[float, float, float]:
    """Matched, contradicted, visible beams of two scans."""
    views = compare_pairs(
        planar_scans(np.stack([target, source]), mask), np.array([1]), np.array([0]), np.array([pose]), stride=1
    )
    return tuple(float(x[0]) for x in views)


def test_profile_of_a_square_room_is_its_distance() -> None:
    views = planar_scans(np.stack([square_room(100.0)] * 2)).views
    bearing = 2 * np.pi * (np.arange(512) + 0.5) / 512
    expected = 100.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    assert np.asarray(views.is_seen[:2]).all()
    np.testing.assert_allclose(np.asarray(views.surface[0]), expected, rtol=1e-3)


def test_profile_sees_nothing_in_a_gap_or_without_beams() -> None:
    mask = np.ones((2, NUM_BEAMS), bool)
    mask[0, :128] = False
    mask[1] = False
    seen = np.asarray(planar_scans(np.stack([square_room(100.0)] * 2), mask).views.is_seen)
    assert not seen[0, 4:250].any()
    assert seen[0, 260:500].all()
    assert not seen[1].any()


def test_bearings_are_those_of_the_exact_arctangent() -> None:
    points = np.concatenate([np.random.default_rng(0).normal(size=(1000, 2)), np.eye(2), -np.eye(2), np.zeros((1, 2))])
    exact = np.mod(np.arctan2(points[:, 1], points[:, 0]), 2 * np.pi)
    np.testing.assert_allclose(np.asarray(_bearing(*jnp.asarray(points.T, jnp.float32))), exact, atol=4e-6)


def test_a_scan_matches_itself_and_contradicts_nothing() -> None:
    matched, contradicted, visible = compare(round_room(10.0), round_room(10.0))
    assert matched == pytest.approx(2 * NUM_BEAMS, rel=0.01)
    assert (contradicted, visible) == (0, 2 * NUM_BEAMS)


@pytest.mark.parametrize("shift", [(2.0, 0.0), (-1.0, 1.5)])
def test_two_views_of_one_place_do_not_contradict(shift: tuple[float, float]) -> None:
    matched, contradicted, visible = compare(round_room(10.0, shift), round_room(10.0), (*shift, 0.0))
    assert contradicted == 0
    assert matched > 0.95 * visible > NUM_BEAMS


def test_a_wall_that_is_seen_through_is_a_contradiction() -> None:
    # The target's beams go on to 10 where the source has a wall at 6. Points behind that wall are not visible.
    assert compare(round_room(6.0), round_room(10.0)) == (pytest.approx(0.0, abs=1e-6), NUM_BEAMS, NUM_BEAMS)


def test_rooms_do_not_match_through_the_wall_between_them() -> None:
    # On top of each other; side by side, with one wall in common, a quarter of the beams of both.
    assert compare(square_room(100.0), square_room(100.0))[0] > 450
    matched, contradicted, _ = compare(square_room(100.0), square_room(100.0), (200.0, 0.0, 0.0))
    # Hits at corners have no side.
    assert matched < 20
    assert contradicted == 0


def test_masked_beams_neither_see_nor_are_seen_whatever_they_hold() -> None:
    none = np.ones((2, NUM_BEAMS), bool)
    none[1] = False
    assert compare(round_room(10.0), round_room(10.0), mask=none) == (0, 0, 0)
    half = np.ones((2, NUM_BEAMS), bool)
    half[1, ::2] = False
    results = []
    for filling in (0.0, 1e4, np.nan):
        source = np.where(half[1][:, None], round_room(6.0), np.float32(filling))
        results.append(compare(source, round_room(10.0), mask=half))
    assert results[0] == results[1] == results[2]
    assert results[0][1] == NUM_BEAMS // 2


def test_comparison_is_mutual(walk, walk_scans: PlanarScans) -> None:
    pose = se2.relative(walk.reference_poses[0], walk.reference_poses[2])[None]
    one = compare_pairs(walk_scans, np.array([2]), np.array([0]), pose, stride=1)
    other = compare_pairs(walk_scans, np.array([0]), np.array([2]), se2.inverse(pose), stride=1)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, atol=1.5)


def test_right_pose_contradicts_nothing_and_wrong_pose_does(walk, walk_scans: PlanarScans) -> None:
    right = se2.relative(walk.reference_poses[0], walk.reference_poses[8])
    poses = np.stack([right, right + np.array([0.0, 60.0, 0.5])])
    views = compare_pairs(walk_scans, np.array([8, 8]), np.array([0, 0]), poses)
    assert views.contradicted[0] <= 2
    assert views.contradicted[1] > 20
    assert views.matched[0] > 2 * views.matched[1]
