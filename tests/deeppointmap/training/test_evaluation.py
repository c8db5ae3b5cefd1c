"""Evaluation of registrations: each row has the descriptors of its scan."""

from __future__ import annotations

import functools

import jax
import numpy as np

from dpmjax.deeppointmap import draw_evaluation_pairs, evaluate_registration, init_model
from dpmjax.deeppointmap.training.step import encode_sample
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


def test_each_scan_of_an_evaluation_is_encoded_in_its_row() -> None:
    model = init_model(jax.random.key(0), toy.MODEL)
    pairs = draw_evaluation_pairs(toy.drive(num_scans=4), 2, toy.MODEL)
    clouds = evaluate_registration(model, pairs).clouds
    expected = jax.vmap(functools.partial(encode_sample, model))(pairs.scans)
    np.testing.assert_array_equal(clouds.mask, expected.mask)
    np.testing.assert_allclose(clouds.positions, expected.positions, atol=1e-4)
    np.testing.assert_allclose(clouds.features, expected.features, **ACCUMULATED)
