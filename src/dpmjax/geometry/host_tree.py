"""Nearest neighbours on the host: a k-d tree of small_gicp, twice as fast as SciPy's and on several cores."""

from __future__ import annotations

import os

import numpy as np
from jaxtyping import Float, Int

WAIT_POLICY = "OMP_WAIT_POLICY"
if WAIT_POLICY in os.environ:
    import small_gicp
else:
    # Its threads would wait in a loop for milliseconds after each search, on cores that JAX needs by then. OpenMP reads
    # the policy once, when the library is loaded.
    os.environ[WAIT_POLICY] = "PASSIVE"
    import small_gicp

    del os.environ[WAIT_POLICY]


class HostTree:
    """Points in a k-d tree.

    Attributes:
        points: the points, float64.
        num_threads: threads of building and searching.
    """

    def __init__(self, points: Float[np.ndarray, "n 3"], *, num_threads: int = 2) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        self.num_threads = num_threads
        self._tree = small_gicp.KdTree(self.points, num_threads=num_threads) if len(points) > 0 else None

    def nearest(
        self, queries: Float[np.ndarray, "m 3"], k: int
    ) -> tuple[Int[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
        """Finds the nearest points of each query.

        Args:
            queries: finite.
            k: at most the number of points.

        Returns:
            Rows of the points and their distances, nearest first; equally near points come in any order.
        """
        if self._tree is None or k == 0 or len(queries) == 0:
            return np.zeros((len(queries), k), np.int64), np.zeros((len(queries), k))
        rows, squared = self._tree.batch_knn_search(
            np.ascontiguousarray(queries, np.float64), k, num_threads=self.num_threads
        )
        return rows.view(np.int64), np.sqrt(squared)
