from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se3
from tests.tolerances import ACCUMULATED, DOUBLE, ROUNDING


def random_motions(seed: int, n: int, dim: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(dim + 1), (n, 1, 1))
    axis = np.array([0, 0, 1]) if dim == 2 else rng.normal(size=(n, 3))
    R = Rotation.from_rotvec(rng.uniform(-2, 2, (n, 1)) * axis).as_matrix()
    T[:, :dim, :dim], T[:, :dim, dim] = R[:, :dim, :dim], rng.normal(size=(n, dim))
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


def test_another_number_of_coordinates_is_no_twist(as_user) -> None:
    with pytest.raises(ValueError, match="^tangent: expected"):
        rigid.exp(np.zeros((2, 4), np.float32))


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


def test_wrong_matrix_size_is_named(as_user) -> None:
    with pytest.raises(ValueError, match="T_a_b: expected shape"):
        rigid.transform_points(jnp.eye(4), jnp.ones((5, 2)))


def test_twists_keep_float32_where_jax_has_64_bits(float64) -> None:
    twist = jnp.ones(6, jnp.float32)
    T = rigid.exp(twist)
    found = se3.log(T)
    assert T.dtype == found.dtype == rigid.exp(twist[:3]).dtype == np.float32
    np.testing.assert_allclose(found, twist, **ROUNDING)
