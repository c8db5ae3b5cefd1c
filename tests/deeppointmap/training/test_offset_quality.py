"""Accuracy of predicted offsets in the frame of the wall, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax.deeppointmap import ObjectiveConfig
from dpmjax.deeppointmap.model import correlate, predict_offsets
from dpmjax.deeppointmap.training.evaluation import WallOffsets, offset_r2, wall_offsets
from dpmjax.geometry import rigid
from dpmjax.types import DescriptorCloud
from tests.tolerances import ACCUMULATED

T_B_A = np.asarray(rigid.exp(np.array([5.0, -3.0, 0.5, 0.02, -0.05, 1.2], np.float32)))
CONFIG = ObjectiveConfig(max_close=12)


def offsets(seed: int, num: int = 40) -> WallOffsets:
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(num, 3)) * [1, 2, 0.1]
    predicted = 0.5 * true + 0.2 * rng.normal(size=(num, 3))
    mask = rng.random(num) < 0.7
    predicted[~mask], true[~mask] = np.nan, np.nan
    return WallOffsets(predicted.astype(np.float32), true.astype(np.float32), mask)


@pytest.mark.parametrize("seeds", [(0,), (1, 2, 3)])
def test_r2_is_that_of_loops_over_all_pairs(seeds: tuple[int, ...]) -> None:
    parts = [offsets(seed) for seed in seeds]
    r2 = offset_r2(parts)
    for axis in range(3):
        pairs = [
            (float(p[axis]), float(t[axis]))
            for part in parts
            for p, t, m in zip(part.predicted, part.true, part.mask, strict=True)
            if m
        ]
        mean = sum(true for _, true in pairs) / len(pairs)
        residual = sum((predicted - true) ** 2 for predicted, true in pairs)
        spread = sum((true - mean) ** 2 for _, true in pairs)
        assert r2[axis] == pytest.approx(1 - residual / spread)


def test_an_axis_without_variance_has_no_coefficient() -> None:
    true = np.random.default_rng(5).normal(size=(20, 3)) * [1, 0, 1]
    r2 = offset_r2([WallOffsets(0 * true, true, np.ones(20, bool))])
    np.testing.assert_array_equal(np.isnan(r2), [False, True, False])


@pytest.mark.parametrize("parts", [[], [offsets(6)._replace(mask=np.zeros(40, bool))]])
def test_without_pairs_nothing_is_measured(parts: list[WallOffsets]) -> None:
    assert np.isnan(offset_r2(parts)).all()


def clouds() -> tuple[DescriptorCloud, DescriptorCloud]:
    """Descriptors of a cube of 6 m seen from two places, a third of them masked, with normals of all directions."""
    rng = np.random.default_rng(7)
    both = []
    for num, T in ((40, np.eye(4, dtype=np.float32)), (50, T_B_A)):
        places = np.asarray(rigid.transform_points(T, rng.uniform(0, 6, (num, 3)).astype(np.float32)))
        normals = rng.normal(size=(num, 3)).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mask, features = rng.random(num) < 0.7, rng.normal(size=(num, 8)).astype(np.float32)
        planarity = rng.random(num).astype(np.float32)
        arrays = (places, features, mask, None, np.where(mask[:, None], normals, np.nan), planarity)
        both.append(DescriptorCloud(*(None if x is None else jnp.asarray(x) for x in arrays)))
    return both[0], both[1]


@pytest.mark.slow
def test_offsets_of_walls_are_those_of_loops_over_all_descriptors(model) -> None:
    a, b = clouds()
    found = wall_offsets(model, a, b, jnp.asarray(T_B_A), CONFIG)
    first, second = correlate(model, a, b)
    in_a = np.asarray(rigid.transform_points(np.linalg.inv(T_B_A), b.positions), np.float64)
    normals, num_pairs = np.asarray(a.normals, np.float64), 0
    for i in np.flatnonzero(a.mask):
        difference = in_a - np.asarray(a.positions[i], np.float64)
        length = np.where(b.mask, np.linalg.norm(difference, axis=1), np.inf)
        near = [j for j in np.argsort(length) if length[j] <= CONFIG.offset_radius_m][: CONFIG.max_close]
        if abs(normals[i, 2]) > 0.5 or a.planarity[i] < 0.3:
            near = []
        assert int(np.sum(found.mask[i])) == len(near)
        normal = np.array([*normals[i, :2], 0]) / np.hypot(*normals[i, :2])
        axes = np.stack([normal, np.cross([0, 0, 1], normal), [0, 0, 1]])
        for place, j in enumerate(near):
            predicted = np.asarray(predict_offsets(model, first.features[i], second.features[j]), np.float64)
            np.testing.assert_allclose(found.true[i, place], axes @ difference[j], **ACCUMULATED)
            np.testing.assert_allclose(found.predicted[i, place], axes @ predicted, **ACCUMULATED)
        num_pairs += len(near)
    assert num_pairs > 20


def test_clouds_without_normals_are_refused(as_user, model) -> None:
    a, b = clouds()
    with pytest.raises(ValueError, match="expected surface elements"):
        wall_offsets(model, a.described, b, jnp.asarray(T_B_A), CONFIG)
