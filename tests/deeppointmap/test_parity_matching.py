"""Matching and losses against published values: `case.npz` of the parity folder, the heads' outputs remade in NumPy."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap.matching import MatchConfig
from dpmjax.deeppointmap.training.objective import ObjectiveConfig, TrainingSide, matching_loss, training_pairs
from tests.deeppointmap import toy
from tests.optional import import_or_skip

FOLDER = Path(os.environ.get("DPMJAX_PARITY", Path(__file__).parents[3] / "shared" / "parity" / "small"))
PARITY: dict[str, Any] = {"rtol": 1e-4, "atol": 1e-5}

pytestmark = pytest.mark.skipif(
    not (FOLDER / "case.npz").is_file(), reason="published values: set DPMJAX_PARITY to the folder of case.npz"
)


@pytest.fixture(scope="module")
def case() -> dict[str, np.ndarray]:
    with np.load(FOLDER / "case.npz") as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def decoder() -> dict[str, np.ndarray]:
    torch = import_or_skip("torch")
    weights = torch.load(FOLDER / "weights.pth", map_location="cpu", weights_only=True)["decoder"]
    return {name: value.double().numpy().reshape(value.shape[:2]) for name, value in weights.items()}


def linear(decoder: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    return x @ decoder[f"{name}.weight"].T + decoder[f"{name}.bias"].reshape(-1)


def two_layers(decoder: dict[str, np.ndarray], name: str, x: np.ndarray) -> np.ndarray:
    return linear(decoder, f"{name}.2", np.maximum(linear(decoder, f"{name}.0", x), 0))


def offset_head(decoder: dict[str, np.ndarray], features: np.ndarray, partners: np.ndarray) -> np.ndarray:
    pair = x = np.concatenate([features, partners], axis=-1).astype(np.float64)
    x = np.maximum(linear(decoder, "offset_head.mlp.0", x), 0)
    x = np.maximum(linear(decoder, "offset_head.mlp.2", x), 0)
    x = linear(decoder, "offset_head.mlp.4", x) + linear(decoder, "offset_head.downsample", pair)
    return linear(decoder, "offset_head.head", np.maximum(x, 0))


def test_similarity_is_the_cosine_after_the_head(case, decoder) -> None:
    heads = [two_layers(decoder, "similarity_head", case[f"correlated_features_{side}"]) for side in "ab"]
    a, b = (head / np.linalg.norm(head, axis=1, keepdims=True) for head in heads)
    np.testing.assert_allclose(a @ b.T, case["similarity"], **PARITY)


def test_registration_is_the_published_one(case, decoder) -> None:
    features = case["correlated_features_a"], case["correlated_features_b"]

    def predict_offsets(source, target):
        a, b = features[0][np.asarray(source)], features[1][np.asarray(target)]
        offsets = offset_head(decoder, a, b), offset_head(decoder, b, a)
        return tuple(jnp.asarray(offset, jnp.float32) for offset in offsets)

    match = toy.best_match(
        toy.cloud(case["descriptor_xyz_a"], ~case["descriptor_padding_a"]),
        toy.cloud(case["descriptor_xyz_b"], ~case["descriptor_padding_b"]),
        case["similarity"],
        predict_offsets,
        config=MatchConfig(),
    )
    np.testing.assert_allclose(match.T_target_source[:3, :3], case["registration_rotation"], **PARITY)
    np.testing.assert_allclose(match.T_target_source[:3, 3], case["registration_translation"], **PARITY)
    np.testing.assert_allclose(match.rmse, case["registration_rmse"][0], **PARITY)
    published = case["registration_confidence"]
    assert int(match.num_inliers) == len(published)
    np.testing.assert_allclose(np.asarray(match.scores)[np.asarray(match.is_inlier)], published, **PARITY)
    np.testing.assert_allclose(match.confidence, published[:30].mean(), **PARITY)


def test_losses_are_the_published_ones(case, decoder) -> None:
    config = ObjectiveConfig()
    positions = [case[f"descriptor_xyz_{side}"] for side in "ab"]
    masks = [~case[f"descriptor_padding_{side}"] for side in "ab"]
    correlated = [case[f"correlated_features_{side}"] for side in "ab"]
    T_b_a = case["T_b_a"].astype(np.float32)
    close = training_pairs(*map(toy.cloud, positions, masks), T_b_a, config=config)
    sides = []
    for here, there in ((0, 1), (1, 0)):
        partners = correlated[there][np.asarray(close[here].indices)]
        own = np.broadcast_to(correlated[here][:, None], partners.shape)
        sides.append(
            TrainingSide(
                positions=jnp.asarray(positions[here]),
                mask=jnp.asarray(masks[here]),
                matched_features=jnp.asarray(two_layers(decoder, "similarity_head", correlated[here]), jnp.float32),
                coarse_features=jnp.asarray(
                    two_layers(decoder, "coarse_pairing_head", case[f"descriptor_features_{'ab'[here]}"]), jnp.float32
                ),
                close=close[here],
                offsets=jnp.asarray(offset_head(decoder, own, partners), jnp.float32),
            )
        )
    total, terms = matching_loss(*sides, T_b_a, config=config)
    np.testing.assert_allclose(terms.pairing, case["loss_pairing"], **PARITY)
    np.testing.assert_allclose(terms.coarse, case["loss_coarse_pairing"], **PARITY)
    np.testing.assert_allclose(terms.offset, case["loss_offset"], **PARITY)
    np.testing.assert_allclose(terms.top1_accuracy, case["top1_accuracy"], **PARITY)
    np.testing.assert_allclose(total, case["loss_total"], **PARITY)
