"""Errors of whole walks: of planar scans, of a corrected log, of depth images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se2
from dpmjax.metrics import corrected_ate, depth_errors, planar_errors
from dpmjax.sequences import DepthSequence
from dpmjax.simulation import simulate_sequence


def test_a_corrected_log_measures_the_scans_that_both_have() -> None:
    walk = simulate_sequence(0, 24, num_beams=64, seed=4)
    times = np.arange(24.0)
    corrected = replace(walk, unit="m", times=times).take(slice(0, None, 2))
    moved = np.asarray(se2.compose(np.array([50.0, -3.0, 1.0]), walk.reference_poses))
    assert corrected_ate(times, moved, corrected) < 1e-9
    moved[2, 0] += 12.0
    # One of twelve is off by 12; the best alignment takes at most a part of that.
    assert 2.0 < corrected_ate(times, moved, corrected) < np.sqrt(12.0)
    with pytest.raises(ValueError, match="0 scans have the time"):
        corrected_ate(times + 0.3, moved, corrected)


def test_the_worst_scan_is_the_farthest_from_its_reference() -> None:
    walk = simulate_sequence(0, 24, num_beams=64, seed=4)
    poses = walk.reference_poses.copy()
    poses[20, :2] += [3.0, 4.0]
    found = planar_errors(walk, np.asarray(se2.compose(np.array([50.0, -3.0, 1.0]), poses)))
    # The best alignment takes a part of the five pixels.
    assert 4.5 < found["worst_scan_px"] < 5.0
    assert planar_errors(walk, walk.reference_poses)["worst_scan_px"] < 1e-9


@pytest.fixture
def walk() -> DepthSequence:
    """Five cameras on a line, turned a little, each in front of other points."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.2, (5, 3))).as_matrix()
    T[:, 0, 3] = 0.3 * np.arange(5)
    points = rng.uniform(1.0, 3.0, (5, 4, 6, 3)).astype(np.float32)
    return DepthSequence("walk", points, np.ones((5, 4, 6), bool), False, T)


def test_cameras_on_one_line_have_no_error_in_any_world(walk) -> None:
    T_other_world = np.eye(4)
    T_other_world[:3, :3] = Rotation.from_euler("xyz", [2.0, 0.3, -1.0]).as_matrix()
    T_other_world[:3, 3] = [5.0, -2.0, 1.0]
    found = depth_errors(walk, rigid.matmul(T_other_world, walk.T_world_camera))
    assert max(found.values()) < 1e-5


def test_a_turned_camera_is_the_largest_error_of_a_turn(walk) -> None:
    T = walk.T_world_camera.copy()
    T[2, :3, :3] = T[2, :3, :3] @ Rotation.from_euler("y", 7.0, degrees=True).as_matrix()
    found = depth_errors(walk, T)
    assert found["largest_turn_error_deg"] == pytest.approx(7.0, abs=1e-6)
    assert found["ate_m"] < 1e-9
    assert found["point_distance_m"] > 0.02
