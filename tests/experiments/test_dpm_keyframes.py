"""Errors of scans against merged keyframes."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import dpmjax
from experiments import dpm_keyframes
from tests.deeppointmap import toy


def test_keyframes_keep_their_distance() -> None:
    positions = np.array([[0.0, 0, 0], [0.4, 0, 0], [1.0, 0, 0], [0.5, 0, 0], [2.2, 0, 0]])
    found = dpm_keyframes.choose_keyframes(positions, [1.0] * 5)
    np.testing.assert_array_equal(found, [True, False, True, False, True])


def test_the_spacing_follows_the_extent_of_the_scan() -> None:
    model = dpmjax.init_model(jax.random.key(0), toy.MODEL)
    points = np.random.default_rng(0).normal(size=(4000, 3))
    points *= 10 / np.linalg.norm(points, axis=1, keepdims=True)
    assert abs(dpm_keyframes.keyframe_spacing_m(points, model) - 3.0) < 0.1
    assert dpm_keyframes.keyframe_spacing_m(0.12 * points, model) == 0.5
    assert dpm_keyframes.keyframe_spacing_m(5 * points, model) == 5.0


@pytest.mark.slow
def test_a_union_holds_the_descriptors_that_thinning_leaves() -> None:
    model, drive = dpmjax.init_model(jax.random.key(0), toy.MODEL), toy.drive(num_scans=3)
    clouds = jax.device_get(dpmjax.deeppointmap.encode_scans(model, [drive.read_scan(i) for i in range(3)]).described)
    poses = np.asarray(drive.T_world_lidar)
    num = clouds.mask.shape[1]
    one, two = (dpm_keyframes.merged(clouds, np.array(rows), poses, 4) for rows in ([2], [2, 1]))
    np.testing.assert_array_equal(one.positions[one.mask], clouds.positions[2][clouds.mask[2]])
    assert len(one.mask) < 2 * one.mask.sum()
    assert 0 < two.mask.sum() - one.mask.sum() <= num
    row = dpm_keyframes.evaluate(model, drive, (1, 2))
    assert row["num_scans"] == 2
    assert 0 <= row["keyframes_2"]["num_over_2_m"] <= row["keyframes_2"]["num_wrong"] <= 2
    lines = dpm_keyframes.table([{"sequence": drive.name, **row}], (1, 2)).splitlines()
    assert len({line.count("|") for line in lines}) == 1
