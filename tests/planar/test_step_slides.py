"""Steps that may slide along a corridor: they are recognised, held by odometry, and not trusted without it."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.scan import PlanarScans, planar_scans
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.slide import slide_parts, slide_steps
from dpmjax.simulation import scan_world, simulate_odometry
from dpmjax.slam import assess_trajectory, incremental_icp, refine
from dpmjax.slam.planar.joint import restore_torn
from dpmjax.slam.planar.odometry import calibrate_odometry
from dpmjax.slam.planar.refine import put_back_slid

# A scan reaches the end rooms from none of the scans 8 to 15.
IN_CORRIDOR, NUM_SCANS, STEP_PX, REACH_PX = slice(8, 15), 24, 25.0, 120.0


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Poses through a room, a bare corridor, and another room."""
    rng = np.random.default_rng(0)
    x = 60.0 + STEP_PX * np.arange(NUM_SCANS) + rng.uniform(-4, 4, NUM_SCANS)
    return np.column_stack([x, 100.0 + rng.uniform(-6, 6, NUM_SCANS), rng.normal(0, 0.12, NUM_SCANS)])


@pytest.fixture(scope="module")
def scans(truth) -> PlanarScans:
    return scans_of(truth)


def scans_of(truth: np.ndarray, niches: tuple[int, ...] = (), reach_px: float = REACH_PX) -> PlanarScans:
    solid = np.ones((200, 700), bool)
    solid[85:115, 20:680] = False
    for left, right in ((20, 140), (560, 680)):
        solid[40:160, left:right] = False
        solid[60:75, left + 30 : left + 50] = solid[130:140, left + 60 : left + 95] = True
    for left in niches:
        solid[81:85, left : left + 12] = False
    points, mask = scan_world(
        solid, truth, max_range=reach_px, num_beams=256, range_noise_px=0.4, rng=np.random.default_rng(1)
    )
    return planar_scans(points * mask[..., None], mask)


@pytest.fixture(scope="module")
def odometry(truth) -> np.ndarray:
    return simulate_odometry(truth, rng=np.random.default_rng(2), translation_noise=0.03, rotation_noise_deg=0.3)


def torn_in_the_corridor(truth: np.ndarray, px: float) -> np.ndarray:
    poses = truth.copy()
    poses[11:, 0] += px
    return poses


def steps_of(poses: np.ndarray) -> np.ndarray:
    return np.asarray(se2.relative(poses[:-1], poses[1:]))


@pytest.mark.slow
def test_steps_are_open_in_a_corridor_and_closed_in_rooms(scans, truth) -> None:
    slides = slide_steps(scans, steps_of(truth))
    assert slides.is_open[IN_CORRIDOR].all()
    assert not slides.is_open[:3].any()
    assert not slides.is_open[-3:].any()
    # The corridor lies along x of a world in which the headings are small.
    assert (np.abs(slides.directions[IN_CORRIDOR, 0]) > 0.9).all()


@pytest.mark.slow
def test_an_open_step_is_as_uncertain_as_its_odometry_and_moves_to_it(scans, truth) -> None:
    deviation = 2.0
    prior = StepPrior(steps_of(truth), np.full((NUM_SCANS - 1, 3), [deviation, deviation, 0.01]))
    torn = steps_of(torn_in_the_corridor(truth, 18.0))
    slides = slide_steps(scans, torn, prior)
    assert np.flatnonzero(slides.is_torn).tolist() == [10]
    np.testing.assert_allclose(slides.moved(torn)[10, :2], steps_of(truth)[10, :2], atol=2.0)
    assert 0.3 * deviation < slides.deviations[10] < 2.0 * deviation


@pytest.mark.slow
def test_odometry_is_calibrated_by_the_clear_steps(scans, truth, odometry) -> None:
    found = calibrate_odometry(scans, odometry * [1.1, 1.1, 1.0])
    assert found.fault is None
    off = found.prior.steps - steps_of(truth)
    np.testing.assert_allclose(np.median(off[:, 0]), 0.0, atol=1.0)
    assert np.median(np.abs(off[:, 0]) / found.prior.deviations[:, 0]) < 2.0
    assert (found.prior.deviations[:, 0] < 5.0).all()


def turned(poses, angle: float):
    return np.column_stack([poses[:, :2], poses[:, 2] + angle])


FAULTS = (
    (lambda poses: poses * [1.0, -1.0, -1.0], "mirrored"),
    (lambda poses: np.column_stack([poses[:, :2], np.degrees(poses[:, 2])]), "degrees"),
    (lambda poses: poses * [1000.0, 1000.0, 1.0], "millimetres"),
    (lambda poses: poses * [100.0, 100.0, 1.0], "centimetres"),
    (lambda poses: turned(poses, -np.pi), "backwards"),
    (lambda poses: turned(poses, -np.pi / 2), "to the left"),
    (lambda poses: turned(poses, np.pi / 2), "to the right"),
)


@pytest.mark.slow
@pytest.mark.parametrize(("change", "word"), FAULTS)
def test_faults_of_the_odometry_are_named_and_corrected(scans, odometry, change, word: str) -> None:
    found = calibrate_odometry(scans, change(odometry))
    assert word in str(found.fault)
    assert found.is_mirrored == (word == "mirrored")
    np.testing.assert_allclose(found.poses, odometry, atol=1e-6)


@pytest.mark.slow
def test_a_mirrored_map_is_not_trusted(scans, truth, odometry) -> None:
    found = calibrate_odometry(scans, odometry * [1.0, -1.0, -1.0])
    assert not assess_trajectory(scans, truth, prior=found.prior, fault=found.fault).is_trusted


@pytest.mark.slow
def test_a_refinement_takes_a_slid_step_back_to_the_odometry(scans, truth, odometry) -> None:
    prior = calibrate_odometry(scans, odometry).prior
    found = refine(scans, torn_in_the_corridor(truth, 18.0), prior=prior).poses
    off = se2.relative(found[[0]], found) - se2.relative(truth[[0]], truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 6.0


@pytest.mark.slow
def test_trust_depends_on_what_holds_the_corridor(scans, truth, odometry) -> None:
    # Nothing but the scans: the second room may lie anywhere along the corridor.
    alone = assess_trajectory(scans, truth)
    assert not alone.is_trusted
    assert set(range(9, 14)) <= set(alone.uncertain_scans)
    prior = calibrate_odometry(scans, odometry).prior
    held = prior._replace(deviations=np.full_like(prior.deviations, 0.2))
    assert assess_trajectory(scans, truth, prior=held._replace(steps=steps_of(truth))).is_trusted
    # The odometry contradicts a step that the scans leave open.
    torn = assess_trajectory(scans, torn_in_the_corridor(truth, 18.0), prior=prior)
    assert not torn.is_trusted
    assert {10, 11} <= set(torn.uncertain_scans)


@pytest.mark.slow
def test_the_ends_of_a_corridor_constrain_its_length(scans, truth) -> None:
    """Few beams of each scan reach a wall across the corridor, but those of all pairs across a step agree."""
    far = scans_of(truth, reach_px=600.0)
    assert assess_trajectory(far, truth).is_trusted
    parts = slide_parts(far, truth)
    assert not parts.is_torn.any()
    assert (parts.deviations < 0.02 * far.typical_range).all()
    for factor in (0.9, 1.1):
        steps = steps_of(truth)
        steps[IN_CORRIDOR, 0] *= factor
        found = assess_trajectory(far, se2.chain(steps))
        assert not found.is_trusted
        assert found.uncertain_scans
    # Where no beam reaches an end, nothing does.
    assert (slide_parts(scans, truth).deviations[9:13] > 0.05 * scans.typical_range).all()


def test_a_scan_that_was_torn_out_is_put_back(scans, truth) -> None:
    prior = StepPrior.of_poses(truth, scans.typical_range)
    assert restore_torn(scans, steps_of(truth), truth, prior) is None
    torn = truth.copy()
    torn[3] += [25.0, -20.0, 0.3]
    found = restore_torn(scans, steps_of(truth), torn, prior)
    assert found is not None
    off = se2.relative(found[[0]], found) - se2.relative(truth[[0]], truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 2.0


def test_a_lost_step_is_put_back_and_not_slid(scans, truth) -> None:
    """A step of the corridor is 18 px too long, and turned, so that it still fits a little where its shift ends."""
    torn, steps = steps_of(torn_in_the_corridor(truth, 18.0)), steps_of(truth)
    torn[10, 2] += 0.025
    prior = StepPrior(steps, np.full((NUM_SCANS - 1, 3), [2.0, 2.0, 0.01]))
    poses = np.asarray(se2.compose(truth[0], se2.chain(torn)))
    found = restore_torn(scans, steps, poses, prior)
    np.testing.assert_allclose(steps_of(found)[10], steps[10], atol=1e-3)


@pytest.mark.slow
def test_a_calibrated_prior_does_not_hold_a_clear_step_that_slipped(scans, truth) -> None:
    """Most steps of the odometry are exact, so their deviations are small; one step in a room has a wrong turn."""
    slipped, expected = 3, steps_of(truth)
    expected[slipped, 2] += 0.3
    odometry = se2.compose(truth[0], se2.chain(expected))
    prior = StepPrior(expected, np.broadcast_to([0.2, 0.2, 0.003], expected.shape))
    found = incremental_icp(scans, odometry=odometry, prior=prior.loosened(scans.typical_range)).steps.poses
    assert abs(found[slipped, 2] - steps_of(truth)[slipped, 2]) < 0.02
    np.testing.assert_array_equal(prior.loosened(scans.typical_range).steps, prior.steps)


def test_the_prior_of_steps_that_nothing_is_known_of_is_unknown(odometry) -> None:
    known = StepPrior.of_poses(odometry, 10.0)
    rows = np.array([0, 1, 3])
    summed = [np.sqrt((known.deviations[a:b] ** 2).sum(axis=0)) for a, b in ((0, 1), (1, 3))]
    np.testing.assert_allclose(known.through(rows).deviations, summed)
    unknown = known._replace(deviations=np.full_like(known.deviations, np.inf))
    assert (unknown.through(rows).deviations == np.inf).all()


def test_a_step_that_collapsed_in_a_passage_is_named(scans, truth) -> None:
    assert {10, 11} <= set(assess_trajectory(scans, torn_in_the_corridor(truth, -20.0)).uncertain_scans)
    assert put_back_slid(scans, torn_in_the_corridor(truth, -20.0)) is None  # no shift along a bare wall is better


def test_a_collapsed_step_is_put_back_by_what_little_the_passage_shows(truth) -> None:
    scans = scans_of(truth, niches=(260, 330, 352, 430))
    found = put_back_slid(scans, torn_in_the_corridor(truth, -20.0))
    assert found is not None
    off = se2.relative(found[[0]], found) - se2.relative(truth[[0]], truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 8.0
    assert put_back_slid(scans, truth) is None
