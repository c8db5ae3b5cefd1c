import dataclasses
import json

import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap.confidence import CLOUD_FEATURES, LogisticModel, fit_weights, logistic_probability
from tests.deeppointmap import toy


def test_separable_examples_have_a_finite_fit() -> None:
    features = np.repeat(np.array([[0.0], [1.0]]), 20, axis=0) * np.ones(4)
    model = LogisticModel(CLOUD_FEATURES, *fit_weights(features, features[:, 0] > 0.5))
    assert np.isfinite(model.weights).all()
    assert logistic_probability(model, features[-1]) > 0.9 > 0.1 > logistic_probability(model, features[0])


def test_examples_of_one_kind_are_refused() -> None:
    with pytest.raises(ValueError, match="is_right: expected right and wrong"):
        fit_weights(np.ones((3, 4)), np.ones(3, bool))


def test_fit_finds_the_probabilities_whose_shares_the_examples_have() -> None:
    """The features have other means and units than the numbers that decide."""
    rng = np.random.default_rng(0)
    numbers, shares = rng.normal(size=(20_000, 4)), rng.uniform(0.5, 1.0, 20_000)
    probability = 1 / (1 + np.exp(-(numbers @ np.array([2.0, 0.0, -1.0, 0.5]) + 1.0)))
    features = numbers * [1, 10, 0.1, 1] + [0, 5, 2, 0]
    is_right = rng.uniform(size=len(shares)) < shares * probability
    found = logistic_probability(LogisticModel(CLOUD_FEATURES, *fit_weights(features, is_right, shares)), features)
    np.testing.assert_allclose(found, probability, atol=0.05)
    assert (shares * found).mean() == pytest.approx(is_right.mean(), abs=0.005)


def test_features_of_another_version_are_refused() -> None:
    with pytest.raises(ValueError, match="features"):
        LogisticModel(("speed",), (1.0,), 0.0)
    with pytest.raises(ValueError, match="weights: expected 4"):
        LogisticModel(CLOUD_FEATURES, (1.0,), 0.0)


@pytest.fixture(scope="module")
def calibrated(model) -> dpmjax.Model:
    return model.replace(config=dataclasses.replace(model.config, calibration=toy.calibration(-1.0, 2.0)))


def test_calibration_decides_the_confidence(calibrated) -> None:
    scans = [toy.drive().read_scan(index) for index in range(2)]
    clouds = [dpmjax.encode(calibrated, scan) for scan in scans]
    of_clouds, of_scans = dpmjax.register(calibrated, *clouds), dpmjax.register(calibrated, *scans)
    assert float(of_clouds.confidence) == pytest.approx(1 / (1 + np.exp(1.0)))
    assert float(of_scans.confidence) == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert of_clouds.verification is None
    assert of_scans.verification is not None
    assert 0 < float(of_clouds.mean_score) < 1


def test_an_empty_scan_has_no_confidence(calibrated) -> None:
    match = dpmjax.register(calibrated, np.zeros((0, 3), np.float32), toy.drive().read_scan(0))
    assert match.confidence == 0
    np.testing.assert_array_equal(match.T_target_source, np.eye(4))


def test_calibration_is_stored_with_the_model(calibrated, tmp_path) -> None:
    dpmjax.save_model(calibrated, tmp_path / "model.safetensors")
    assert dpmjax.load_model(tmp_path / "model.safetensors").config == calibrated.config
    assert json.dumps(dataclasses.asdict(calibrated.config))
