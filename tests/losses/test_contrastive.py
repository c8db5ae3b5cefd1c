import jax
import numpy as np
import pytest

from dpmjax import info_nce
from tests.tolerances import ACCUMULATED, ROUNDING

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
    # All keys but the positive are ignored, so the match is certain.
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


def test_zero_vectors_have_finite_gradients() -> None:
    queries, keys, positives = example(9)
    queries[1] = keys[positives[2]] = 0
    assert np.isfinite(info_nce(queries, keys, positives))
    assert all(np.isfinite(gradient).all() for gradient in GRADIENTS(queries, keys, positives))
