"""What the published networks gave on one pair of scans: descriptors, correlated features, similarity, overlap.

The case lies outside the repository; `$DPMJAX_PARITY` names its folder.
"""

from __future__ import annotations

import os
from pathlib import Path

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import Model, correlate, encode_pyramid, overlap, register
from dpmjax.deeppointmap.model import similarity_features
from dpmjax.geometry.pyramid import build_pyramid_on_host
from dpmjax.types import DescriptorCloud
from dpmjax.weights import load_model

FOLDER = Path(os.environ.get("DPMJAX_PARITY", Path(__file__).parents[3] / "shared" / "parity" / "small"))
pytestmark = pytest.mark.skipif(
    not (FOLDER / "case.npz").is_file(), reason=f"no case of the published networks in {FOLDER} (set DPMJAX_PARITY)"
)

RELATIVE = 1e-4


def assert_close(found: jax.Array, expected: np.ndarray) -> None:
    """The largest difference, relative to the largest number there is."""
    assert found.shape == expected.shape
    assert np.abs(np.asarray(found) - expected).max() <= RELATIVE * np.abs(expected).max()


@pytest.fixture(scope="module")
def case() -> dict[str, np.ndarray]:
    with np.load(FOLDER / "case.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(FOLDER / "weights.pth")


def published_cloud(case: dict[str, np.ndarray], name: str) -> DescriptorCloud:
    mask = ~case[f"descriptor_padding_{name}"]
    return DescriptorCloud(case[f"descriptor_xyz_{name}"], case[f"descriptor_features_{name}"], mask)


@pytest.fixture(scope="module")
def encoded(case, model) -> dict[str, DescriptorCloud]:
    return {
        name: encode_pyramid(
            model, build_pyramid_on_host(case[f"points_{name}"], ~case[f"padding_{name}"], model.config.pyramid)
        )
        for name in "ab"
    }


@pytest.mark.parametrize("name", ["a", "b"])
def test_descriptors_are_the_published_ones(case, encoded, name: str) -> None:
    cloud = encoded[name]
    np.testing.assert_array_equal(cloud.mask, ~case[f"descriptor_padding_{name}"])
    assert_close(cloud.positions, case[f"descriptor_xyz_{name}"])
    assert_close(cloud.features, case[f"descriptor_features_{name}"])


def test_correlated_features_are_the_published_ones(case, model) -> None:
    for cloud, name in zip(correlate(model, *(published_cloud(case, name) for name in "ab")), "ab", strict=True):
        assert_close(cloud.features, case[f"correlated_features_{name}"])


def test_similarity_is_the_published_one_from_the_scans_on(case, model, encoded) -> None:
    correlated = correlate(model, encoded["a"], encoded["b"])
    a, b = (np.asarray(similarity_features(model, cloud), np.float64) for cloud in correlated)
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    assert_close(a @ b.T, case["similarity"])


def test_overlap_probability_is_the_published_one(case, model, encoded) -> None:
    probability = overlap(model, encoded["a"], encoded["b"])
    assert_close(probability[None], case["overlap_probability"])


def test_registration_is_the_published_one_from_the_scans_on(case, model, encoded) -> None:
    match = register(model, encoded["a"], encoded["b"])
    assert_close(match.T_target_source[:3, :3], case["registration_rotation"])
    assert_close(match.T_target_source[:3, 3], case["registration_translation"].reshape(3))
    assert_close(match.rmse[None], case["registration_rmse"].reshape(-1)[:1])
    published = case["registration_confidence"]
    assert int(match.num_inliers) == len(published)
    assert_close(match.confidence[None], published[:30].mean(keepdims=True))
