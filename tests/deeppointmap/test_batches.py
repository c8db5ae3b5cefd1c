from __future__ import annotations

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import prepare_scan
from dpmjax.deeppointmap.encoding import CHUNK
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.MODEL)


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    drive = toy.drive()
    return [drive.read_scan(index) for index in range(CHUNK + 1)]


@pytest.mark.slow
def test_many_scans_are_encoded_as_each_alone(model, scans) -> None:
    together = dpmjax.encode_scans(model, scans)
    assert together.mask.shape == (len(scans), model.config.num_descriptors)
    for number in (0, CHUNK):
        alone = dpmjax.encode(model, scans[number])
        np.testing.assert_allclose(together.features[number], alone.features, **ACCUMULATED)
        np.testing.assert_array_equal(together.positions[number], alone.positions)


@pytest.mark.slow
def test_many_pairs_are_registered_as_each_alone(model, scans) -> None:
    sources, targets = [scans[0], prepare_scan(model, scans[1])], [scans[2], scans[0]]
    together = dpmjax.register_pairs(model, sources, targets, refine=True)
    for number, (source, target) in enumerate(zip(sources, targets, strict=True)):
        alone = dpmjax.register(model, source, target, refine=True)
        np.testing.assert_allclose(together.T_target_source[number], alone.T_target_source, **ACCUMULATED)
        assert together.verification is not None
        assert alone.verification is not None
        assert float(together.verification.score[number]) == pytest.approx(alone.verification.score)


def test_overlap_of_many_pairs_is_that_of_each_alone(model, scans) -> None:
    sources, targets = [scans[0], dpmjax.encode(model, scans[1])], [scans[2], prepare_scan(model, scans[0])]
    together = dpmjax.overlap_pairs(model, sources, targets)
    for number, pair in enumerate(zip(sources, targets, strict=True)):
        np.testing.assert_allclose(together[number], dpmjax.overlap(model, *pair), **ACCUMULATED)


def test_other_numbers_of_scans_compile_nothing(model, scans, assert_compiles_nothing) -> None:
    dpmjax.encode_scans(model, scans[:2])
    with assert_compiles_nothing():
        dpmjax.encode_scans(model, scans[:2])
        dpmjax.encode_scans(model, [scans[3], scans[1][:200]])


def test_lists_that_do_not_match_are_refused(model, scans) -> None:
    with pytest.raises(ValueError, match="scans: expected at least one"):
        dpmjax.encode_scans(model, [])
    with pytest.raises(ValueError, match="targets: expected 2"):
        dpmjax.register_pairs(model, scans[:2], scans[:1])
    with pytest.raises(ValueError, match="sources: expected at least one"):
        dpmjax.overlap_pairs(model, [], [])
