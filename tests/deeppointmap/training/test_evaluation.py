"""Evaluation of registrations: each row has the descriptors of its scan."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import (
    ObjectiveConfig,
    PairKind,
    draw_evaluation_pairs,
    evaluate_registration,
    init_model,
    measure_offsets,
    offset_quality,
)
from dpmjax.deeppointmap.training import evaluation as evaluation_module
from dpmjax.deeppointmap.training.step import encode_sample
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


@pytest.mark.slow
def test_each_scan_of_an_evaluation_is_encoded_in_its_row() -> None:
    model = init_model(jax.random.key(0), toy.MODEL)
    pairs = draw_evaluation_pairs(toy.drive(num_scans=4), 2, toy.MODEL)
    clouds = evaluate_registration(model, pairs).clouds
    expected = jax.vmap(functools.partial(encode_sample, model))(pairs.scans)
    np.testing.assert_array_equal(clouds.mask, expected.mask)
    np.testing.assert_allclose(clouds.positions, expected.positions, atol=1e-4)
    np.testing.assert_allclose(clouds.features, expected.features, **ACCUMULATED)


@pytest.mark.slow
def test_an_evaluation_of_other_numbers_of_scans_and_pairs_compiles_nothing(assert_compiles_nothing) -> None:
    model = init_model(jax.random.key(0), toy.MODEL)
    kinds = (PairKind(2.0, 10.0), PairKind(2.0, 10.0, num_scans=3))
    few, many = (
        draw_evaluation_pairs(toy.drive(num_scans=num_scans), num_pairs, toy.MODEL, kinds=kinds)
        for num_scans, num_pairs in ((6, 3), (24, 13))
    )
    evaluate_registration(model, few)
    with assert_compiles_nothing():
        found = evaluate_registration(model, many)
    assert [len(recall.translation_errors_m) for recall in found.recalls] == [13, 13]
    assert found.clouds.positions.shape[0] == 24


@pytest.mark.slow
@pytest.mark.slow
def test_offsets_of_an_evaluation_are_those_of_its_pairs(monkeypatch) -> None:
    wide = ObjectiveConfig(offset_radius_m=10.0)  # the points of the toy lie far apart
    monkeypatch.setattr(evaluation_module, "TRAINED", wide)
    model = init_model(jax.random.key(0), toy.SLAM_MODEL)
    pairs = draw_evaluation_pairs(toy.drive(num_scans=6), 4, toy.SLAM_MODEL)
    evaluation, some = evaluate_registration(model, pairs), pairs.pairs[0]
    sources, targets = (
        [jax.tree.map(lambda leaf, row=row: leaf[row], evaluation.clouds) for row in rows[:, 0]]
        for rows in (some.sources, some.targets)
    )
    motions = pairs.true_motions(some).astype(np.float32)
    expected = offset_quality(model, zip(sources, targets, motions, strict=True), config=wide)
    found = measure_offsets(evaluation.offsets)
    assert found.num_pairs == expected.num_pairs > 0
    np.testing.assert_allclose(found.r2, expected.r2, **ACCUMULATED)


def test_a_map_holds_its_first_scan_once() -> None:
    kind = PairKind(2.0, 10.0, num_scans=4)
    some = draw_evaluation_pairs(toy.drive(num_scans=12, step_m=3.0), 20, toy.MODEL, kinds=(kind,)).pairs[0]
    for rows in (*some.sources, *some.targets):
        assert np.count_nonzero(rows == rows[0]) == 1
        assert len(set(rows.tolist())) == 4


def test_a_scan_without_neighbours_is_repeated() -> None:
    kind = PairKind(10.0, 14.0, num_scans=3)
    some = draw_evaluation_pairs(toy.drive(num_scans=4, step_m=12.0), 2, toy.MODEL, kinds=(kind,)).pairs[0]
    np.testing.assert_array_equal(some.sources, some.sources[:, :1].repeat(3, axis=1))
