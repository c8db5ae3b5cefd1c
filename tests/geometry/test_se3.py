from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dpmjax.geometry import se3
from tests.tolerances import ACCUMULATED, ROUNDING


@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e-3, 0.5, 2.0])
def test_exp_is_the_matrix_exponential(scale: float) -> None:
    tangent = (np.random.default_rng(9).normal(size=6) * scale).astype(np.float32)
    vx, vy, vz, wx, wy, wz = tangent.astype(np.float64)
    twist = np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])
    np.testing.assert_allclose(se3.exp(tangent), expm(twist), **ACCUMULATED)


def test_log_undoes_exp() -> None:
    tangent = np.random.default_rng(11).uniform(-1, 1, (30, 6)).astype(np.float32)
    np.testing.assert_allclose(se3.log(se3.exp(tangent)), tangent, **ACCUMULATED)


def test_derivative_of_exp_and_log_at_zero_is_right() -> None:
    round_trip = jax.jit(jax.jacobian(lambda tangent: se3.log(se3.exp(tangent))))
    np.testing.assert_allclose(round_trip(jnp.zeros(6)), np.eye(6), **ROUNDING)


def test_quaternions_are_those_of_scipy_in_file_order() -> None:
    rotation = Rotation.from_quat(np.random.default_rng(12).normal(size=(50, 4)))
    xyzw = rotation.as_quat(canonical=True).astype(np.float32)
    R = rotation.as_matrix().astype(np.float32)
    np.testing.assert_allclose(se3.rotation_from_quaternion_xyzw(xyzw), R, **ROUNDING)
    np.testing.assert_allclose(se3.rotation_from_quaternion_xyzw(-3 * xyzw), R, **ROUNDING)
    np.testing.assert_allclose(se3.quaternion_xyzw_from_rotation(R), xyzw, **ACCUMULATED)


def test_zero_quaternion_is_the_identity_with_finite_gradient() -> None:
    np.testing.assert_array_equal(se3.rotation_from_quaternion_xyzw(jnp.zeros(4)), np.eye(3))
    assert np.isfinite(jax.jit(jax.jacobian(se3.rotation_from_quaternion_xyzw))(jnp.zeros(4))).all()


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    se3.exp(np.full((5, 6), 0.1, np.float32))
    with assert_compiles_nothing():
        se3.exp(np.full((5, 6), 0.2, np.float32))
