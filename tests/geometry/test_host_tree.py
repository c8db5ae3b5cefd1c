import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from dpmjax.geometry import neighbours
from dpmjax.geometry.neighbours import HostTree


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
