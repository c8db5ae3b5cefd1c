"""Laws of registration where another place fits as well: bare rooms, and rows of equal houses."""

import dataclasses
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import registration
from dpmjax.deeppointmap.confidence import MatchEvidence, calibrated_probability
from dpmjax.scan.lidar.choose import choose_motion, refine_motion
from dpmjax.scan.lidar.compare import VerificationConfig
from dpmjax.scan.lidar.record import measure_scan
from dpmjax.types import Registration
from tests.scan.surface_scenes import motion, rectangle, seen_from, street

CONFIG = VerificationConfig()
POSES = motion(20, (-1.5, 0.4, 0.0)), motion(-75, (1.2, -0.8, 0.1))
T_TRUE = np.linalg.inv(POSES[1]) @ POSES[0]
T_HALF_TURN = np.linalg.inv(POSES[1]) @ motion(180, (0.0, 0.0, 0.0)) @ POSES[0]


def room(rng: np.random.Generator, *, has_niche: bool = False) -> np.ndarray:
    """Points of a room of 8 x 5 m around the origin; a box in one corner breaks its symmetry."""
    long, across, high = (8.0, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 0.0, 2.6)
    parts = [rectangle(rng, (-4.0, -2.5, z), long, across) for z in (-1.2, 1.4)]
    parts += [rectangle(rng, (-4.0, y, -1.2), long, high) for y in (-2.5, 2.5)]
    parts += [rectangle(rng, (x, -2.5, -1.2), across, high) for x in (-4.0, 4.0)]
    if has_niche:
        parts += [rectangle(rng, (2.0, 0.5, -1.2), (2.0, 0.0, 0.0), high)]
        parts += [rectangle(rng, (2.0, 0.5, -1.2), (0.0, 2.0, 0.0), high)]
    return np.concatenate(parts)


def scans_of(*, has_niche: bool):
    points = [seen_from(room(np.random.default_rng(seed), has_niche=has_niche), T) for seed, T in enumerate(POSES)]
    return [measure_scan(some) for some in points]


@pytest.mark.parametrize("T", [T_TRUE, T_HALF_TURN])
def test_a_bare_room_leaves_the_half_turn_open(T: np.ndarray) -> None:
    scans = scans_of(has_niche=False)
    found = choose_motion(*scans, T[None], CONFIG)
    assert found.verification.score > 1
    assert 0 <= found.verification.lookalike_gap < 2
    refined = refine_motion(*scans, found, CONFIG)
    assert refined.verification.lookalike_gap == found.verification.lookalike_gap


@pytest.mark.parametrize("T", [T_TRUE, T_HALF_TURN])
def test_what_breaks_the_symmetry_finds_the_motion_and_its_lead(T: np.ndarray) -> None:
    found = choose_motion(*scans_of(has_niche=True), T[None], CONFIG)
    assert np.linalg.norm(found.T_target_source[:3, 3] - T_TRUE[:3, 3]) < 0.2
    assert found.verification.lookalike_gap > 2


def test_nothing_competes_where_the_search_is_off_or_no_motion_is_clear() -> None:
    settings = replace(CONFIG, num_lookalikes=0)
    assert choose_motion(*scans_of(has_niche=False), T_TRUE[None], settings).verification.lookalike_gap == np.inf
    far = motion(0, (500.0, 0.0, 0.0))
    views = replace(CONFIG, views=replace(CONFIG.views, num_motions=0))
    streets = [measure_scan(street(seed)) for seed in (0, 1)]
    assert choose_motion(*streets, far[None], views).verification.lookalike_gap == np.inf


def test_two_places_of_one_score_share_the_probability() -> None:
    calibration = dpmjax.load_model("dpm_small").config.calibration
    scans = np.array([80.0, 0.5, 0.3, 60.0, 0.8, 0.9, 0.0, 10.0, 10.0])
    alone = calibrated_probability(calibration, MatchEvidence(scans[:4], scans))
    assert alone > 0.95
    for gap, share in ((0.0, 0.5), (np.log(3), 0.75), (30.0, 1.0)):
        shared = calibrated_probability(calibration, MatchEvidence(scans[:4], scans, lookalike_gap=gap))
        assert shared == pytest.approx(share * alone, rel=1e-6)


@pytest.mark.parametrize("is_right_at_home", [True, False])
def test_scans_of_a_small_room_are_registered_at_twice_their_size_too(monkeypatch, is_right_at_home: bool) -> None:
    points = [0.7 * seen_from(room(np.random.default_rng(seed), has_niche=True), T) for seed, T in enumerate(POSES)]
    T_small = T_TRUE.copy()
    T_small[:3, 3] *= 0.7
    wrong, model = motion(120, (0.5, 1.0, 0.0)), dpmjax.load_model("dpm_small")

    def answer(model, pairs, *, refine):
        is_enlarged = np.abs(pairs[0][0]).max() > 1.5 * np.abs(points[0]).max()
        T = T_small.copy() if is_right_at_home != is_enlarged else wrong.copy()
        T[:3, 3] *= 2.0 if is_enlarged else 1.0
        size = 0.95 if is_enlarged else 0.6
        empty = np.zeros((0,), np.int32)
        numbers = {name: np.zeros(()) for name in ("rmse", "num_inliers", "score")}
        fields = {field.name: numbers.get(field.name, empty) for field in dataclasses.fields(Registration)}
        fields |= {"T_target_source": jnp.asarray(T), "confidence": jnp.asarray(size), "weak_sigma_m": None}
        return [Registration(**fields)]

    monkeypatch.setattr(registration, "_register_either_way", answer)
    found = dpmjax.register(model, *points)
    np.testing.assert_allclose(found.T_target_source, T_small, atol=1e-5)
    assert found.confidence <= 0.88
