from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.scan.lidar.propose import NUM_CELLS, ViewCorrelationConfig, _best_peaks, correlate_views
from dpmjax.scan.lidar.surfaces import scan_surface
from tests.scan.surface_scenes import motion, seen_from, street

CONFIG = ViewCorrelationConfig()


def errors(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    turn = (np.linalg.inv(T_true) @ T)[:3, :3]
    degrees = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    return float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), float(degrees)


@pytest.mark.parametrize(
    ("yaw", "shift", "tilt"), [(0, (0, 0, 0), 0), (130, (-4, 3, 0), 0), (-75, (8, -3, 0.3), 0), (200, (3, 2, 0), 12)]
)
def test_one_of_the_best_motions_is_true_whatever_turn_shift_and_tilt(yaw: float, shift: tuple, tilt: float) -> None:
    T_world_a, T_world_b = motion(5, (1, -2, 0), tilt), motion(yaw, shift)
    surfaces = [scan_surface(seen_from(street(seed), T)) for seed, T in enumerate((T_world_a, T_world_b))]
    found = correlate_views(*surfaces, CONFIG)
    T_true = np.linalg.inv(T_world_b) @ T_world_a
    best = min(errors(T, T_true) for T in found[:4])
    assert best[0] < 1.5
    assert best[1] < 6
    for T in found:
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("yaw", range(0, 360, 45))
def test_two_parallel_walls_are_found_under_each_turn(yaw: float) -> None:
    along, height = np.meshgrid(np.arange(-15, 15, 0.3), np.arange(-1, 2, 0.3))
    walls = [np.stack([along, np.full_like(along, y), height], -1).reshape(-1, 3) for y in (-2.0, 3.0)]
    T = motion(yaw, (0, 0, 0))
    surfaces = [scan_surface(np.concatenate(walls) @ R.T) for R in (np.eye(3), T[:3, :3])]
    found = correlate_views(*surfaces, CONFIG)
    assert len(found) == CONFIG.num_motions
    assert min(errors(some, T)[1] for some in found[:2]) < 4


def test_beside_a_motion_each_quarter_turn_has_an_equal_share() -> None:
    surfaces = [scan_surface(seen_from(street(seed), np.eye(4))) for seed in (0, 1)]
    found = correlate_views(*surfaces, ViewCorrelationConfig(8), beside=motion(33, (4, 0, 0)))
    yaws = np.degrees(np.arctan2(found[:, 1, 0], found[:, 0, 0])) % 360
    np.testing.assert_allclose(np.sort(yaws), np.repeat([33, 123, 213, 303], 2), atol=1)
    assert len(np.unique(found.round(3), axis=0)) == 8


def test_a_scan_looks_like_itself() -> None:
    surface = scan_surface(seen_from(street(0), np.eye(4)))
    np.testing.assert_allclose(correlate_views(surface, surface, CONFIG)[0], np.eye(4), atol=1e-9)


def test_motions_are_distinct_and_as_many_as_asked_for() -> None:
    surfaces = [scan_surface(seen_from(street(seed), np.eye(4))) for seed in range(2)]
    found = correlate_views(*surfaces, replace(CONFIG, num_motions=5))
    assert len(found) == 5
    apart = [errors(found[a], found[b]) for a in range(5) for b in range(a)]
    assert all(metres > 1.5 or degrees > 8 for metres, degrees in apart)


def test_what_has_no_upright_surface_gives_no_motion() -> None:
    ground = scan_surface(
        np.stack([*np.mgrid[-20:20:0.35, -20:20:0.4]], -1).reshape(-1, 2) @ np.eye(2, 3) - [0, 0, 1.7]
    )
    empty = scan_surface(np.zeros((0, 3)))
    for pair in ((ground, ground), (empty, ground), (ground, empty)):
        assert correlate_views(*pair, CONFIG).shape == (0, 4, 4)


def test_settings_out_of_range_are_named() -> None:
    with pytest.raises(ValueError, match="num_motions"):
        ViewCorrelationConfig(num_motions=-1)


def test_of_equal_peaks_the_first_are_kept() -> None:
    scores = np.zeros((1, NUM_CELLS, NUM_CELLS))
    assert _best_peaks(scores, np.zeros(1), 1.0, 1) == [(0.0, 0.0, 0.0)]
    scores[0, 5, 7] = 1.0
    assert _best_peaks(scores, np.zeros(1), 1.0, 1) == [(0.0, 5.0, 7.0)]
