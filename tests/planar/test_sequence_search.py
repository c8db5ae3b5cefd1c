"""Sequences of scans that are not as they should be: logs in the manner of CARMEN, from ICP alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io.carmen import read_carmen_log
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.scan import planar_scans
from dpmjax.scan.planar.compare import weak_steps
from dpmjax.scan.planar.motion_prior import MotionPrior
from dpmjax.scan.planar.record import PlanarScans
from dpmjax.simulation import make_world, scan_world, simulate_sequence
from dpmjax.slam import incremental_icp
from dpmjax.slam.planar.recordings import distinct_rows, interpolate
from dpmjax.slam.planar.sequence_search import align_arcs

NUM_SCANS, METRES_A_PX = 24, 0.05
STANDING, REPEATED, SWAPPED = (5, 6, 7), 12, 17


def write_flaser(path: Path, ranges: np.ndarray, poses: np.ndarray) -> None:
    lines = []
    for time, (row, pose) in enumerate(zip(ranges, poses, strict=True)):
        numbers = [*row, *pose, *pose]
        lines.append(f"FLASER {len(row)} {' '.join(f'{x:.4f}' for x in numbers)} {time}.0 robot {time}.0")
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> tuple[PlanarScans, np.ndarray]:
    """A robot that stands still for three scans; one scan of the log is repeated, one is of another moment."""
    walk = simulate_sequence(0, 4 * NUM_SCANS, seed=41, num_beams=256, range_noise_px=0.3)
    walk = walk.take(slice(0, None, 4))
    angle = np.arctan2(walk.points[0, :, 1], walk.points[0, :, 0])
    beams = np.argsort(angle)[(np.sort(angle) >= -np.pi / 2) & (np.sort(angle) < np.pi / 2)]
    ranges = METRES_A_PX * np.linalg.norm(walk.points, axis=-1)[:, beams]
    poses = walk.reference_poses * [METRES_A_PX, METRES_A_PX, 1.0]
    noise = np.random.default_rng(3).normal(scale=0.01, size=ranges.shape)
    for scan in STANDING:
        ranges[scan], poses[scan] = ranges[STANDING[0]] + noise[scan], poses[STANDING[0]]
    ranges[REPEATED], ranges[SWAPPED] = ranges[REPEATED - 1], ranges[1]
    path = tmp_path_factory.mktemp("carmen") / "robot.log"
    write_flaser(path, ranges, poses)
    read = read_carmen_log(path)
    return planar_scans(read.points, read.mask), poses


@pytest.mark.slow
def test_scans_that_stand_still_repeat_or_are_swapped_do_not_break_the_sequence(log) -> None:
    scans, truth = log
    poses = incremental_icp(scans).poses
    others = np.setdiff1d(np.arange(NUM_SCANS), [REPEATED, SWAPPED])
    assert absolute_trajectory_error(poses[others, :2], truth[others, :2]) < 0.05
    # A repeated scan lies between its neighbours in time.
    before, here, after = poses[REPEATED - 1 : REPEATED + 2, :2]
    assert max(np.hypot(*(here - before)), np.hypot(*(here - after))) < np.hypot(*(after - before))


def test_a_repeated_scan_is_left_out_and_no_right_one_is(log) -> None:
    left_out = set(range(NUM_SCANS)) - set(distinct_rows(log[0]).tolist())
    assert REPEATED in left_out
    assert left_out <= {REPEATED, SWAPPED}


def test_right_steps_are_strong_and_torn_ones_weak(log) -> None:
    scans, truth = log
    rows = np.setdiff1d(np.arange(NUM_SCANS), [REPEATED, SWAPPED])
    assert not weak_steps(scans, truth, rows).any()
    torn = truth.copy()
    torn[10:, :2] += 3.0
    assert np.flatnonzero(weak_steps(scans, torn, rows)).tolist() == [9]


def test_arcs_bend_by_half_their_turn_and_have_the_usual_lengths() -> None:
    prior = MotionPrior(1.0, 0.9)
    arcs = prior.arcs()
    moved = arcs[np.hypot(arcs[:, 0], arcs[:, 1]) > 0]
    np.testing.assert_allclose(np.arctan2(moved[:, 1], moved[:, 0]), moved[:, 2] / 2, atol=1e-9)
    straight = arcs[arcs[:, 2] == 0, 0]
    assert straight.min() == 0.0
    assert straight.max() > 1.0
    np.testing.assert_allclose(MotionPrior(1.0, -0.9).arcs()[:, :2], -arcs[:, :2], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("place", "turn"), [((846.5, 698.5, -2.3), -1.36), ((564.5, 620.5, 0.2), 1.17)])
def test_a_step_with_little_overlap_is_among_the_hypotheses(place, turn) -> None:
    """The exhaustive search prefers poses with more overlap, and misses the step."""
    length = 1.5 / METRES_A_PX * np.sinc(turn / (2 * np.pi))
    step = np.array([length * np.cos(turn / 2), length * np.sin(turn / 2), turn])
    poses = np.stack([np.array(place), se2.compose(np.array(place), step)])
    world, rng = make_world(0), np.random.default_rng(0)
    points, _ = scan_world(world.is_obstacle, poses, num_beams=512, range_noise_px=0.2, rng=rng)
    ahead = np.arange(-80, 80) % 512
    scans = planar_scans(METRES_A_PX * points[:, ahead])
    truth = step * [METRES_A_PX, METRES_A_PX, 1.0]
    found = align_arcs(scans, np.array([1]), MotionPrior(1.0, 1.0))
    off = found.poses - truth
    assert (np.hypot(off[:, 0], off[:, 1]) + np.abs(off[:, 2])).min() < 0.3


def test_interpolation_keeps_what_is_given_and_stands_still_outside() -> None:
    given = np.array([[1.0, 2.0, 0.3], [3.0, 2.0, 0.7]])
    poses = interpolate(6, np.array([1, 3]), given)
    np.testing.assert_allclose(poses[[1, 3]], given, atol=1e-9)
    np.testing.assert_allclose(poses[[0, 4, 5]], given[[0, 1, 1]], atol=1e-9)
    half = se2.relative(given[0], poses[2])
    np.testing.assert_allclose(se2.compose(half, half), se2.relative(given[0], given[1]), atol=1e-6)
