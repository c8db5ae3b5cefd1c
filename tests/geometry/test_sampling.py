import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import farthest_point_sample, sample_free_space, voxel_sample
from dpmjax.geometry.sampling import typical_range
from tests.tolerances import ROUNDING

DIMS = pytest.mark.parametrize("dim", [2, 3])
SEEDS = pytest.mark.parametrize("seed", [0, 1])


def cloud(seed: int, dim: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, dim)).astype(np.float32)


def farthest_in_numpy(points: np.ndarray, num_samples: int, mask: np.ndarray) -> list[int]:
    points, chosen = points.astype(np.float64), [int(np.argmax(mask))]
    while len(chosen) < num_samples:
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
        distance[~mask] = distance[chosen] = -1
        chosen.append(int(np.argmax(distance)) if distance.max() >= 0 else chosen[0])
    return chosen


@DIMS
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_samples_are_those_of_numpy(dim: int, share: float) -> None:
    points, mask = cloud(2, dim), np.random.default_rng(3).random(60) < share
    index = farthest_point_sample(points, 15, mask)
    assert index.dtype == jnp.int32
    np.testing.assert_array_equal(index, farthest_in_numpy(points, 15, mask))


def test_too_few_points_repeat_the_first() -> None:
    mask = np.zeros(10, bool)
    mask[[3, 7]] = True
    np.testing.assert_array_equal(farthest_point_sample(cloud(5, 3, 10), 5, mask), [3, 7, 3, 3, 3])
    np.testing.assert_array_equal(farthest_point_sample(cloud(5, 3, 10), 3, np.zeros(10, bool)), [0, 0, 0])


def test_coincident_points_are_chosen_once_each() -> None:
    np.testing.assert_array_equal(np.sort(farthest_point_sample(np.ones((6, 3), np.float32), 6)), np.arange(6))


def first_of_each_voxel(points: np.ndarray, voxel_size: float, mask: np.ndarray) -> np.ndarray:
    voxels = np.floor(points / np.float32(voxel_size)).astype(np.int64)
    rows = np.flatnonzero(mask)
    _, first = np.unique(voxels[rows], axis=0, return_index=True)
    kept = np.zeros(len(points), bool)
    kept[rows[first]] = True
    return kept


@DIMS
@SEEDS
@pytest.mark.parametrize("voxel_size", [0.1, 0.5, 100.0])
def test_kept_points_are_the_first_of_their_voxels(dim: int, seed: int, voxel_size: float) -> None:
    points = cloud(seed, dim, 200)
    mask = np.random.default_rng(seed).random(200) < 0.8
    kept = voxel_sample(points, voxel_size, mask)
    np.testing.assert_array_equal(kept, first_of_each_voxel(points, voxel_size, mask))


def test_voxels_are_told_apart_over_a_million_on_each_axis() -> None:
    # Neighbouring voxels near the corners of a grid of 2^20 voxels an axis: a hash would confuse some.
    rng = np.random.default_rng(7)
    corner = rng.choice([-(2**19), 2**19 - 3], size=(300, 3))
    points = (corner + rng.integers(0, 3, size=(300, 3)) + 0.5).astype(np.float32)
    np.testing.assert_array_equal(voxel_sample(points, 1.0), first_of_each_voxel(points, 1.0, np.ones(300, bool)))


def test_nothing_is_kept_of_an_empty_mask() -> None:
    assert not voxel_sample(cloud(8, 3), 0.5, np.zeros(60, bool)).any()
    assert voxel_sample(jnp.zeros((0, 3)), 0.5).shape == (0,)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("is_shared", [True, False])
def test_samples_lie_on_their_segments(dim: int, is_shared: bool) -> None:
    rng = np.random.default_rng(0)
    origin, points = rng.normal(size=dim).astype(np.float32), rng.normal(size=(7, dim)).astype(np.float32)
    factors = rng.uniform(size=4 if is_shared else (7, 4)).astype(np.float32)
    samples = np.asarray(sample_free_space(origin, points, factors))
    for beam, i in np.ndindex(7, 4):
        factor = factors[i] if is_shared else factors[beam, i]
        np.testing.assert_allclose(samples[beam, i], (1 - factor) * origin + factor * points[beam], **ROUNDING)


def test_typical_range_is_what_nine_beams_in_ten_stay_below() -> None:
    # Beam k of scan s ends at range s * k, k from 0 to 100. Masked beams and empty scans do not count.
    ranges = np.arange(101.0) * np.array([[1], [2], [7], [0]])
    points = ranges[..., None] * np.array([0.6, 0.8])
    mask = np.broadcast_to(np.array([[True]] * 3 + [[False]]), ranges.shape)
    assert typical_range(points, mask) == pytest.approx(180.0)
    hidden = np.where(np.arange(101) > 50, np.nan, 1.0)[:, None] * points
    assert typical_range(hidden, mask & (np.arange(101) <= 50)) == pytest.approx(90.0)
