import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.losses import offset_loss
from tests.tolerances import ACCUMULATED, GRADIENT


def offsets(seed: int, n: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    predicted, true = rng.normal(size=(2, n, 3)).astype(np.float32)
    return predicted * np.array([1, 0.3, 3], np.float32), true


def offset_loss_in_numpy(predicted: np.ndarray, true: np.ndarray) -> float:
    residuals = predicted.astype(np.float64) - true
    inverse = np.linalg.inv(np.cov(residuals.T))
    return float(np.mean([np.sqrt(r @ inverse @ r) for r in residuals]))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_loss_is_the_mean_mahalanobis_distance(seed: int, scale: float) -> None:
    predicted, true = (np.float32(scale) * array for array in offsets(seed))
    np.testing.assert_allclose(offset_loss(predicted, true), offset_loss_in_numpy(predicted, true), **ACCUMULATED)


def test_covariance_is_constant_for_the_derivative() -> None:
    predicted, true = (array.astype(np.float64) for array in offsets(2))
    residuals = predicted - true
    inverse = np.linalg.inv(np.cov(residuals.T))
    distances = np.sqrt(np.einsum("ni,ij,nj->n", residuals, inverse, residuals))
    expected = residuals @ inverse / distances[:, None] / len(residuals)
    gradient = jax.grad(offset_loss)(jnp.asarray(predicted, jnp.float32), true.astype(np.float32))
    np.testing.assert_allclose(gradient, expected, **GRADIENT)


@pytest.mark.parametrize("case", ["one", "two", "same", "plane", "line"])
def test_singular_covariance_is_the_identity(case: str) -> None:
    predicted, true = offsets(3)
    if case in ("one", "two"):
        predicted, true = predicted[: 1 + (case == "two")], true[: 1 + (case == "two")]
    elif case == "same":
        predicted = true + np.float32(2)
    else:
        difference = (predicted - true) * np.array([1, case == "plane", 0], np.float32)
        predicted = true + difference
    expected = np.mean(np.linalg.norm(predicted.astype(np.float64) - true, axis=1))
    np.testing.assert_allclose(offset_loss(predicted, true), expected, **ACCUMULATED)
    assert np.isfinite(jax.grad(offset_loss)(jnp.asarray(predicted), true)).all()


def test_perfect_prediction_and_no_prediction_have_loss_and_gradient_zero() -> None:
    predicted, true = map(jnp.asarray, offsets(5))
    for arguments in ((true, true), (predicted, true, jnp.zeros(50, bool))):
        value, gradient = jax.value_and_grad(offset_loss)(*arguments)
        assert value == 0
        assert not np.any(gradient)
