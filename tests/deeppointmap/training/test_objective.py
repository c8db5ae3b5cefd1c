from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap.training.objective import ObjectiveConfig, TrainingSide, matching_loss, training_pairs
from dpmjax.geometry import rigid
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED

T_B_A = np.asarray(rigid.exp(np.array([5.0, -3.0, 0.5, 0.02, -0.05, 1.2], np.float32)))
CONFIG = ObjectiveConfig(max_close=12)


def positions(seed: int, m: int = 40, n: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 6, size=(m, 3)).astype(np.float32)
    b = np.asarray(rigid.transform_points(T_B_A, rng.uniform(0, 6, size=(n, 3)).astype(np.float32)))
    return a, b


def sides(seed: int, mask_a=None, mask_b=None, poison: bool = False) -> tuple[TrainingSide, TrainingSide]:
    rng = np.random.default_rng(100 + seed)
    places = positions(seed)
    masks = [np.ones(len(p), bool) if m is None else m for p, m in zip(places, (mask_a, mask_b), strict=True)]
    close = training_pairs(*map(toy.cloud, places, masks), T_B_A, config=CONFIG)
    result = []
    for place, mask, pairs in zip(places, masks, close, strict=True):
        matched, coarse = rng.normal(size=(2, len(place), 16)).astype(np.float32)
        offsets = rng.normal(size=pairs.offsets.shape).astype(np.float32)
        arrays = [place, matched, coarse]
        if poison:
            arrays = [np.where(mask[:, None], array, np.nan).astype(np.float32) for array in arrays]
            offsets = np.where(np.asarray(pairs.mask)[..., None], offsets, np.nan)
        place, matched, coarse = (jnp.asarray(array) for array in arrays)
        result.append(TrainingSide(place, jnp.asarray(mask), matched, coarse, pairs, jnp.asarray(offsets)))
    return result[0], result[1]


@jax.jit
@jax.value_and_grad
def value_and_gradient(features: tuple[jax.Array, ...], a: TrainingSide, b: TrainingSide) -> jax.Array:
    a = a.replace(matched_features=features[0], coarse_features=features[1], offsets=features[2])
    return matching_loss(a, b, T_B_A, config=CONFIG)[0]


def gradients(a: TrainingSide, b: TrainingSide) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    return value_and_gradient((a.matched_features, a.coarse_features, a.offsets), a, b)


@pytest.mark.parametrize("num_valid", [0, 1, 30])
def test_masked_descriptors_reach_neither_value_nor_gradient(num_valid: int) -> None:
    masks = np.arange(40) < num_valid, np.random.default_rng(3).random(50) < 0.7
    clean, poisoned = sides(3, *masks), sides(3, *masks, poison=True)

    (expected, _), (value, gradient) = gradients(*clean), gradients(*poisoned)
    np.testing.assert_allclose(value, expected, **ACCUMULATED)
    for leaf in gradient:
        assert np.isfinite(leaf).all()
        assert not np.any(leaf[num_valid:])


def test_clouds_far_apart_cost_nothing() -> None:
    a, b = positions(4)
    T_far = T_B_A.copy()
    T_far[:3, 3] += 1000
    close = training_pairs(toy.cloud(a), toy.cloud(b), T_far, config=CONFIG)
    assert not any(np.any(pairs.mask) for pairs in close)
    near = sides(4)
    far = [side.replace(close=pairs) for side, pairs in zip(near, close, strict=True)]
    total, terms = matching_loss(*far, T_far, config=CONFIG)
    assert total == 0
    assert terms.num_positives == 0


def test_without_weight_offsets_reach_neither_loss_nor_gradient() -> None:
    bare = replace(CONFIG, offset_weight=0.0)
    a, b = sides(10)
    total, terms = matching_loss(a, b, T_B_A, config=CONFIG)
    lost = a.replace(offsets=a.offsets * jnp.nan)
    value, of_bare = matching_loss(lost, b, T_B_A, config=bare)
    np.testing.assert_allclose(value, total - terms.offset, **ACCUMULATED)
    assert of_bare.offset == 0 < terms.offset
    gradient = jax.grad(lambda x: matching_loss(a.replace(offsets=x), b, T_B_A, config=bare)[0])(lost.offsets)
    assert not np.any(gradient)
