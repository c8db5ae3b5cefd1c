import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import absolute_trajectory_error, align_rigid, point_distance, relative_pose_error
from dpmjax.metrics import find_revisits, loop_recall, registration_recall, segment_error
from tests.tolerances import DOUBLE

DIMS = pytest.mark.parametrize("dim", [2, 3])


def motion(rng: np.random.Generator, dim: int, scale: float = 1.0) -> np.ndarray:
    axis = np.array([0, 0, 1]) if dim == 2 else rng.normal(size=3)
    T = np.eye(dim + 1)
    T[:dim, :dim] = Rotation.from_rotvec(scale * rng.uniform(-2, 2) * axis).as_matrix()[:dim, :dim]
    T[:dim, dim] = scale * rng.normal(size=dim)
    return T


def trajectories(seed: int, dim: int, noise: float = 0.1, n: int = 25) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    reference = [np.eye(dim + 1)]
    for _ in range(n - 1):
        reference.append(reference[-1] @ motion(rng, dim))
    world = motion(rng, dim)
    return np.stack([world @ T @ motion(rng, dim, noise) for T in reference]), np.stack(reference)


def positions(T: np.ndarray) -> np.ndarray:
    return T[:, :-1, -1]


@DIMS
def test_error_after_a_rigid_motion_is_zero(dim: int) -> None:
    estimated, reference = trajectories(0, dim, noise=0)
    assert absolute_trajectory_error(positions(estimated), positions(reference)) < 1e-9
    expected = reference[0] @ np.linalg.inv(estimated[0])
    np.testing.assert_allclose(align_rigid(positions(estimated), positions(reference)), expected, **DOUBLE)


@DIMS
def test_errors_are_those_of_evo(dim: int) -> None:
    from evo.core import metrics, trajectory

    estimated, reference = trajectories(2, dim)
    in_space = []
    for poses in (estimated, reference):
        full = np.tile(np.eye(4), (len(poses), 1, 1))
        full[:, :dim, :dim], full[:, :dim, 3] = poses[:, :dim, :dim], poses[:, :dim, dim]
        in_space.append(trajectory.PosePath3D(poses_se3=list(full)))
    error = {}
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        metric = metrics.RPE(relation, delta=2, delta_unit=metrics.Unit.frames, all_pairs=True)
        metric.process_data((in_space[1], in_space[0]))
        error[relation] = metric.get_statistic(metrics.StatisticsType.rmse)
    result = relative_pose_error(estimated, reference, delta=2)
    np.testing.assert_allclose(result.translation_rmse, error[metrics.PoseRelation.translation_part], rtol=1e-6)
    np.testing.assert_allclose(result.rotation_rmse, error[metrics.PoseRelation.rotation_angle_rad], rtol=1e-6)

    in_space[0].align(in_space[1], correct_scale=False)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((in_space[1], in_space[0]))
    expected = metric.get_statistic(metrics.StatisticsType.rmse)
    actual = absolute_trajectory_error(positions(estimated), positions(reference))
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


def test_mirrored_trajectory_is_not_mirrored_back() -> None:
    _, reference = trajectories(3, 2)
    mirrored = positions(reference) * [1, -1]
    T = align_rigid(mirrored, positions(reference))
    np.testing.assert_allclose(np.linalg.det(T[:2, :2]), 1, **DOUBLE)
    assert absolute_trajectory_error(mirrored, positions(reference)) > 0.1


@DIMS
def test_degenerate_trajectories_are_aligned_without_a_turn(dim: int) -> None:
    line = np.arange(5.0)[:, None] * np.eye(dim)[0]
    for path in (line[:1], np.ones((4, dim)), line):
        T = align_rigid(path, path + 3)
        np.testing.assert_allclose(T[:dim, :dim], np.eye(dim), **DOUBLE)
        np.testing.assert_allclose(path @ T[:dim, :dim].T + T[:dim, dim], path + 3, **DOUBLE)


@DIMS
def test_relative_error_sees_small_angles(dim: int) -> None:
    still, turn = np.tile(np.eye(dim + 1), (9, 1, 1)), np.eye(dim + 1)
    turn[:2, :2] = [[np.cos(1e-9), -np.sin(1e-9)], [np.sin(1e-9), np.cos(1e-9)]]
    turning = np.stack([np.linalg.matrix_power(turn, i) for i in range(9)])
    result = relative_pose_error(turning, still)
    np.testing.assert_allclose(result.rotation_rmse, 1e-9, rtol=1e-5)


@DIMS
def test_point_distance_is_its_definition(dim: int) -> None:
    estimated, reference = trajectories(7, dim)
    rng = np.random.default_rng(8)
    points, mask = rng.normal(size=(25, 6, dim)), rng.random((25, 6)) < 0.7
    T = align_rigid(positions(estimated), positions(reference))
    distances = []
    for i, j in zip(*np.nonzero(mask), strict=True):
        point = np.append(points[i, j], 1)
        distances.append(np.linalg.norm(T @ estimated[i] @ point - reference[i] @ point))
    hidden = np.where(mask[..., None], points, np.nan)
    np.testing.assert_allclose(point_distance(hidden, mask, estimated, reference), np.mean(distances), **DOUBLE)


@DIMS
@pytest.mark.parametrize("transform", [lambda f: f, jax.jit])
def test_float32_at_map_coordinates_has_the_errors_of_float64(dim: int, transform) -> None:
    estimated, reference = trajectories(10, dim)
    for T in (estimated, reference):
        T[:, :dim, dim] += np.array([5e5, 5e6, 300.0])[:dim]
    narrow = [jnp.asarray(T, jnp.float32) for T in (estimated, reference)]
    wide = [np.asarray(T, np.float64) for T in narrow]  # the same positions, rounded to half a metre
    error = transform(absolute_trajectory_error)(*map(positions, narrow))
    assert error.dtype == jnp.float32
    np.testing.assert_allclose(error, absolute_trajectory_error(*map(positions, wide)), rtol=1e-4)
    found, expected = transform(relative_pose_error)(*narrow), relative_pose_error(*wide)
    np.testing.assert_allclose(found.translation_rmse, expected.translation_rmse, rtol=1e-4)
    np.testing.assert_allclose(found.rotation_rmse, expected.rotation_rmse, rtol=1e-4)
    points, mask = np.random.default_rng(11).normal(size=(25, 6, dim)).astype(np.float32), np.ones((25, 6), bool)
    found = transform(point_distance)(jnp.asarray(points), mask, *narrow)
    np.testing.assert_allclose(found, point_distance(points, mask, *wide), rtol=1e-4)


ESTIMATED, REFERENCE = trajectories(9, 2)
BROKEN = np.where(np.arange(25)[:, None, None] == 4, np.nan, ESTIMATED)
POINTS, MASK, POSES = np.zeros((25, 6, 2)), np.ones((25, 6), bool), np.tile(np.eye(4), (4, 1, 1))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: absolute_trajectory_error(BROKEN[:, 0], ESTIMATED[:, 0]), "estimated: expected finite .* row 4"),
        (lambda: absolute_trajectory_error(POINTS[:, 0], POINTS[1:, 0]), "reference: expected shape"),
        (lambda: absolute_trajectory_error(np.zeros((0, 2)), np.zeros((0, 2))), "estimated: expected positions"),
        (lambda: absolute_trajectory_error(*[POINTS[:, 0]] * 2, ~MASK[:, 0]), "mask: expected at least one"),
        (lambda: align_rigid(*[jnp.asarray(POINTS[:, 0])] * 2, ~MASK[:, 0]), "mask: expected at least one"),
        (lambda: relative_pose_error(ESTIMATED, POINTS[:, 0]), "reference: expected poses"),
        (lambda: relative_pose_error(ESTIMATED, REFERENCE, 0), "delta: expected 1 <= delta < 25"),
        (lambda: relative_pose_error(ESTIMATED, REFERENCE, 25), "delta: expected 1 <= delta < 25"),
        (lambda: point_distance(POINTS[:, :, :1], MASK, ESTIMATED, REFERENCE), "points: expected shape"),
        (lambda: point_distance(POINTS, MASK[:, :3], ESTIMATED, REFERENCE), "mask: expected bool"),
        (lambda: point_distance(POINTS, ~MASK, ESTIMATED, REFERENCE), "mask: expected at least one"),
        (lambda: point_distance(POINTS, MASK, BROKEN, REFERENCE), "T_estimated: expected finite"),
        (lambda: registration_recall(POSES[:2], POSES), "T_estimated"),
        (lambda: segment_error(POSES, POSES[:3]), "reference"),
        (lambda: segment_error(POSES, POSES, stride=0), "expected poses .* and a stride from 1"),
        (lambda: loop_recall(POSES, np.zeros((2, 3), int), find_revisits(POSES)), "newer_ends"),
        (lambda: loop_recall(POSES, np.array([[0, 4]]), find_revisits(POSES)), "newer_ends"),
    ],
)
def test_bad_input_is_named(call, message: str, as_user) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()
