import numpy as np
import pytest

import dpmjax
from dpmjax.deeppointmap import prepare_scan
from dpmjax.deeppointmap.encoding import CHUNK
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


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
