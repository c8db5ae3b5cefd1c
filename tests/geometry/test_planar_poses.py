from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import planar_poses
from tests.tolerances import DOUBLE


def random_poses(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(scale=100.0, size=(*shape, 2)), rng.uniform(-3, 3, (*shape, 1))], -1)


def assert_same_motion(poses: np.ndarray, matrices: np.ndarray) -> None:
    np.testing.assert_allclose(planar_poses.matrices(poses), matrices, **DOUBLE)


def test_compose_is_the_matrix_product() -> None:
    a, b = random_poses(0, 30), random_poses(1, 30)
    assert_same_motion(planar_poses.compose(a, b), planar_poses.matrices(a) @ planar_poses.matrices(b))


def test_inverse_is_the_matrix_inverse() -> None:
    a = random_poses(2, 30)
    assert_same_motion(planar_poses.inverse(a), np.linalg.inv(planar_poses.matrices(a)))


def test_relative_is_inverse_times_pose() -> None:
    a, b = random_poses(3, 30), random_poses(4, 30)
    expected = np.linalg.inv(planar_poses.matrices(a)) @ planar_poses.matrices(b)
    assert_same_motion(planar_poses.relative(a, b), expected)


def test_poses_broadcast() -> None:
    a, b = random_poses(5, 4, 1), random_poses(6, 1, 5)
    np.testing.assert_allclose(planar_poses.compose(a, b)[2, 3], planar_poses.compose(a[2, 0], b[0, 3]), **DOUBLE)


def test_transform_is_the_homogeneous_product() -> None:
    poses, points = random_poses(7, 6), np.random.default_rng(8).normal(size=(6, 9, 2))
    homogeneous = np.concatenate([points, np.ones((6, 9, 1))], -1)
    expected = np.einsum("nij,nbj->nbi", planar_poses.matrices(poses), homogeneous)[..., :2]
    np.testing.assert_allclose(planar_poses.transform(poses, points), expected, **DOUBLE)


def test_chain_is_the_product_of_all_steps_so_far() -> None:
    steps = random_poses(9, 12)
    matrix, expected = np.eye(3), [np.eye(3)]
    for step in planar_poses.matrices(steps):
        matrix = matrix @ step
        expected.append(matrix)
    assert_same_motion(planar_poses.chain(steps), np.array(expected))


def test_a_step_is_not_turned_by_its_own_rotation() -> None:
    # The published program multiplies the translation of a step by the rotation after it.
    quarter = np.array([1.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(
        planar_poses.chain(np.array([quarter, quarter]))[:, :2], [[0, 0], [1, 0], [1, 1]], **DOUBLE
    )


def test_chain_undoes_the_steps_of_a_trajectory() -> None:
    poses = random_poses(10, 20)
    chained = planar_poses.chain(planar_poses.relative(poses[:-1], poses[1:]))
    assert_same_motion(chained, np.linalg.inv(planar_poses.matrices(poses[:1])) @ planar_poses.matrices(poses))


def test_chain_of_no_steps_is_one_zero_pose() -> None:
    np.testing.assert_array_equal(planar_poses.chain(np.zeros((0, 3))), np.zeros((1, 3)))


@pytest.mark.parametrize("angle", [-7.0, -np.pi, -1e-12, 0.0, 3.0, np.pi, 50.0])
def test_wrap_keeps_the_direction(angle: float) -> None:
    wrapped = planar_poses.wrap(np.array([angle]))
    assert -np.pi <= wrapped[0] < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * np.array([angle])), **DOUBLE)


def test_tour_follows_a_line() -> None:
    x = np.concatenate([[0], np.random.default_rng(0).permutation(np.arange(1, 9))]).astype(float)
    poses = np.stack([x, 0 * x, 0 * x], -1)
    assert list(poses[planar_poses.nearest_tour(poses), 0]) == sorted(x)


def test_tour_of_one_is_short() -> None:
    assert list(planar_poses.nearest_tour(np.zeros((1, 3)))) == [0]
