from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap import Model, correlate, init_model, model_preset, overlap
from dpmjax.deeppointmap.model import decode, predict_offsets
from dpmjax.nets import DecoderConfig, attention
from dpmjax.types import DescriptorCloud
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED

CONFIG = replace(
    toy.MODEL,
    encoder=replace(toy.MODEL.encoder, output_channels=64),
    decoder=DecoderConfig(64, model_channels=32, num_layers=2, num_heads=4),
)


@pytest.fixture(scope="module")
def model() -> Model:
    return init_model(jax.random.key(1), CONFIG)


def cloud(seed: int, num_descriptors: int, capacity: int | None = None) -> DescriptorCloud:
    rng = np.random.default_rng(seed)
    capacity = num_descriptors if capacity is None else capacity
    positions, features = np.full((capacity, 3), np.nan), np.full((capacity, 64), np.nan)
    positions[:num_descriptors] = rng.normal(size=(num_descriptors, 3)) * 20
    features[:num_descriptors] = rng.normal(size=(num_descriptors, 64))
    arrays = (jnp.asarray(x, jnp.float32) for x in (positions, features))
    return DescriptorCloud(*arrays, jnp.arange(capacity) < num_descriptors)


@pytest.mark.parametrize("max_live_logits", [1 << 20, 20])
def test_attention_is_a_masked_softmax(max_live_logits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attention, "MAX_LIVE_LOGITS", max_live_logits)
    rng = np.random.default_rng(1)
    queries, keys, values = (rng.normal(size=(n, 2, 3)) for n in (7, 5, 5))
    mask = np.array([True, False, True, True, False])
    found = attention.attend(*(jnp.asarray(x, jnp.float32) for x in (queries, keys, values)), jnp.asarray(mask))
    for head in range(2):
        shares = np.exp(queries[:, head] @ keys[mask, head].T / np.sqrt(3))
        expected = shares / shares.sum(axis=1, keepdims=True) @ values[mask, head]
        np.testing.assert_allclose(found[:, head], expected, **ACCUMULATED)


def test_attention_to_nothing_is_zero() -> None:
    ones = jnp.ones((4, 2, 3))
    assert not attention.attend(ones, ones, ones, jnp.zeros(4, bool)).any()
    assert not attention.attend(ones, ones[:0], ones[:0], jnp.zeros(0, bool)).any()


def test_empty_clouds_give_finite_numbers(model: Model) -> None:
    empty, full = cloud(12, 0, capacity=8), cloud(13, 8)
    for pair in ((empty, full), (empty, empty)):
        correlated = correlate(model, *pair)
        assert not correlated[0].features.any()
        assert all(np.isfinite(side.features).all() for side in correlated)
        assert np.isfinite(overlap(model, *pair))


@pytest.mark.parametrize("num_valid", [0, 6])
def test_gradient_is_finite(num_valid: int) -> None:
    model = init_model(jax.random.key(2), replace(CONFIG, decoder=replace(CONFIG.decoder, num_layers=1)))
    a, b = cloud(14, num_valid, capacity=8), cloud(15, 8)
    value, gradient = loss_and_gradient(model, a, b)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((value, gradient)))


@jax.jit
@jax.value_and_grad
def loss_and_gradient(model: Model, a: DescriptorCloud, b: DescriptorCloud) -> jax.Array:
    p, q = correlate(model, a, b)
    offsets = predict_offsets(model, p.features, q.features)
    similar = decode(model, q.features, part="similarity_head")
    return jnp.sum(offsets**2) + jnp.sum(similar**2) + decode(model, p, q, part="overlap_logit")


def test_gradient_of_attention_in_chunks_is_that_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = [jax.random.normal(jax.random.key(i), (5, 2, 3)) for i in range(3)]
    mask = jnp.array([True, False, True, True, False])

    def gradient() -> list[jax.Array]:
        return jax.jit(jax.grad(lambda arrays: jnp.sum(attention.attend(*arrays, mask) ** 2)))(arrays)

    whole = gradient()
    monkeypatch.setattr(attention, "MAX_LIVE_LOGITS", 15)
    parts = gradient()
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **ACCUMULATED), parts, whole)


@pytest.mark.slow
@pytest.mark.parametrize("is_crossed", [True, False])
def test_features_depend_on_the_other_cloud_and_on_positions_only_if_crossed(is_crossed: bool) -> None:
    config = replace(CONFIG, decoder=replace(CONFIG.decoder, is_crossed=is_crossed))
    model, a = init_model(jax.random.key(3), config), cloud(23, 8)
    first, _ = correlate(model, a, cloud(24, 8))
    beside_another, _ = correlate(model, a, cloud(25, 8))
    moved, _ = correlate(model, a.replace(positions=a.positions + 7.0), cloud(24, 8))
    for other in (beside_another, moved):
        assert np.allclose(first.features, other.features, **ACCUMULATED) != is_crossed
    without_others, _ = correlate(model, a.replace(mask=jnp.arange(8) < 1), cloud(24, 8))
    assert not np.allclose(first.features[0], without_others.features[0], **ACCUMULATED)


def test_wrong_shapes_are_named(as_user, model: Model) -> None:
    wrong = cloud(22, 4).replace(features=jnp.ones((4, 3)))
    with pytest.raises(ValueError, match="^b.features: expected shape .4, 64., got .4, 3."):
        correlate(model, cloud(22, 4), wrong)
    with pytest.raises(ValueError, match="^a.mask: expected shape"):
        correlate(model, cloud(22, 4).replace(mask=jnp.ones(3, bool)), wrong)
    with pytest.raises(
        ValueError, match="^model_channels: expected at least 6 and a multiple of num_heads = 8, got 20"
    ):
        DecoderConfig(model_channels=20)
    with pytest.raises(ValueError, match="^name: expected one of tiny, small, paper, got 'huge'"):
        model_preset("huge")
