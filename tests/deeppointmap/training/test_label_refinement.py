"""Refinement of labels: poses that are off become right, and what cannot be aligned keeps its pose."""

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.deeppointmap import SampleMaker, ScanStore, prepare_drive
from dpmjax.deeppointmap.training.label_refinement import aligned_motion
from dpmjax.geometry import rigid
from dpmjax.sequences import LidarSequence
from tests.deeppointmap import toy
from tests.deeppointmap.test_compact import room
from tests.scan.surface_scenes import motion, seen_from


@pytest.mark.parametrize("shift", [(0.3, -0.2, 0.1), (-0.4, 0.1, -0.1)])
def test_a_motion_that_is_decimetres_off_becomes_right_to_centimetres(shift) -> None:
    T_true = motion(17.0, (3.0, 1.0, 0.0))
    target, source = room(3000, 0), seen_from(room(3000, 1), T_true)
    refined = aligned_motion(target, source, T_true @ motion(1.1, shift))
    assert np.linalg.norm((rigid.inverse(T_true) @ refined)[:3, 3]) < 0.03
    np.testing.assert_allclose(refined[:3, :3], T_true[:3, :3], atol=2e-3)


@pytest.mark.parametrize("num", [0, 1, 500])
def test_scans_that_share_nothing_keep_the_given_motion(num: int) -> None:
    given, other = motion(6.0, (1.0, 0.0, 0.0)), np.random.default_rng(1).uniform(100, 150, (num, 3))
    np.testing.assert_array_equal(aligned_motion(room(3000), other, given), given)
    np.testing.assert_array_equal(aligned_motion(other, room(3000), given), given)


@pytest.mark.slow
def test_samples_of_a_drive_with_wrong_poses_have_better_labels() -> None:
    """The second map is the frame: motions between the maps, and the scans within each, are nearer to the truth."""
    rng = np.random.default_rng(3)
    world = room(12_000)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = 1.5 * np.arange(8) - 6
    scan = lambda index: (world - poses[index, :3, 3]).astype(np.float32)  # noqa: E731
    true = LidarSequence("room", tuple("abcdefgh"), scan, poses)
    wrong = np.array(poses)
    wrong[:, :3, 3] += rng.normal(0, 0.15, (8, 3))
    config = replace(toy.TRAINING, model=replace(toy.MODEL, preprocess=replace(toy.MODEL.preprocess, capacity=8192)))
    errors = []
    for given_poses, refines in ((poses, False), (wrong, False), (wrong, True)):
        store = ScanStore([prepare_drive(replace(true, T_world_lidar=given_poses), config)])
        maker = SampleMaker(store, replace(config, refines_labels=refines), seed=0)
        motions = np.concatenate([maker(step).groups.T_target_source[0] for step in range(2)])
        errors.append(motions[:, :3, 3])
    given, refined = (np.linalg.norm(error - errors[0], axis=1).mean() for error in errors[1:])
    assert given > 0.1
    assert refined < 0.5 * given
