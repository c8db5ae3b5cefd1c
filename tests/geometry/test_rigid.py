import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se3
from tests.tolerances import ACCUMULATED, DOUBLE, ROUNDING


def random_motions(seed: int, n: int, dim: int = 3, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(dim + 1), (n, 1, 1))
    turns = rng.uniform(-1.5, 1.5, (n, 3)) * ([0, 0, 1] if dim == 2 else 1)
    R = Rotation.from_rotvec(scale * turns).as_matrix()
    T[:, :dim, :dim], T[:, :dim, dim] = R[:, :dim, :dim], scale * rng.normal(size=(n, dim))
    return T


@pytest.mark.parametrize("num", [3, 6])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 0.5, 2.0])
def test_exp_is_the_matrix_exponential(scale: float, num: int) -> None:
    tangent = (np.random.default_rng(9).normal(size=num) * scale).astype(np.float32)
    if num == 3:
        vx, vy, w = tangent.astype(np.float64)
        twist = np.array([[0, -w, vx], [w, 0, vy], [0, 0, 0]])
    else:
        twist = twist_matrix(tangent)
    np.testing.assert_allclose(rigid.exp(tangent), expm(twist), **ACCUMULATED)


def twist_matrix(tangent: np.ndarray) -> np.ndarray:
    vx, vy, vz, wx, wy, wz = tangent.astype(np.float64)
    return np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])


@pytest.mark.parametrize("turn", [0.0, 1e-6, 1e-3, 3e-3, 0.03, 0.3, 0.4, 3.0])
def test_exp_of_a_long_way_with_a_small_turn_is_the_matrix_exponential(turn: float) -> None:
    tangent = np.array([1, 20, -3, 0, 0.6 * turn, 0.8 * turn], np.float32)
    np.testing.assert_allclose(rigid.exp(tangent), expm(twist_matrix(tangent)), atol=2e-5)


@pytest.mark.parametrize("turn", [0.0, 1e-4])
def test_derivative_of_exp_is_that_of_finite_differences(turn: float, float64) -> None:
    tangent, h = np.array([1.0, 20, -3, 0, 0, turn]), 1e-4
    steps = h * np.eye(6)
    expected = [(expm(twist_matrix(tangent + s)) - expm(twist_matrix(tangent - s))) / (2 * h) for s in steps]
    np.testing.assert_allclose(jax.jacobian(rigid.exp)(tangent), np.stack(expected, axis=-1), atol=1e-6)


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    twists, points = np.full((5, 6), 0.1, np.float32), np.ones((5, 3), np.float32)
    rigid.transform_points(rigid.exp(twists)[0], points)
    with assert_compiles_nothing():
        rigid.transform_points(rigid.exp(2 * twists)[0], 2 * points)


@pytest.mark.parametrize("dim", [2, 3])
def test_transform_points_is_the_homogeneous_product(dim: int) -> None:
    T = random_motions(5, 6, dim)
    points = np.random.default_rng(6).normal(size=(6, 9, dim)).astype(np.float32)
    homogeneous = np.concatenate([points, np.ones((6, 9, 1), np.float32)], -1).astype(np.float64)
    expected = np.einsum("nij,nbj->nbi", T, homogeneous)[..., :dim]
    np.testing.assert_allclose(rigid.transform_points(T.astype(np.float32), points), expected, **ROUNDING)


@pytest.mark.parametrize("dim", [2, 3])
def test_inverse_undoes_a_motion(dim: int) -> None:
    T = random_motions(8, 10, dim)
    np.testing.assert_allclose(rigid.inverse(T) @ T, np.tile(np.eye(dim + 1), (10, 1, 1)), **DOUBLE)
    single = jnp.asarray(T, jnp.float32)
    np.testing.assert_allclose(rigid.inverse(single), np.linalg.inv(T), **ROUNDING)


def test_twists_keep_float32_where_jax_has_64_bits(float64) -> None:
    twist = jnp.ones(6, jnp.float32)
    T = rigid.exp(twist)
    found = se3.log(T)
    assert T.dtype == found.dtype == rigid.exp(twist[:3]).dtype == np.float32
    np.testing.assert_allclose(found, twist, **ROUNDING)


def test_log_undoes_exp() -> None:
    tangent = np.random.default_rng(11).uniform(-1, 1, (30, 6)).astype(np.float32)
    np.testing.assert_allclose(se3.log(rigid.exp(tangent)), tangent, **ACCUMULATED)


def test_derivative_of_exp_and_log_at_zero_is_right() -> None:
    round_trip = jax.jit(jax.jacobian(lambda tangent: se3.log(rigid.exp(tangent))))
    np.testing.assert_allclose(round_trip(jnp.zeros(6)), np.eye(6), **ROUNDING)


def test_adjoint_moves_steps_to_the_other_side(float64) -> None:
    T, step = random_motions(3, 10), 0.1 * np.random.default_rng(4).normal(size=(10, 6))
    moved = np.einsum("nij,nj->ni", se3.adjoint(T), step)
    np.testing.assert_allclose(rigid.exp(moved) @ T, T @ np.asarray(rigid.exp(step)), **DOUBLE)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-2, 1.0])
def test_derivative_of_log_is_that_of_finite_differences(scale: float, float64) -> None:
    T, h = random_motions(5, 4, scale=scale), 1e-6
    steps = h * np.eye(6)
    forward, backward = (np.asarray(se3.log(T[:, None] @ np.asarray(rigid.exp(sign * steps)))) for sign in (1, -1))
    expected = np.swapaxes(forward - backward, 1, 2) / (2 * h)
    np.testing.assert_allclose(se3.log_jacobian(T), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("turn", [1e-5, 3e-3, 0.1, 0.6, 0.8, 2.5])
def test_derivative_of_log_keeps_its_digits_at_any_turn(turn: float) -> None:
    """The oracle inverts the right Jacobian, the series of (-ad)^k / (k + 1)!, in float64."""
    twist = np.array([1, -2, 3, 0.48 * turn, -0.6 * turn, 0.64 * turn], np.float32)
    v, w = (np.cross(np.eye(3), part.astype(np.float64)) for part in (twist[:3], twist[3:]))
    ad = np.block([[w, v], [np.zeros((3, 3)), w]])
    right, term = np.zeros((6, 6)), np.eye(6)
    for k in range(40):
        right, term = right + term, term @ -ad / (k + 2)
    np.testing.assert_allclose(se3.log_jacobian(rigid.exp(twist)), np.linalg.inv(right), atol=2e-5)


def test_rounding_errors_of_a_rotation_are_removed() -> None:
    T = random_motions(6, 1)[0]
    rough = T.copy()
    rough[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    R = se3.orthonormal(rough)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(se3.orthonormal(T), T, atol=1e-12)
