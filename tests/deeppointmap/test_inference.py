"""The public functions of inference: encode, register, overlap."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import prepare_scan
from dpmjax.deeppointmap.confidence import CLOUD_FEATURES, SCAN_FEATURES, Calibration, LogisticModel
from dpmjax.deeppointmap.encoding import pyramid_of_scan
from dpmjax.deeppointmap.registration import register_each
from dpmjax.geometry import PyramidConfig, PyramidStage
from dpmjax.geometry.normals import pyramid_elements
from dpmjax.scan import VerificationConfig, ViewCorrelationConfig
from dpmjax.types import PointCloud
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED, ROUNDING


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    drive = toy.drive()
    return [drive.read_scan(index) for index in range(2)]


def test_scans_and_their_descriptors_register_alike_where_the_scans_suggest_nothing(model, scans) -> None:
    verification = VerificationConfig(views=ViewCorrelationConfig(num_motions=0))
    model = model.replace(config=replace(model.config, verification=verification))
    of_scans = dpmjax.register(model, *scans)
    of_clouds = dpmjax.register(model, *(dpmjax.encode(model, scan) for scan in scans))
    np.testing.assert_allclose(of_scans.T_target_source, of_clouds.T_target_source, **ACCUMULATED)
    assert 0 <= of_scans.confidence <= 1
    assert 0 < dpmjax.overlap(model, scans[0], dpmjax.encode(model, scans[1])) < 1


def test_a_motion_that_only_the_scans_suggest_has_no_inliers(model, scans) -> None:
    match = dpmjax.register(model, *scans)
    np.testing.assert_allclose(match.T_target_source[:3, 3], [-4, 0, 0], atol=0.7)
    assert match.num_inliers == match.is_inlier.sum() == match.support == match.confidence == 0
    assert np.isinf(match.rmse)


def test_points_that_are_not_there_change_nothing(model, scans) -> None:
    padded = np.concatenate([scans[0], np.full((7, 3), np.nan, np.float32)])
    mask = np.arange(len(padded)) < len(scans[0])
    expected = dpmjax.encode(model, scans[0])
    for cloud in (dpmjax.encode(model, padded), dpmjax.encode(model, PointCloud(padded, mask))):
        np.testing.assert_array_equal(cloud.features, expected.features)


@pytest.mark.parametrize("num", [1, 3, 4, 19])
def test_a_handful_of_points_has_no_motion(model, scans, num: int) -> None:
    few = np.random.default_rng(num).uniform(-9, 9, (num, 3)).astype(np.float32)
    for source, target in ((few, few), (few, scans[0]), (scans[0], np.tile(few[:1], (500, 1)))):
        match = dpmjax.register(model, source, target)
        assert match.confidence == 0
        np.testing.assert_array_equal(match.T_target_source, np.eye(4))


def test_a_model_and_a_cloud_print_one_line(model, scans) -> None:
    for value in (model, dpmjax.encode(model, scans[0])):
        assert len(repr(value)) < 120
        assert "\n" not in repr(value)


def test_an_empty_scan_is_a_failure_as_data(model, scans) -> None:
    empty = np.zeros((0, 3), np.float32)
    assert not dpmjax.encode(model, empty).mask.any()
    match = dpmjax.register(model, empty, scans[0])
    np.testing.assert_array_equal(match.T_target_source, np.eye(4))
    assert match.confidence == 0
    assert np.isinf(match.rmse)
    assert dpmjax.overlap(model, empty, scans[0]) == dpmjax.overlap(model, scans[0], empty) == 0


def test_second_call_compiles_nothing(model, scans, assert_compiles_nothing) -> None:
    dpmjax.register(model, *scans)
    with assert_compiles_nothing():
        dpmjax.register(model, scans[1], scans[0][:200])


def test_prepared_scans_register_as_raw_ones(model, scans) -> None:
    expected = dpmjax.register(model, *scans, refine=True)
    prepared = [prepare_scan(model, scan) for scan in scans]
    found = dpmjax.register(model, *prepared, refine=True)
    np.testing.assert_array_equal(found.T_target_source, expected.T_target_source)
    assert found.verification == expected.verification
    assert dpmjax.overlap(model, *prepared) == dpmjax.overlap(model, *scans)


def test_a_cloud_without_elements_is_not_refined(model, scans) -> None:
    bare = dpmjax.encode(model, scans[1]).described
    for source in (scans[0], prepare_scan(model, scans[0])):
        refined, coarse = (dpmjax.register(model, source, bare, refine=refine) for refine in (True, False))
        jax.tree.map(np.testing.assert_array_equal, refined, coarse)


@pytest.mark.slow
def test_further_elements_follow_the_descriptors_and_change_no_match(scans) -> None:
    stages = (PyramidStage(64, (0.2,), 8), *toy.MODEL.pyramid.stages)
    config = replace(toy.MODEL, pyramid=PyramidConfig(stages, num_interpolations=1))
    model = dpmjax.init_model(jax.random.key(0), config)
    clouds = [dpmjax.encode(model, scan) for scan in scans]
    larger = [dpmjax.encode(model, scan, num_elements=64) for scan in scans]
    assert larger[0].features.shape == clouds[0].features.shape == (32, 8)
    assert larger[0].positions.shape == larger[0].normals.shape == (64, 3)
    assert larger[0].planarity.shape == larger[0].mask.shape == (64,)
    np.testing.assert_array_equal(larger[0].positions[:32], clouds[0].positions)
    alone = pyramid_elements(pyramid_of_scan(scans[0], config), 64)
    alone = replace(alone, positions=alone.positions * config.scale_m)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **ROUNDING), alone, larger[0].elements)
    expected, found = (dpmjax.register(model, *pair, refine=False) for pair in (clouds, larger))
    jax.tree.map(np.testing.assert_array_equal, expected, found)
    bare = [cloud.described for cloud in clouds]
    jax.tree.map(np.testing.assert_array_equal, expected, dpmjax.register(model, *bare))
    assert dpmjax.overlap(model, *larger) == dpmjax.overlap(model, *bare)


def test_a_batch_with_an_empty_scan_equals_single_calls(model, scans) -> None:
    pairs = [(scans[0], scans[1]), (scans[0][:4], scans[1]), (scans[1], scans[0][:0])]
    together = dpmjax.register_pairs(model, *zip(*pairs, strict=True))
    for row, pair in enumerate(pairs):
        one = dpmjax.register(model, *pair)
        np.testing.assert_array_equal(together.T_target_source[row], one.T_target_source)
        assert together.confidence[row] == one.confidence
        assert together.weak_sigma_m[row] == one.weak_sigma_m
    np.testing.assert_array_equal(np.asarray(together.confidence)[1:], 0)


@pytest.mark.parametrize("bias", [-1.0, 9.0])
def test_exchanged_scans_have_the_inverse_motion_as_probable(model, scans, bias: float) -> None:
    # The motion of the more probable way is taken, or that of the first one, if it is sure.
    of_scans = LogisticModel(SCAN_FEATURES, (0.3, *(0.0,) * 8), bias)
    calibration = Calibration(LogisticModel(CLOUD_FEATURES, (0.1, 0.0, 0.0, 0.0), bias), of_scans)
    calibrated = replace(model, config=replace(model.config, calibration=calibration))
    for prepare in (prepare_scan, dpmjax.encode):
        pair = tuple(prepare(model, scan) for scan in scans)
        one, other = (dpmjax.register(calibrated, *ends) for ends in (pair, pair[::-1]))
        assert one.confidence == other.confidence
        np.testing.assert_allclose(one.T_target_source @ other.T_target_source, np.eye(4), atol=1e-4)
        np.testing.assert_array_equal(one.source_indices, other.target_indices)
        ways = [float(found.confidence) for found in register_each(calibrated, [pair, pair[::-1]])]
        assert float(one.confidence) == pytest.approx(max(ways) if bias < 0 else 1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda model, a, b: dpmjax.register("dpm_small", a, b), "model: expected one from"),
        (lambda model, a, b: dpmjax.encode(model, a, num_elements=7), "num_elements: expected"),
        (lambda model, a, b: dpmjax.encode(model, a, num_elements=33), "num_elements: expected"),
        (lambda model, a, b: dpmjax.encode(model, np.zeros((5, 4))), r"points\[:, :3\]"),
        (lambda model, a, b: dpmjax.encode(model, np.zeros(3)), "shape"),
        (lambda model, a, b: dpmjax.encode(model, np.array([["a", "b", "c"]])), "real numbers"),
        (lambda model, a, b: dpmjax.encode_scans(model, []), "scans: expected at least one"),
        (lambda model, a, b: dpmjax.register_pairs(model, [a, b], [a]), "targets: expected 2"),
        (lambda model, a, b: dpmjax.register_pairs(model, [a, b], [b, dpmjax.encode(model, a)]), "expected scans in"),
        (lambda model, a, b: dpmjax.overlap_pairs(model, [], []), "sources: expected at least one"),
    ],
)
def test_wrong_input_is_refused(as_user, model, scans, call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(model, *scans)
