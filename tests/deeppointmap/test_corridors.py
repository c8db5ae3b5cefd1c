"""Laws of registration where walls hold one direction only."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.special import logit

import dpmjax
from dpmjax.deeppointmap import confidence as conf
from dpmjax.scan.lidar.choose import VerifiedMotion, choose_motion, refine_motion, verify_elements
from dpmjax.scan.lidar.compare import VerificationConfig
from dpmjax.scan.lidar.record import Scan, measure_scan, measured_elements
from dpmjax.scan.lidar.slide import facing_samples, sliding_motions, wall_axis, weak_share, weakest_direction
from dpmjax.types import Registration, SurfaceElements, Verification
from tests.scan.surface_scenes import corridor, motion, seen_from, street

CONFIG = VerificationConfig()
PILLARS_M = (-13.0, -8.5, -2.0, 4.0, 5.5, 14.0)
POSES = motion(20, (-2.0, 0.2, 0.0), 5), motion(-115, (3.0, 0.0, 0.1), -4)
T_TRUE = np.linalg.inv(POSES[1]) @ POSES[0]
RANGE_M = 20.0


def scans_of(pillars_m: tuple[float, ...]) -> list[Scan]:
    """Scans of both poses, of other points of the same surfaces."""
    points = [seen_from(corridor(seed, pillars_m), T) for seed, T in enumerate(POSES)]
    return [measure_scan(some[np.linalg.norm(some, axis=1) < RANGE_M]) for some in points]


@pytest.fixture(scope="module")
def with_pillars() -> list[Scan]:
    return scans_of(PILLARS_M)


@pytest.fixture(scope="module")
def bare() -> list[Scan]:
    return scans_of(())


def confidence(found: VerifiedMotion) -> float:
    model = dpmjax.load_model("dpm_small").config.calibration.of_weak_scans
    return float(conf.logistic_probability(model, conf.weak_features(found.verification)))


def along_the_corridor(distance_m: float, turn_deg: float = 0.0) -> np.ndarray:
    """A motion that is wrong by a shift along the corridor, and by a turn about the vertical of the world."""
    return np.linalg.inv(POSES[1]) @ motion(turn_deg, (distance_m, 0, 0)) @ POSES[0]


@pytest.mark.parametrize(("distance_m", "turn_deg"), [(0.0, 0.0), (5.0, 0.0), (-7.0, 0.0), (0.0, 180.0), (4.0, 180.0)])
def test_the_motion_is_found_from_any_shift_and_half_turn(with_pillars, distance_m: float, turn_deg: float) -> None:
    found = choose_motion(*with_pillars, along_the_corridor(distance_m, turn_deg)[None], CONFIG)
    assert found.verification.num_slid > 0
    assert np.linalg.norm(found.T_target_source[:3, 3] - T_TRUE[:3, 3]) < 0.2
    assert found.T_target_source[:3, 0] @ T_TRUE[:3, 0] > 0.99
    assert found.verification.facing_gap > 0
    refined = refine_motion(*with_pillars, found, CONFIG)
    assert refined.verification[7:] == found.verification[7:]
    assert 0 < found.verification.distinct_gap <= found.verification.facing_gap


def test_a_bare_corridor_is_never_sure_of_the_shift(bare, with_pillars) -> None:
    found = choose_motion(*bare, T_TRUE[None], CONFIG)
    assert found.verification.num_slid > 0
    assert confidence(found) < 0.5
    assert found.verification.distinct_gap < 1
    among_pillars = choose_motion(*with_pillars, T_TRUE[None], CONFIG)
    assert confidence(among_pillars) > 0.9
    assert among_pillars.verification.distinct_gap > 2 * conf.CLEAR_DISTINCT_GAP


def elements_of(scan: Scan) -> Scan:
    """Every 4th point as a surface element, which is what descriptor clouds keep of a scan."""
    surface = scan.surface
    points, normals, planarity = (array[::4] for array in (surface.points, surface.normals, surface.flatness))
    return measured_elements(SurfaceElements(points, normals, planarity, np.ones(len(points), bool)))


def test_elements_tell_the_motion_from_shifts_but_are_never_sure(with_pillars) -> None:
    elements = [elements_of(scan) for scan in with_pillars]
    T_wrong = along_the_corridor(3.0)
    right, shifted = (verify_elements(*elements, T, CONFIG) for T in (T_TRUE, T_wrong))
    assert right.num_slid == shifted.num_slid > 0
    assert right.facing_gap > 0 > shifted.facing_gap
    found = evidence_of(right)
    assert found.lookalike_gap == pytest.approx(logit(conf.CORRIDOR_CONFIDENCE))
    assert found.of_elements is not None
    sure = conf.LogisticModel(conf.ELEMENT_FEATURES, (0.0,) * 8, 20.0)
    calibration = conf.Calibration(
        conf.LogisticModel(conf.CLOUD_FEATURES, (0.0,) * 4, 0.0),
        conf.LogisticModel(conf.SCAN_FEATURES, (0.0,) * 9, 0.0),
        of_elements=sure,
    )
    assert conf.calibrated_probability(calibration, found) == pytest.approx(conf.CORRIDOR_CONFIDENCE)
    few = evidence_of(right, num_elements=256)
    assert few.of_elements is None
    assert conf.calibrated_probability(calibration, few) == pytest.approx(conf.CORRIDOR_CONFIDENCE / 2)


def test_a_lead_that_other_niches_have_too_is_not_sure() -> None:
    sure = conf.LogisticModel(conf.WEAK_FEATURES, (0.0, 0.0), 20.0)
    calibration = conf.Calibration(
        conf.LogisticModel(conf.CLOUD_FEATURES, (0.0,) * 4, 0.0),
        conf.LogisticModel(conf.SCAN_FEATURES, (0.0,) * 9, 0.0),
        sure,
    )
    for lead, expected in ((9.0, conf.CORRIDOR_CONFIDENCE), (11.0, 1.0)):
        scans = Verification(0.9, 0.6, 0.0, 5.0, num_slid=146, facing_gap=41.0, distinct_gap=lead)
        found = evidence_of(None, scans=scans, num_pairs=1)
        assert conf.calibrated_probability(calibration, found) == pytest.approx(expected)


def test_elements_contradict_a_wrong_motion_where_no_direction_is_weak() -> None:
    points = [seen_from(street(seed), T) for seed, T in enumerate((motion(10, (1, 0, 0)), motion(30, (-2, 1, 0))))]
    elements = [elements_of(measure_scan(some)) for some in points]
    T_true = np.linalg.inv(motion(30, (-2, 1, 0))) @ motion(10, (1, 0, 0))
    right, turned = (verify_elements(*elements, T, CONFIG) for T in (T_true, T_true @ motion(90, (0, 0, 0))))
    assert right.num_slid == turned.num_slid == 0
    assert 2 * right.contradicted_share < turned.contradicted_share
    assert right.matched_share > 2 * turned.matched_share
    assert evidence_of(right).lookalike_gap == np.inf


def evidence_of(elements: Verification | None, num_elements: int = 1024, *, scans=None, num_pairs=100):
    one, nothing = np.ones(1), (np.zeros((1, 0), dtype) for dtype in (int, int, float, bool))
    hypotheses = Registration(np.eye(4)[None], one, one, one, num_pairs * one, one, *nothing)
    return conf.gather_evidence(hypotheses, 0, scans, elements, num_elements)


@pytest.mark.slow
def test_pillars_at_equal_steps_leave_the_shift_open() -> None:
    found = choose_motion(*scans_of(tuple(np.arange(-58.0, 58.0, 4.0))), T_TRUE[None], CONFIG)
    assert confidence(found) < 0.9
    assert found.verification.distinct_gap < 1


def test_the_weak_direction_is_the_axis_of_the_corridor(bare) -> None:
    axes = [wall_axis(scan.surface) for scan in bare]
    assert weak_share(axes[0], axes[1]) < 0.1
    for axis, pose in zip(axes, POSES, strict=True):
        assert abs(axis.axis @ pose[:3, :3].T[:, 0]) > 0.999
    weak = weakest_direction(*(scan.surface for scan in bare), T_TRUE, CONFIG.plane_radius_m)
    assert abs(weak.direction @ POSES[1][:3, :3].T[:, 0]) > 0.99
    assert weak.sigma_m > 1


def test_elements_that_face_the_axis_make_the_shift_known(with_pillars) -> None:
    weak = weakest_direction(*(scan.surface for scan in with_pillars), T_TRUE, CONFIG.plane_radius_m)
    assert abs(weak.direction @ POSES[1][:3, :3].T[:, 0]) > 0.99
    assert 0 < weak.sigma_m < 0.2


def test_walls_of_all_directions_leave_the_choice_as_it_was() -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-20, 20, (4000, 2)), np.full(4000, -1.2)])
    sides = [motion(angle, (0, 12, 0)) for angle in range(0, 360, 50)]
    walls = [seen_from(corridor(seed, length_m=8.0)[::3], T) for seed, T in enumerate(sides)]
    points = np.concatenate([ground, *walls])
    scans = [measure_scan(seen_from(points, T)) for T in POSES]
    hypotheses = np.stack([along_the_corridor(9.0), along_the_corridor(0.5)])
    found = choose_motion(*scans, hypotheses, CONFIG)
    without = choose_motion(*scans, hypotheses, replace(CONFIG, max_weak_share=0))
    assert found.verification == without.verification
    assert found.verification.num_slid == 0
    np.testing.assert_array_equal(found.T_target_source, without.T_target_source)


def test_the_motions_go_both_ways_round_as_far_as_the_scans_reach(bare) -> None:
    axes = [wall_axis(scan.surface) for scan in bare]
    along = POSES[1] @ sliding_motions(axes[0], axes[1], 0.7) @ np.linalg.inv(POSES[0])
    assert set(np.round(along[:, 0, 0]).tolist()) == {-1.0, 1.0}
    for sign in (-1, 1):
        shifts = np.sort(along[np.sign(along[:, 0, 0]) == sign, 0, 3])
        assert np.diff(shifts).max() < 0.75
        assert np.ptp(shifts) > RANGE_M


def test_an_end_wall_counts_as_one_position(with_pillars) -> None:
    axis = POSES[0][:3, :3].T[:, 0]
    facing, weights = facing_samples(with_pillars[0].surface, axis, 10.0)
    positions = np.floor(facing.points[facing.samples] @ axis / 0.5)
    for position in np.unique(positions):
        at = positions == position
        assert weights[at].sum() == pytest.approx(min(at.sum(), 10.0))
    np.testing.assert_array_equal(facing_samples(facing, axis, np.inf)[1], 1)


def test_scans_without_walls_have_no_weak_axis() -> None:
    empty = wall_axis(measure_scan(np.zeros((0, 3))).surface)
    assert weak_share(empty, empty) == 0.5
    assert empty.extent_m == 0


@pytest.mark.slow
def test_recorded_corridors_are_right_or_not_sure(real_data) -> None:
    folder = real_data / "field_3d" / "corridor_pair"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    model = dpmjax.load_model("dpm_small")
    for source, target in ((28, 16), (18, 10)):
        scans = {number: np.load(folder / f"{number}.npy")[:, :3].astype(np.float32) for number in (source, target)}
        T_true = np.loadtxt(folder / f"T_{target}_from_{source}.txt").reshape(4, 4)
        for a, b in permutations((source, target)):
            found = dpmjax.register(model, scans[a], scans[b])
            T = T_true if a == source else np.linalg.inv(T_true)
            assert np.linalg.norm(np.asarray(found.T_target_source)[:3, 3] - T[:3, 3]) < 1.0
            assert abs(np.asarray(found.weak_direction)[1]) > 0.95
            assert 0 < float(found.weak_sigma_m) < 1
