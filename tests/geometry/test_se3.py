from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry import rigid, se3
from tests.tolerances import ACCUMULATED, DOUBLE, ROUNDING


def test_log_undoes_exp() -> None:
    tangent = np.random.default_rng(11).uniform(-1, 1, (30, 6)).astype(np.float32)
    np.testing.assert_allclose(se3.log(rigid.exp(tangent)), tangent, **ACCUMULATED)


def test_derivative_of_exp_and_log_at_zero_is_right() -> None:
    round_trip = jax.jit(jax.jacobian(lambda tangent: se3.log(rigid.exp(tangent))))
    np.testing.assert_allclose(round_trip(jnp.zeros(6)), np.eye(6), **ROUNDING)


def random_motions(seed: int, count: int, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(scale * rng.uniform(-1.5, 1.5, (count, 3))).as_matrix()
    T[:, :3, 3] = scale * rng.normal(size=(count, 3))
    return T


def test_adjoint_moves_steps_to_the_other_side(float64) -> None:
    T, step = random_motions(3, 10), 0.1 * np.random.default_rng(4).normal(size=(10, 6))
    moved = np.einsum("nij,nj->ni", se3.adjoint(T), step)
    np.testing.assert_allclose(rigid.exp(moved) @ T, T @ np.asarray(rigid.exp(step)), **DOUBLE)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-2, 1.0])
def test_derivative_of_log_is_that_of_finite_differences(scale: float, float64) -> None:
    T, h = random_motions(5, 4, scale), 1e-6
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
