from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dpmjax.geometry import poses
from tests.tolerances import ACCUMULATED, ROUNDING


def random_poses2(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(size=(*shape, 2)), rng.uniform(-3, 3, (*shape, 1))], -1).astype(np.float32)


def random_motions(seed: int, n: int, dim: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(dim + 1), (n, 1, 1))
    axis = np.array([0, 0, 1]) if dim == 2 else rng.normal(size=(n, 3))
    R = Rotation.from_rotvec(rng.uniform(-2, 2, (n, 1)) * axis).as_matrix()
    T[:, :dim, :dim], T[:, :dim, dim] = R[:, :dim, :dim], rng.normal(size=(n, dim))
    return T.astype(np.float32)


def test_pose2_and_matrix_are_inverse_to_each_other() -> None:
    pose = random_poses2(0, 4, 5)
    np.testing.assert_allclose(poses.pose2_from_matrix(poses.matrix_from_pose2(pose)), pose, **ROUNDING)


def test_compose_pose2_is_the_matrix_product() -> None:
    a, b = random_poses2(1, 20), random_poses2(2, 20)
    product = np.asarray(poses.matrix_from_pose2(a)) @ np.asarray(poses.matrix_from_pose2(b))
    np.testing.assert_allclose(poses.matrix_from_pose2(poses.compose_pose2(a, b)), product, **ROUNDING)


def test_inverse_and_relative_pose2_undo_composition() -> None:
    a, b = random_poses2(3, 20), random_poses2(4, 20)
    np.testing.assert_allclose(poses.compose_pose2(a, poses.inverse_pose2(a)), np.zeros_like(a), atol=1e-6)
    np.testing.assert_allclose(poses.compose_pose2(a, poses.relative_pose2(a, b)), b, **ROUNDING)


def test_wrap_angle_keeps_the_direction_and_small_angles() -> None:
    angle = np.linspace(-20, 20, 401, dtype=np.float32)
    wrapped = np.asarray(poses.wrap_angle(angle))
    assert np.all(np.abs(wrapped) <= np.float32(np.pi) + 1e-6)
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), **ACCUMULATED)
    assert float(poses.wrap_angle(jnp.float32(1e-9))) == np.float32(1e-9)


def test_wrap_angle_has_slope_one_everywhere() -> None:
    angle = jnp.array([-9.0, -jnp.pi, 0.0, jnp.pi, 5.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(poses.wrap_angle))(angle), np.ones(5))


@pytest.mark.parametrize("dim", [2, 3])
def test_transform_points_is_the_homogeneous_product(dim: int) -> None:
    T = random_motions(5, 6, dim)
    points = np.random.default_rng(6).normal(size=(6, 9, dim)).astype(np.float32)
    homogeneous = np.concatenate([points, np.ones((6, 9, 1), np.float32)], -1).astype(np.float64)
    expected = np.einsum("nij,nbj->nbi", T.astype(np.float64), homogeneous)[..., :dim]
    np.testing.assert_allclose(poses.transform_points(T, points), expected, **ROUNDING)


@pytest.mark.parametrize("dim", [2, 3])
def test_transform_points_broadcasts_and_keeps_dtype(dim: int) -> None:
    T = random_motions(7, 4, dim)
    points = jnp.ones((9, dim))
    moved = poses.transform_points(T, points)
    assert moved.shape == (4, 9, dim)
    assert moved.dtype == jnp.float32
    assert poses.transform_points(T[0], points).shape == (9, dim)
    assert poses.transform_points(T[0], points[:0]).shape == (0, dim)


@pytest.mark.parametrize("dim", [2, 3])
def test_invert_undoes_a_motion(dim: int) -> None:
    T = random_motions(8, 10, dim)
    identity = np.asarray(poses.invert(T)).astype(np.float64) @ T
    np.testing.assert_allclose(identity, np.tile(np.eye(dim + 1), (10, 1, 1)), **ROUNDING)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 0.5, 2.0])
def test_exp_se3_is_the_matrix_exponential(scale: float) -> None:
    tangent = (np.random.default_rng(9).normal(size=6) * scale).astype(np.float32)
    vx, vy, vz, wx, wy, wz = tangent.astype(np.float64)
    twist = np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])
    np.testing.assert_allclose(poses.exp_se3(tangent), expm(twist), **ACCUMULATED)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 0.5, 2.0])
def test_exp_se2_is_the_matrix_exponential(scale: float) -> None:
    tangent = (np.random.default_rng(10).normal(size=3) * scale).astype(np.float32)
    vx, vy, w = tangent.astype(np.float64)
    twist = np.array([[0, -w, vx], [w, 0, vy], [0, 0, 0]])
    np.testing.assert_allclose(poses.exp_se2(tangent), expm(twist), **ACCUMULATED)


@pytest.mark.parametrize(("exp", "log", "size"), [("exp_se2", "log_se2", 3), ("exp_se3", "log_se3", 6)])
def test_log_undoes_exp(exp: str, log: str, size: int) -> None:
    tangent = np.random.default_rng(11).uniform(-1, 1, (30, size)).astype(np.float32)
    np.testing.assert_allclose(getattr(poses, log)(getattr(poses, exp)(tangent)), tangent, **ACCUMULATED)


@pytest.mark.parametrize(("exp", "log", "size"), [("exp_se2", "log_se2", 3), ("exp_se3", "log_se3", 6)])
def test_derivative_of_exp_and_log_at_zero_is_right(exp: str, log: str, size: int) -> None:
    round_trip = jax.jit(jax.jacobian(lambda tangent: getattr(poses, log)(getattr(poses, exp)(tangent))))
    np.testing.assert_allclose(round_trip(jnp.zeros(size)), np.eye(size), **ROUNDING)


def test_quaternions_are_those_of_scipy_in_file_order() -> None:
    rotation = Rotation.from_quat(np.random.default_rng(12).normal(size=(50, 4)))
    xyzw = rotation.as_quat(canonical=True).astype(np.float32)
    R = rotation.as_matrix().astype(np.float32)
    np.testing.assert_allclose(poses.rotation_from_quaternion_xyzw(xyzw), R, **ROUNDING)
    np.testing.assert_allclose(poses.rotation_from_quaternion_xyzw(-3 * xyzw), R, **ROUNDING)
    np.testing.assert_allclose(poses.quaternion_xyzw_from_rotation(R), xyzw, **ACCUMULATED)


def test_zero_quaternion_is_the_identity_with_finite_gradient() -> None:
    np.testing.assert_array_equal(poses.rotation_from_quaternion_xyzw(jnp.zeros(4)), np.eye(3))
    assert np.isfinite(jax.jit(jax.jacobian(poses.rotation_from_quaternion_xyzw))(jnp.zeros(4))).all()


def test_wrong_matrix_size_is_named(as_user) -> None:
    with pytest.raises(ValueError, match="T_a_b: expected shape"):
        poses.transform_points(jnp.eye(4), jnp.ones((5, 2)))


@pytest.mark.parametrize(
    ("name", "shape"),
    [("exp_se2", (5, 3)), ("exp_se3", (5, 6)), ("matrix_from_pose2", (5, 3)), ("inverse_pose2", (5, 3))],
)
def test_second_call_compiles_nothing(name: str, shape: tuple[int, ...], assert_compiles_nothing) -> None:
    getattr(poses, name)(np.full(shape, 0.1, np.float32))
    with assert_compiles_nothing():
        getattr(poses, name)(np.full(shape, 0.2, np.float32))
