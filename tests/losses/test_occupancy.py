import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import occupancy_loss
from tests.tolerances import ACCUMULATED, ROUNDING


def example(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    logits = rng.normal(scale=3, size=(4, 7, 2)).astype(np.float32)
    return logits, rng.integers(0, 2, logits.shape).astype(np.float32), rng.uniform(size=(4, 7, 1)).astype(np.float32)


@pytest.mark.parametrize("seed", [0, 1])
def test_loss_is_its_definition(seed: int) -> None:
    logits, labels, weights = (array.astype(np.float64) for array in example(seed))
    p = 1 / (1 + np.exp(-logits))
    cross_entropy = -labels * np.log(p) - (1 - labels) * np.log(1 - p)
    expected = np.average(cross_entropy, weights=np.broadcast_to(weights, logits.shape))
    np.testing.assert_allclose(occupancy_loss(*example(seed)), expected, **ACCUMULATED)


@pytest.mark.parametrize("seed", [0, 1])
def test_gradient_is_probability_less_label(seed: int) -> None:
    logits, labels, weights = (array.astype(np.float64) for array in example(seed))
    logits[0, 0] = 0.0
    share = np.broadcast_to(weights, logits.shape) / np.broadcast_to(weights, logits.shape).sum()
    by_logits, by_labels = jax.grad(occupancy_loss, argnums=(0, 1))(*map(jnp.float32, (logits, labels, weights)))
    np.testing.assert_allclose(by_logits, share * (1 / (1 + np.exp(-logits)) - labels), **ACCUMULATED)
    np.testing.assert_allclose(by_labels, -share * logits, **ACCUMULATED)


def test_loss_and_gradient_are_zero_without_weight() -> None:
    logits, labels, weights = example(3)
    assert float(occupancy_loss(logits, labels, 0 * weights)) == 0
    np.testing.assert_array_equal(jax.grad(occupancy_loss)(logits, labels, 0 * weights), 0)


@pytest.mark.parametrize("logit", [-200.0, 200.0])
def test_certain_and_wrong_is_costly_and_finite(logit: float) -> None:
    label = jnp.array([0.0 if logit > 0 else 1.0])
    loss, gradient = jax.value_and_grad(occupancy_loss)(jnp.array([logit]), label, jnp.ones(1))
    np.testing.assert_allclose(loss, 200, **ROUNDING)
    np.testing.assert_allclose(np.abs(gradient), 1, **ROUNDING)
