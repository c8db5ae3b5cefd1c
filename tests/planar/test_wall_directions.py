"""Likely turns by the directions of walls: they turn with the scan, and stay where it moves."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import planar_scans
from dpmjax.scan.planar.wall_directions import NUM_DIRECTIONS, WallDirections
from dpmjax.simulation import simulate_sequence

SPACING = 2 * np.pi / NUM_DIRECTIONS


@pytest.fixture(scope="module")
def walk():
    """Scans of the office, 30 px apart."""
    return simulate_sequence(0, 33, seed=4).take(slice(0, None, 4))


def all_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.nonzero(~np.eye(count, dtype=bool))
    return first, second


def share_found(walk, mask: np.ndarray, num_peaks: int) -> float:
    """Share of pairs whose true heading is among the likely ones, or next to them."""
    walls, poses = WallDirections(planar_scans(walk.points, mask)), np.asarray(walk.reference_poses)
    source, target = all_pairs(len(walk))
    turns = walls.likely_turns(source, target, 120, num_peaks)
    true = np.mod(se2.relative(poses[target], poses[source])[:, 2], 2 * np.pi) * 120 / (2 * np.pi)
    return float(turns[np.arange(len(source)), np.round(true).astype(int) % 120].mean())


@pytest.mark.parametrize("turn", [-13, 0, 40])
def test_a_scan_that_only_turns_is_most_similar_at_that_turn(walk, turn: int) -> None:
    angle = turn * SPACING
    turned = walk.points[:1] @ se2.rotation(np.asarray(angle)).T.astype(np.float32)
    # The turned scan sees the same from a sensor of another heading: T_target_source turns back.
    walls = WallDirections(planar_scans(np.concatenate([walk.points[:1], turned]), walk.mask[[0, 0]]))
    curve = walls.similarity(np.array([1]), np.array([0]))[0]
    assert curve.argmax() == (-turn) % NUM_DIRECTIONS
    assert curve.max() > 0.95


def test_both_directions_of_a_pair_are_opposite_turns(walk) -> None:
    walls = WallDirections(planar_scans(walk.points, walk.mask))
    source, target = all_pairs(len(walk))
    there, back = walls.similarity(source, target), walls.similarity(target, source)
    np.testing.assert_allclose(there, back[:, -np.arange(NUM_DIRECTIONS)], atol=1e-6)
    best = walls.best_similarity(np.arange(len(walk)), np.arange(len(walk)))
    np.testing.assert_allclose(best[source, target], there.max(-1), atol=1e-6)
    np.testing.assert_allclose(np.diag(best), 1.0, atol=1e-5)


def test_the_true_heading_is_among_the_likely_ones_of_scans_that_share_walls(walk) -> None:
    assert share_found(walk, walk.mask, 3) > 0.85  # by chance, 15 of 120


def test_half_a_field_of_view_is_enough(walk) -> None:
    ahead = walk.mask & (walk.points[..., 0] > 0)
    assert share_found(walk, ahead, 3) > 0.7


def test_scans_without_walls_try_all_headings(walk) -> None:
    walls = WallDirections(planar_scans(walk.points, walk.mask & (np.arange(len(walk)) > 0)[:, None]))
    turns = walls.likely_turns(np.array([0, 1, 2]), np.array([1, 0, 1]), 72, 2)
    assert turns[:2].all()
    assert 5 <= turns[2].sum() <= 10
