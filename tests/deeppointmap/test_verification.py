from dataclasses import astuple, replace

import numpy as np
import pytest

from dpmjax.deeppointmap.compact_scans import compact_elements, expand_elements
from dpmjax.scan.lidar.choose import VerifiedMotion, choose_motion, refine_motion
from dpmjax.scan.lidar.compare import (
    EVIDENCE,
    VerificationConfig,
    evidence_shares,
    verify_motions,
)
from dpmjax.scan.lidar.record import measure_scan
from dpmjax.scan.lidar.surfaces import Surface, surface_of_elements
from dpmjax.types import SurfaceElements, Verification
from tests.scan.surface_scenes import motion, seen_from, street

CONFIG = VerificationConfig()
T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0), 1), motion(130, (-4, 3, 0))
T_TRUE = np.linalg.inv(T_WORLD_B) @ T_WORLD_A


def verify_motion(source, target, T: np.ndarray, config: VerificationConfig) -> Verification:
    return verify_motions(source, target, T[None], config)[0]


@pytest.fixture(scope="module")
def scans():
    return tuple(measure_scan(seen_from(street(seed), T)) for seed, T in enumerate((T_WORLD_A, T_WORLD_B)))


def translation_error(T: np.ndarray) -> float:
    return float(np.linalg.norm(T[:3, 3] - T_TRUE[:3, 3]))


def test_the_true_motion_is_better_than_any_other(scans) -> None:
    right = verify_motion(*scans, T_TRUE, CONFIG)
    assert right.matched_share > 0.8
    assert right.visible_share > 0.8
    for yaw, translation in ((180, (0, 0, 0)), (0, (6, 0, 0)), (60, (0, 0, 0)), (0, (0, 0, 3))):
        wrong = verify_motion(*scans, T_TRUE @ motion(yaw, translation), CONFIG)
        assert wrong.score < right.score - 0.2


def test_two_scans_on_each_other_gain_nothing_by_their_ground() -> None:
    # The scans are 16 m apart and reach 20 m, so half of the points are in view of one scan. Ground meets anywhere.
    poses = motion(0, (-8, 0, 0)), motion(0, (8, 0, 0))
    points = [seen_from(street(seed, 40_000), T) for seed, T in enumerate(poses)]
    scans = [measure_scan(some[np.linalg.norm(some, axis=1) < 20]) for some in points]
    motions = np.stack([np.linalg.inv(poses[1]) @ poses[0], np.eye(4), motion(180, (0, 0, 0))])
    right, *wrong = verify_motions(*scans, motions, CONFIG)
    assert right.matched_share < max(one.matched_share for one in wrong)
    assert right.score > max(one.score for one in wrong) + 2


def test_motions_are_verified_together_as_alone(scans) -> None:
    motions = np.stack([T_TRUE @ motion(yaw, (0, 0, 0)) for yaw in (0, 30, 200)])
    together = verify_motions(*scans, motions, CONFIG)
    for found, T in zip(together, motions, strict=True):
        np.testing.assert_allclose(found, verify_motion(*scans, T, CONFIG), atol=1e-12)
    shares = evidence_shares(*scans, motions, CONFIG)
    bias, *weights = astuple(EVIDENCE)
    np.testing.assert_allclose([found.score for found in together], shares @ weights + bias)
    assert ((shares >= 0) & (shares <= 1)).all()


def rounded(surface: Surface) -> Surface:
    """A twentieth of the points, rounded as elements of a map."""
    rows = np.random.default_rng(0).permutation(len(surface.points))[: len(surface.points) // 20]
    mask = np.ones(len(rows), bool)
    elements = SurfaceElements(surface.points[rows], surface.normals[rows], surface.flatness[rows], mask)
    return surface_of_elements(expand_elements(compact_elements(elements)))


@pytest.mark.parametrize("is_target_thin", [True, False])
def test_a_thinned_surface_meets_as_many_planes_as_the_whole_one(scans, is_target_thin) -> None:
    whole = verify_motion(*scans, T_TRUE, CONFIG).matched_share
    source, target = scans
    if is_target_thin:
        target = target._replace(surface=rounded(target.surface))
    else:
        source = source._replace(surface=rounded(source.surface))
    assert verify_motion(source, target, T_TRUE, CONFIG).matched_share == pytest.approx(whole, abs=0.05)


@pytest.mark.parametrize("row", [0, 3, 5])
def test_the_right_hypothesis_is_chosen_whatever_its_rank(scans, row: int) -> None:
    rng = np.random.default_rng(row)
    hypotheses = np.stack([T_TRUE @ motion(rng.uniform(40, 320), tuple(rng.uniform(-9, 9, 3))) for _ in range(6)])
    hypotheses[row] = T_TRUE @ motion(3, (1.0, -0.8, 0.1))
    found = choose_motion(*scans, hypotheses, CONFIG)
    assert found.row == row
    assert translation_error(found.T_target_source) < 0.1
    assert found.verification.gap > 0.2
    assert found.verification.num_tried == (4 if row < 4 else 8)
    refined = refine_motion(*scans, found, CONFIG)
    assert translation_error(refined.T_target_source) < 0.02
    assert refined.verification.gap == found.verification.gap


def test_the_scans_find_the_motion_that_no_hypothesis_names(scans) -> None:
    found = choose_motion(*scans, (T_TRUE @ motion(90, (9, 0, 0)))[None], CONFIG)
    assert found.row is None
    assert translation_error(found.T_target_source) < 0.1
    without = replace(CONFIG, views=replace(CONFIG.views, num_motions=0), max_weak_share=0)
    found = choose_motion(*scans, (T_TRUE @ motion(90, (9, 0, 0)))[None], without)
    assert found.row == 0
    assert found.verification.num_tried == 1


def test_near_equal_hypotheses_do_not_compete(scans) -> None:
    hypotheses = np.stack([T_TRUE @ motion(angle, (0, 0, 0)) for angle in (0, 1, -1, 2)])
    found = choose_motion(*scans, hypotheses, replace(CONFIG, max_weak_share=0))
    assert found.verification.gap == found.verification.score


def test_empty_scans_leave_the_hypothesis(scans) -> None:
    empty = measure_scan(np.zeros((0, 3)))
    for pair in ((empty, scans[0]), (scans[0], empty), (empty, empty)):
        found = choose_motion(*pair, T_TRUE[None], CONFIG)
        np.testing.assert_allclose(found.T_target_source, T_TRUE)
        assert found.verification.matched_share == 0
        assert np.isfinite(found.verification._replace(lookalike_gap=0.0)).all()
        assert found.verification.lookalike_gap == np.inf
        assert isinstance(refine_motion(*pair, found, CONFIG), VerifiedMotion)
