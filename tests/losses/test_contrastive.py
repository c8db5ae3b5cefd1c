from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import info_nce
from tests.tolerances import ACCUMULATED, GRADIENT, ROUNDING

GRADIENTS = jax.jit(jax.grad(info_nce, argnums=(0, 1)))


def example(seed: int, m: int = 6, n: int = 9, c: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    positives = rng.integers(0, n, m).astype(np.int32)
    return rng.normal(size=(m, c)).astype(np.float32), rng.normal(size=(n, c)).astype(np.float32), positives


def info_nce_in_numpy(queries, keys, positives, temperature=0.1, ignore=None, mask=None) -> float:
    """The definition, one query and one key at a time, in float64."""
    losses = []
    for i, query in enumerate(queries.astype(np.float64)):
        if positives[i] < 0 or (mask is not None and not mask[i]):
            continue
        terms = {}
        for j, key in enumerate(keys.astype(np.float64)):
            if j == positives[i] or ignore is None or not ignore[i, j]:
                terms[j] = np.exp(query @ key / np.linalg.norm(query) / np.linalg.norm(key) / temperature)
        losses.append(-np.log(terms[positives[i]] / sum(terms.values())))
    return float(np.mean(losses)) if losses else 0.0


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("temperature", [0.05, 0.1, 1.0])
def test_loss_is_its_definition(seed: int, temperature: float) -> None:
    arguments = (*example(seed), temperature)
    np.testing.assert_allclose(info_nce(*arguments), info_nce_in_numpy(*arguments), **ACCUMULATED)


@pytest.mark.parametrize("seed", [2, 3])
def test_ignored_pairs_and_masked_queries_are_left_out(seed: int) -> None:
    queries, keys, positives = example(seed)
    rng = np.random.default_rng(seed)
    ignore, mask = rng.random((6, 9)) < 0.4, rng.random(6) < 0.7
    positives[0] = -1
    arguments = (queries, keys, positives, 0.1, ignore, mask)
    np.testing.assert_allclose(info_nce(*arguments), info_nce_in_numpy(*arguments), **ACCUMULATED)


def test_positive_is_never_ignored() -> None:
    queries, keys, positives = example(4)
    # With everything else ignored, the positive is all that is left: a certain match.
    loss = info_nce(queries, keys, positives, ignore=np.ones((6, 9), bool))
    np.testing.assert_allclose(loss, 0, atol=1e-6)


def test_lengths_of_descriptors_do_not_count() -> None:
    queries, keys, positives = example(5)
    for factor in (1e-20, 1e20):
        scaled = info_nce(queries * np.float32(factor), keys, positives)
        np.testing.assert_allclose(scaled, info_nce(queries, keys, positives), **ROUNDING)


@pytest.mark.parametrize("nothing", ["positives", "mask", "keys", "queries"])
def test_loss_and_gradient_are_zero_when_nothing_counts(nothing: str) -> None:
    queries, keys, positives = example(6)
    mask = np.ones(6, bool)
    if nothing == "positives":
        positives[:] = -1
    elif nothing == "mask":
        mask[:] = False
    elif nothing == "keys":
        keys = keys[:0]
    else:
        queries, positives, mask = queries[:0], positives[:0], mask[:0]
    assert float(info_nce(queries, keys, positives, mask=mask)) == 0
    for gradient in GRADIENTS(queries, keys, positives, 0.1, None, mask):
        np.testing.assert_array_equal(gradient, 0)


def test_padding_changes_nothing() -> None:
    queries, keys, positives = example(7)
    padded_queries = np.concatenate([queries, np.full((2, 5), np.nan, np.float32)])
    padded_keys = np.concatenate([keys, np.full((3, 5), np.nan, np.float32)])
    padded_positives = np.concatenate([positives, [-1, 4]]).astype(np.int32)
    ignore = np.zeros((8, 12), bool)
    ignore[:, 9:] = True
    arguments = (padded_queries, padded_keys, padded_positives, 0.1, ignore, np.arange(8) < 6)
    np.testing.assert_allclose(info_nce(*arguments), info_nce(queries, keys, positives), **ROUNDING)
    expected = GRADIENTS(queries, keys, positives)
    for gradient, wanted, size in zip(GRADIENTS(*arguments), expected, (6, 9), strict=True):
        np.testing.assert_allclose(np.asarray(gradient)[:size], wanted, **ROUNDING)
        np.testing.assert_array_equal(np.asarray(gradient)[size:], 0)


def test_gradient_equals_finite_differences() -> None:
    queries, keys, positives = example(8)
    step, expected = 1e-6, np.zeros(queries.shape)
    for index in np.ndindex(queries.shape):
        moved = [queries.astype(np.float64) for _ in range(2)]
        moved[0][index] += step
        moved[1][index] -= step
        forward, backward = (info_nce_in_numpy(q, keys, positives) for q in moved)
        expected[index] = (forward - backward) / (2 * step)
    np.testing.assert_allclose(GRADIENTS(queries, keys, positives)[0], expected, **GRADIENT)


def test_zero_vectors_have_finite_gradients() -> None:
    queries, keys, positives = example(9)
    queries[1] = keys[positives[2]] = 0
    assert np.isfinite(info_nce(queries, keys, positives))
    assert all(np.isfinite(gradient).all() for gradient in GRADIENTS(queries, keys, positives))


def test_second_call_compiles_nothing(assert_compiles_nothing) -> None:
    info_nce(*example(0), temperature=0.1)
    with assert_compiles_nothing():
        info_nce(*example(1), temperature=0.2)


def test_wrong_arguments_are_named(as_user) -> None:
    queries, keys, positives = map(jnp.asarray, example(0))
    with pytest.raises(ValueError, match="^keys: expected shape"):
        info_nce(queries, keys[:, :3], positives)
    with pytest.raises(ValueError, match="^positives: expected shape"):
        info_nce(queries, keys, positives[:3])
    with pytest.raises(ValueError, match="^positives: expected integers"):
        info_nce(queries, keys, positives.astype(float))
    with pytest.raises(ValueError, match="^ignore: expected bool of shape"):
        info_nce(queries, keys, positives, ignore=jnp.zeros((9, 6), bool))
    with pytest.raises(ValueError, match="^mask: expected bool"):
        info_nce(queries, keys, positives, mask=jnp.ones(6))
    with pytest.raises(ValueError, match="^temperature: expected a number above 0"):
        info_nce(queries, keys, positives, temperature=0.0)
