from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpmjax import k_nearest, radius_search
from dpmjax.geometry import neighbours
from tests.tolerances import GRADIENT, ROUNDING

DIMS = pytest.mark.parametrize("dim", [2, 3])
KS = pytest.mark.parametrize("k", [1, 5])


def clouds(seed: int, dim: int, num_queries: int = 30, num_points: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(num_queries, dim)).astype(np.float32),
        rng.normal(size=(num_points, dim)).astype(np.float32),
    )


@DIMS
@KS
def test_neighbours_are_those_of_a_tree(dim: int, k: int) -> None:
    queries, points = clouds(0, dim)
    distances, indices = cKDTree(points.astype(np.float64)).query(queries.astype(np.float64), k=[*range(1, k + 1)])
    near = jax.device_get(k_nearest(queries, points, k))
    np.testing.assert_array_equal(near.indices, indices)
    np.testing.assert_allclose(near.squared_distances, distances**2, **ROUNDING)
    assert near.mask.all()
    assert near.indices.dtype == jnp.int32


@DIMS
@KS
def test_masked_points_are_never_found(dim: int, k: int) -> None:
    queries, points = clouds(1, dim)
    mask = np.random.default_rng(2).random(len(points)) < 0.5
    hidden = np.where(mask[:, None], points, np.nan).astype(np.float32)
    near, expected = jax.device_get((k_nearest(queries, hidden, k, mask), k_nearest(queries, points[mask], k)))
    np.testing.assert_array_equal(near.indices, np.flatnonzero(mask)[expected.indices])
    np.testing.assert_array_equal(near.squared_distances, expected.squared_distances)


@KS
def test_equally_near_points_come_in_order(k: int) -> None:
    points = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0], [0, 1]], np.float32)
    np.testing.assert_array_equal(k_nearest(np.zeros((1, 2), np.float32), points, k).indices[0], range(k))


@pytest.mark.parametrize("num_valid", [0, 1, 3])
@pytest.mark.parametrize("k", [1, 4, 9])
def test_missing_neighbours_are_masked(num_valid: int, k: int) -> None:
    queries, points = clouds(3, 3, num_points=6)
    near = jax.device_get(k_nearest(queries, points, k, np.arange(6) < num_valid))
    assert near.indices.shape == near.mask.shape == near.squared_distances.shape == (len(queries), k)
    np.testing.assert_array_equal(near.mask.sum(axis=1), min(k, num_valid))
    assert (near.indices[~near.mask] == 0).all()
    assert np.isinf(near.squared_distances[~near.mask]).all()


@KS
def test_empty_clouds_have_no_neighbours(k: int) -> None:
    assert not np.any(k_nearest(jnp.ones((4, 2)), jnp.zeros((0, 2)), k).mask)
    assert k_nearest(jnp.zeros((0, 2)), jnp.ones((4, 2)), k).indices.shape == (0, k)


@KS
def test_query_that_is_not_finite_has_no_neighbour(k: int) -> None:
    queries, points = clouds(4, 2)
    queries[3] = np.nan
    mask = np.asarray(k_nearest(queries, points, k).mask)
    assert not mask[3].any()
    assert mask[np.arange(len(queries)) != 3].all()


@DIMS
def test_small_distances_far_from_the_origin_survive(dim: int) -> None:
    points = np.float32(1000) + np.arange(8, dtype=np.float32)[:, None] / 16 * np.ones(dim, np.float32)
    near = jax.device_get(k_nearest(points, points, 2))
    np.testing.assert_array_equal(near.squared_distances[:, 0], 0)
    np.testing.assert_allclose(near.squared_distances[:, 1], dim / 256, **ROUNDING)


@DIMS
@KS
def test_chunks_change_nothing(dim: int, k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points = clouds(5, dim, num_queries=37)
    whole = neighbours._search_top_k(*map(jnp.asarray, (queries, points, np.ones(len(points), bool))), k=k)
    monkeypatch.setattr(neighbours, "MAX_LIVE_DISTANCES", 5 * len(points))
    parts = neighbours._search_top_k(*map(jnp.asarray, (queries, points, np.ones(len(points), bool))), k=k)
    jax.tree.map(np.testing.assert_array_equal, parts, whole)


def test_search_holds_a_bounded_number_of_distances() -> None:
    cloud = jax.ShapeDtypeStruct((60_000, 3), jnp.float32)
    for k in (1, 8):
        program = jax.jit(lambda a, b, k=k: k_nearest(a, b, k)).lower(cloud, cloud).compile()
        # 60,000^2 distances would be 14 GB.
        assert program.memory_analysis().temp_size_in_bytes < 300e6


@KS
def test_gradient_of_distances_is_that_of_the_pairs(k: int) -> None:
    queries, points = (jnp.asarray(cloud) for cloud in clouds(6, 3))
    indices = np.asarray(k_nearest(queries, points, k).indices)
    gradient = jax.jit(jax.grad(lambda q: k_nearest(q, points, k).squared_distances.sum()))(queries)
    expected = 2 * (np.asarray(queries)[:, None] - np.asarray(points)[indices]).sum(axis=1)
    np.testing.assert_allclose(gradient, expected, **GRADIENT)


@KS
@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_radius_search_finds_those_within(k: int, radius: float) -> None:
    queries, points = clouds(7, 2)
    near = jax.device_get(radius_search(queries, points, radius, k))
    counts = [len(found) for found in cKDTree(points).query_ball_point(queries, radius)]
    np.testing.assert_array_equal(near.mask.sum(axis=1), np.minimum(counts, k))
    assert (near.squared_distances[near.mask] <= radius**2).all()
    assert np.isinf(near.squared_distances[~near.mask]).all()


def test_gradient_is_finite_where_neighbours_are_missing() -> None:
    queries, points = (jnp.asarray(cloud) for cloud in clouds(8, 2))

    def loss(queries: jax.Array, points: jax.Array) -> jax.Array:
        near = radius_search(queries, points, 0.2, 4)
        return jnp.sum(jnp.where(near.mask, near.squared_distances, 0))

    assert all(np.isfinite(gradient).all() for gradient in jax.jit(jax.grad(loss, (0, 1)))(queries, points))


def test_vmap_equals_a_loop() -> None:
    pairs = [clouds(seed, 2) for seed in range(3)]
    batch = tuple(jnp.stack(arrays) for arrays in zip(*pairs, strict=True))
    for k in (1, 3):
        batched = jax.vmap(lambda q, p, k=k: k_nearest(q, p, k))(*batch)
        for i, pair in enumerate(pairs):
            np.testing.assert_array_equal(batched.indices[i], k_nearest(*pair, k).indices)


@KS
def test_second_call_compiles_nothing(k: int, assert_compiles_nothing) -> None:
    k_nearest(*clouds(0, 3), k)
    radius_search(*clouds(0, 3), 0.5, k)
    with assert_compiles_nothing():
        k_nearest(*clouds(1, 3), k)
        radius_search(*clouds(1, 3), 0.7, k)


def test_wrong_arguments_are_named(as_user) -> None:
    with pytest.raises(ValueError, match="^queries: expected shape"):
        k_nearest(jnp.ones(3), jnp.ones((4, 3)), 1)
    with pytest.raises(ValueError, match="^points: expected 3 columns"):
        k_nearest(jnp.ones((3, 3)), jnp.ones((4, 2)), 1)
    with pytest.raises(ValueError, match="^mask: expected bool of shape"):
        k_nearest(jnp.ones((3, 3)), jnp.ones((4, 3)), 1, jnp.ones(3, bool))
    with pytest.raises(ValueError, match="^mask: expected bool"):
        k_nearest(jnp.ones((3, 3)), jnp.ones((4, 3)), 1, jnp.ones(4))
    with pytest.raises(ValueError, match="^k: expected at least 1"):
        k_nearest(jnp.ones((3, 3)), jnp.ones((4, 3)), 0)
    with pytest.raises(ValueError, match="^radius: expected a number above 0"):
        radius_search(jnp.ones((3, 3)), jnp.ones((4, 3)), 0.0, 1)


def test_arrays_of_another_byte_order_are_the_same_numbers() -> None:
    queries, points = clouds(0, 3)
    swapped = (array.astype(array.dtype.newbyteorder()) for array in (queries, points))
    np.testing.assert_array_equal(k_nearest(*swapped, 3).indices, k_nearest(queries, points, 3).indices)


@pytest.mark.parametrize("dtype", [object, str, bool, complex])
def test_arrays_without_real_numbers_are_named(as_user, dtype: type) -> None:
    with pytest.raises(ValueError, match="^queries: expected real numbers, got dtype"):
        k_nearest(np.ones((3, 2)).astype(dtype), np.ones((3, 2)), 1)
