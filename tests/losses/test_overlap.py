from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.losses import overlap_loss
from tests.tolerances import ROUNDING


def pairs(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 3 * rng.normal(size=20).astype(np.float32), rng.random(20) < 0.5


@pytest.mark.parametrize("seed", [0, 1])
def test_loss_is_the_binary_cross_entropy(seed: int) -> None:
    logits, labels = pairs(seed)
    probability = 1 / (1 + np.exp(-logits.astype(np.float64)))
    expected = -np.mean(np.where(labels, np.log(probability), np.log(1 - probability)))
    np.testing.assert_allclose(overlap_loss(logits, labels), expected, **ROUNDING)


def test_certain_and_wrong_is_finite() -> None:
    value, gradient = jax.value_and_grad(overlap_loss)(jnp.array([200.0, -200.0]), np.array([False, True]))
    np.testing.assert_allclose(value, 200, **ROUNDING)
    np.testing.assert_allclose(gradient, [0.5, -0.5], **ROUNDING)


@pytest.mark.parametrize("num_valid", [0, 1, 12])
def test_padded_equals_unpadded(num_valid: int) -> None:
    logits, labels = pairs(2)
    mask = np.arange(20) < num_valid
    hidden = np.where(mask, logits, np.nan).astype(np.float32)
    value, gradient = jax.value_and_grad(overlap_loss)(jnp.asarray(hidden), labels, mask)
    expected = overlap_loss(logits[:num_valid], labels[:num_valid]) if num_valid else 0
    np.testing.assert_allclose(value, expected, **ROUNDING)
    assert np.isfinite(gradient).all()
    assert not np.any(gradient[num_valid:])


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    overlap_loss(*pairs(3))
    with assert_compiles_nothing():
        overlap_loss(*pairs(4))


def test_wrong_arguments_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^labels: expected dtype bool"):
        overlap_loss(np.ones(4), np.ones(4))
    with pytest.raises(ValueError, match="^labels: expected shape"):
        overlap_loss(np.ones(4), np.ones(3, bool))
    with pytest.raises(ValueError, match="^logits: expected shape"):
        overlap_loss(np.ones((4, 1)), np.ones((4, 1), bool))
