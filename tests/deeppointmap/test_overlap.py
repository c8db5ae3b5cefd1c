"""The evidence of overlap, and the probability that it gives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import correlate
from dpmjax.deeppointmap import overlap_prediction as prediction
from dpmjax.deeppointmap.confidence import OVERLAP_FEATURES, LogisticModel, logistic_probability
from dpmjax.deeppointmap.matching import TEMPERATURE
from dpmjax.deeppointmap.model import decode
from dpmjax.slam import KeyframeMap
from dpmjax.types import DescriptorCloud
from tests.tolerances import ACCUMULATED

NUM = 9


@pytest.fixture(scope="module")
def fitted(model) -> dpmjax.Model:
    weights = np.random.default_rng(0).normal(size=len(OVERLAP_FEATURES))
    overlap = LogisticModel(OVERLAP_FEATURES, tuple(weights.tolist()), 0.3)
    return model.replace(config=replace(model.config, overlap=overlap))


def cloud(seed: int, num_padded: int = 0) -> DescriptorCloud:
    """Random descriptors; padded ones hold NaN."""
    rng = np.random.default_rng(seed)
    positions, features = rng.normal(0, 10, (NUM, 3)), rng.normal(size=(NUM, 8))
    rows = [(0, num_padded), (0, 0)]
    padded = [np.pad(array, rows, constant_values=np.nan).astype(np.float32) for array in (positions, features)]
    return DescriptorCloud(*map(jnp.asarray, padded), jnp.arange(NUM + num_padded) < NUM)


def test_evidence_has_the_names_that_the_probability_is_fitted_on() -> None:
    assert prediction.OverlapEvidence._fields == OVERLAP_FEATURES


@pytest.mark.slow
def test_evidence_of_the_descriptors_is_that_of_numpy(model) -> None:
    a, b = cloud(1), cloud(2)
    heads = [decode(model, one.features, part="similarity_head") for one in correlate(model, a, b)]
    features = [np.asarray(head, float) for head in heads]
    unit = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in features]
    similarity = unit[0] @ unit[1].T
    exponential = np.exp(similarity / TEMPERATURE)
    scores = exponential**2 / (exponential.sum(axis=1, keepdims=True) * exponential.sum(axis=0))

    def quantile(values: np.ndarray, share: float) -> float:
        best = [np.sort(values.max(axis=axis))[int(share * (NUM - 1))] for axis in (0, 1)]
        return float(np.mean(best))

    mutual = sum(scores[:, column].argmax() == row for row, column in enumerate(scores.argmax(axis=1)))
    means = [np.asarray(one.features, float) for one in (a, b)]
    means = [(x / np.linalg.norm(x, axis=1, keepdims=True)).sum(axis=0) for x in means]
    radii = [np.linalg.norm(one.positions, axis=1).mean() + 1 for one in (a, b)]
    expected = {
        "scan_similarity": means[0] @ means[1] / np.linalg.norm(means[0]) / np.linalg.norm(means[1]),
        "similarity_median": quantile(similarity, 0.5),
        "similarity_high": quantile(similarity, prediction.HIGH),
        "score_median": quantile(scores, 0.5),
        "score_high": quantile(scores, prediction.HIGH),
        "mutual_share": mutual / NUM,
        "log_radius": np.log(min(radii)),
        "log_radius_ratio": abs(np.log(radii[0] / radii[1])),
    }
    found = prediction.overlap_evidence(model, a, b)
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(found, name), value, err_msg=name, **ACCUMULATED)
    assert 0 <= found.support_second <= found.support <= 1
    assert 0 <= found.near_support <= found.support


@pytest.mark.slow
def test_padded_equals_unpadded(model) -> None:
    found, expected = (
        prediction.overlap_evidence(model, cloud(1, 3), cloud(2, 5)),
        prediction.overlap_evidence(model, cloud(1), cloud(2)),
    )
    np.testing.assert_allclose(found, expected, **ACCUMULATED)


@pytest.mark.parametrize("side", [0, 1])
def test_an_empty_or_broken_cloud_overlaps_nothing(fitted, side: int) -> None:
    some = cloud(1)
    empty = replace(some, mask=jnp.zeros(NUM, bool))
    broken = replace(some, features=some.features.at[2].set(jnp.nan))
    pairs = [[other, some][:: 1 - 2 * side] for other in (empty, broken)]
    assert np.isfinite(prediction.overlap_evidence(fitted, *pairs[0])).all()
    assert [float(prediction.overlap_probability(fitted, *pair)) for pair in pairs] == [0, 0]


def test_the_probability_is_the_logistic_function_of_the_evidence(fitted, assert_compiles_nothing) -> None:
    a, b = cloud(1), cloud(2)
    expected = logistic_probability(fitted.config.overlap, np.asarray(prediction.overlap_evidence(fitted, a, b), float))
    np.testing.assert_allclose(prediction.overlap_probability(fitted, a, b), expected, **ACCUMULATED)
    with assert_compiles_nothing():
        prediction.overlap_probability(fitted, b, cloud(3))


def test_a_model_without_a_fit_answers_with_its_trained_head(model, fitted) -> None:
    a, b = cloud(1), cloud(2)
    expected = jax.nn.sigmoid(decode(model, *correlate(model, a, b), part="overlap_logit"))
    np.testing.assert_allclose(prediction.overlap_probability(model, a, b), expected, **ACCUMULATED)
    np.testing.assert_array_equal(prediction.head_probability(fitted, a, b), prediction.head_probability(model, a, b))


@pytest.mark.parametrize(
    "call",
    [
        lambda model: dpmjax.overlap(model, cloud(1), cloud(2)),
        lambda model: dpmjax.overlap_pairs(model, [cloud(1)], [cloud(2)]),
        lambda model: prediction.overlap_probability(model, cloud(1), cloud(2)),
        lambda model: prediction.head_probability(model, cloud(1), cloud(2)),
        lambda model: dpmjax.run_slam(model, []),
        lambda model: dpmjax.run_agents(model, [[], []]),
        lambda model: dpmjax.merge_maps(model, *[KeyframeMap()] * 2),
        lambda model: dpmjax.localize(model, KeyframeMap(), np.zeros((0, 3))),
    ],
    ids=["overlap", "overlap_pairs", "overlap_probability", "head", "run_slam", "run_agents", "merge_maps", "localize"],
)
def test_overlap_that_was_never_trained_is_refused_by_the_name_of_the_command(model, call) -> None:
    untrained = model.replace(config=replace(model.config, trained=("registration",)))
    with pytest.raises(ValueError, match="dpmjax train --stages overlap --weights FILE"):
        call(untrained)
