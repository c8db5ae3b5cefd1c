import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpmjax import k_nearest, radius_search
from dpmjax.geometry import neighbours
from tests.tolerances import ROUNDING

DIMS = pytest.mark.parametrize("dim", [2, 3])
KS = pytest.mark.parametrize("k", [1, 5])


def clouds(seed: int, dim: int, num_queries: int = 30, num_points: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    queries, points = (rng.normal(size=(num, dim)).astype(np.float32) for num in (num_queries, num_points))
    return queries, points


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


@KS
def test_chunks_change_nothing(k: int, monkeypatch: pytest.MonkeyPatch) -> None:
    queries, points = clouds(5, 3, num_queries=37)
    arrays = (*map(jnp.asarray, (queries, points)), jnp.ones(len(points), bool))
    whole = neighbours._search_top_k(*arrays, k=k)
    monkeypatch.setattr(neighbours, "MAX_LIVE_DISTANCES", 5 * len(points))
    jax.tree.map(np.testing.assert_array_equal, neighbours._search_top_k(*arrays, k=k), whole)


def test_search_holds_a_bounded_number_of_distances() -> None:
    cloud = jax.ShapeDtypeStruct((60_000, 3), jnp.float32)
    for k in (1, 8):
        program = jax.jit(lambda a, b, k=k: k_nearest(a, b, k)).lower(cloud, cloud).compile()
        # 60,000^2 distances would be 14 GB.
        assert program.memory_analysis().temp_size_in_bytes < 300e6


@KS
@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_radius_search_finds_those_within(k: int, radius: float) -> None:
    queries, points = clouds(7, 2)
    near = jax.device_get(radius_search(queries, points, radius, k))
    counts = [len(found) for found in cKDTree(points).query_ball_point(queries, radius)]
    np.testing.assert_array_equal(near.mask.sum(axis=1), np.minimum(counts, k))
    assert (near.squared_distances[near.mask] <= radius**2).all()
    assert np.isinf(near.squared_distances[~near.mask]).all()


ONES = np.ones((4, 3), np.float32)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: k_nearest(ONES[0], ONES, 1), "queries: expected shape"),
        (lambda: k_nearest(ONES.astype(object), ONES, 1), "queries: expected real numbers, got dtype"),
        (lambda: k_nearest(ONES.astype(complex), ONES, 1), "queries: expected real numbers, got dtype"),
        (lambda: k_nearest(ONES, ONES[:, :2], 1), "points: expected 3 columns"),
        (lambda: k_nearest(ONES, ONES, 1, jnp.ones(3, bool)), "mask: expected bool of shape"),
        (lambda: k_nearest(ONES, ONES, 1, jnp.ones(4)), "mask: expected bool"),
        (lambda: k_nearest(ONES, ONES, 0), "k: expected at least 1"),
        (lambda: radius_search(ONES, ONES, 0.0, 1), "radius: expected a number above 0"),
    ],
)
def test_wrong_arguments_are_named(call, message: str, as_user) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_arrays_of_another_byte_order_are_the_same_numbers() -> None:
    queries, points = clouds(0, 3)
    swapped = (array.astype(array.dtype.newbyteorder()) for array in (queries, points))
    np.testing.assert_array_equal(k_nearest(*swapped, 3).indices, k_nearest(queries, points, 3).indices)
