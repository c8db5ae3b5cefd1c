import os
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from dpmjax import k_nearest, radius_search
from dpmjax.geometry import neighbours
from dpmjax.geometry.neighbours import HostTree
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


def test_arrays_of_another_byte_order_are_the_same_numbers() -> None:
    queries, points = clouds(0, 3)
    swapped = (array.astype(array.dtype.newbyteorder()) for array in (queries, points))
    np.testing.assert_array_equal(k_nearest(*swapped, 3).indices, k_nearest(queries, points, 3).indices)


@pytest.mark.parametrize("ordered_from", [1, 1000])
@pytest.mark.parametrize("num_threads", [1, 3])
@pytest.mark.parametrize("k", [1, 7, 40])
@pytest.mark.parametrize("case", ["random", "coinciding", "a line"])
def test_distances_are_the_smallest_of_all(case: str, k: int, num_threads: int, ordered_from: int, monkeypatch) -> None:
    monkeypatch.setattr(neighbours, "ORDERED_FROM", ordered_from)
    points = np.random.default_rng(0).normal(size=(40, 3))
    points *= {"random": 1, "coinciding": 0, "a line": np.array([1, 0, 0])}[case]
    queries = np.random.default_rng(1).normal(size=(25, 3)).astype(np.float32)
    rows, distances = HostTree(points, num_threads=num_threads).nearest(queries, k)
    exact = cdist(queries, points)
    np.testing.assert_allclose(distances, np.sort(exact, axis=1)[:, :k], atol=1e-12)
    np.testing.assert_allclose(np.take_along_axis(exact, rows, axis=1), distances, atol=1e-12)
    assert all(len(set(row)) == k for row in rows)


@pytest.mark.parametrize(("num_points", "num_queries", "k"), [(0, 4, 0), (5, 0, 3), (5, 4, 0)])
def test_without_points_queries_or_neighbours_nothing_is_found(num_points: int, num_queries: int, k: int) -> None:
    rows, distances = HostTree(np.ones((num_points, 3)), num_threads=2).nearest(np.ones((num_queries, 3)), k)
    assert rows.shape == distances.shape == (num_queries, k)


@pytest.mark.parametrize("num_points", [0, 40])
def test_a_pickled_tree_finds_the_same(num_points: int) -> None:
    points = np.random.default_rng(0).normal(size=(num_points, 3))
    tree = HostTree(points, num_threads=1)
    again = pickle.loads(pickle.dumps(tree))
    assert again.num_threads == 1
    k = min(num_points, 3)
    np.testing.assert_array_equal(again.nearest(points, k), tree.nearest(points, k))


@pytest.mark.slow
@pytest.mark.parametrize("policy", [None, "ACTIVE"])
def test_other_libraries_keep_their_policy_of_waiting(policy: str | None) -> None:
    variables = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    variables |= {} if policy is None else {"OMP_WAIT_POLICY": policy}
    program = "import os, dpmjax.geometry.neighbours; print(os.environ.get('OMP_WAIT_POLICY'))"
    printed = subprocess.run([sys.executable, "-c", program], env=variables, capture_output=True, check=True, text=True)
    assert printed.stdout.strip() == str(policy)
