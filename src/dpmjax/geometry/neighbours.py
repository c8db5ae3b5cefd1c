"""Nearest neighbours: by exhaustive search, exact, masked and with bounded memory; by a tree on the host.

Squared distances come from coordinate differences, never from the expanded square: that one loses metres of a
100 m scan to cancellation in float32. Which points are nearest has no derivative; the distances to them have.
"""

from __future__ import annotations

import functools
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_mask, as_points, require_count, require_positive, require_value
from dpmjax.geometry.traced import is_usable, with_axes_of
from dpmjax.types import AnyArray, Neighbours

# How many distances are held at once: 64 MB in float32.
MAX_LIVE_DISTANCES = 1 << 24

# Number of points from which a tree orders them.
ORDERED_FROM = 1 << 14

# The bits of each byte, with a zero between any two.
SPREAD_BITS = np.array([sum((byte >> bit & 1) << 2 * bit for bit in range(8)) for byte in range(256)], np.uint16)

_POINTS_A_PASS = 4  # Points that one pass over all queries compares on a CPU.


def k_nearest(
    queries: Float[AnyArray, "m d"], points: Float[AnyArray, "n d"], k: int, mask: Bool[AnyArray, " n"] | None = None
) -> Neighbours:
    """The k nearest points of each query, nearest first; of equally near ones the lower index first.

    Args:
        queries: where to search, in the frame and unit of `points`.
        points: the searched points.
        k: number of neighbours; may exceed the number of points.
        mask: False for points that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.

    Returns:
        Neighbours (m, k). With fewer than k valid points, the remaining columns are masked: index 0, distance infinite.
        A query with a coordinate that is not a number from -1e15 to 1e15 has no neighbours. `squared_distances` is
        differentiable in both clouds.

    Raises:
        ValueError: the shapes do not match, or k is below 1.
    """
    queries, points = as_points("queries", queries), as_points("points", points)
    dim = queries.shape[1]
    require_value(points.shape[1] == dim, "points", f"{dim} columns like queries", points.shape[1])
    require_count("k", k)
    return _k_nearest(queries, points, as_mask("mask", mask, points.shape[:1]), k=k)


@functools.partial(jax.jit, static_argnames="k")
def _k_nearest(queries: jax.Array, points: jax.Array, mask: jax.Array, *, k: int) -> Neighbours:
    if points.shape[0] == 0:
        points, mask = jnp.zeros((1, points.shape[1]), points.dtype), jnp.zeros(1, bool)
    mask = mask & is_usable(points)
    num_found = min(k, points.shape[0])
    arguments, search = (*lax.stop_gradient((queries, points)), mask), functools.partial(_search_top_k, k=num_found)
    # A reduction over pairs does not vectorise on a CPU; a loop over points, all queries at once, is six times faster,
    # and another three times where the best ones stay in registers for some points.
    one = functools.partial(lax.platform_dependent, cpu=_loop_over_points, default=search)
    indices, is_found = one(*arguments) if num_found == 1 else search(*arguments)
    is_found = is_found & is_usable(queries)[:, None]
    indices = jnp.where(is_found, indices, 0)
    # Distances once more, from the few points that were found: so their gradient costs (m, k) and not (m, n).
    difference = jnp.where(is_found[..., None], queries[:, None] - points[indices], 0)
    squared = jnp.where(is_found, jnp.sum(difference**2, axis=-1), jnp.inf)
    padding = ((0, 0), (0, k - num_found))
    squared = jnp.pad(squared, padding, constant_values=jnp.inf)
    return Neighbours(jnp.pad(indices, padding), squared, jnp.pad(is_found, padding))


def radius_search(
    queries: Float[AnyArray, "m d"],
    points: Float[AnyArray, "n d"],
    radius: float,
    max_neighbours: int,
    mask: Bool[AnyArray, " n"] | None = None,
) -> Neighbours:
    """The nearest points within a radius of each query, at most `max_neighbours`; otherwise as `k_nearest`.

    A point at exactly `radius` is within it. Changing the radius does not compile again.

    Args:
        queries: where to search, in the frame and unit of `points`.
        points: the searched points.
        radius: largest distance of a neighbour.
        max_neighbours: largest number of neighbours that are kept.
        mask: False for points that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.

    Returns:
        Neighbours (m, max_neighbours), nearest first; masked where there are fewer.

    Raises:
        ValueError: the shapes do not match, `max_neighbours` is below 1, or `radius` is not above 0.
    """
    require_count("max_neighbours", max_neighbours)
    require_positive("radius", radius)
    near = k_nearest(queries, points, max_neighbours, mask)
    squared = near.squared_distances
    is_within = near.mask & (squared <= jnp.asarray(radius, squared.dtype) ** 2)
    return Neighbours(jnp.where(is_within, near.indices, 0), jnp.where(is_within, squared, jnp.inf), is_within)


def _loop_over_points(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], mask: Bool[Array, " n"]
) -> tuple[Int[Array, "m 1"], Bool[Array, "m 1"]]:
    columns = [queries[:, axis] for axis in range(queries.shape[1])]

    def keep_nearer(index: Int[Array, ""], best: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        best_squared, best_index = best
        squared = sum((column - points[index, axis]) ** 2 for axis, column in enumerate(columns))
        is_nearer = mask[index] & (squared < best_squared)
        return jnp.where(is_nearer, squared, best_squared), jnp.where(is_nearer, index, best_index)

    begin = with_axes_of((queries, points, mask), jnp.zeros(queries.shape[:1], jnp.int32))
    start = (jnp.inf + begin.astype(queries.dtype), begin)
    best_squared, best_index = lax.fori_loop(0, points.shape[0], keep_nearer, start, unroll=_POINTS_A_PASS)
    return best_index[:, None], jnp.isfinite(best_squared)[:, None]


def _search_top_k(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], mask: Bool[Array, " n"], *, k: int
) -> tuple[Int[Array, "m k"], Bool[Array, "m k"]]:
    num_queries, num_points = queries.shape[0], points.shape[0]
    columns = points.T

    def search(query: Float[Array, " d"]) -> tuple[Int[Array, " k"], Bool[Array, " k"]]:
        squared = sum((query[axis] - column) ** 2 for axis, column in enumerate(columns))
        negative, indices = lax.top_k(-jnp.where(mask, squared, jnp.inf), k)
        return indices, jnp.isfinite(negative)

    chunk = max(1, MAX_LIVE_DISTANCES // num_points)
    if num_queries <= chunk:
        return jax.vmap(search)(queries)
    return lax.map(search, queries, batch_size=chunk)


# Its threads would wait in a loop for milliseconds after each search, on cores that JAX needs by then. OpenMP reads the
# policy once, when the library is loaded.
_GIVEN = os.environ.get("OMP_WAIT_POLICY")
os.environ["OMP_WAIT_POLICY"] = _GIVEN or "PASSIVE"
import small_gicp  # noqa: E402

if _GIVEN is None:
    del os.environ["OMP_WAIT_POLICY"]


class HostTree:
    """Points in the plane or in space in a k-d tree, which is built at the first search.

    Attributes:
        points: (n, d) float64.
        num_threads: threads of building and searching.
    """

    def __init__(self, points: Float[np.ndarray, "n d"], *, num_threads: int = 2) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        self.num_threads = num_threads

    @functools.cached_property
    def _built(self) -> tuple[Any, Int[np.ndarray, " n"] | None]:
        # Where a tree is larger than a cache, points near in space lie together: neighbours are found in less time.
        points = _in_space(self.points)
        order = along_curve(points) if len(points) >= ORDERED_FROM else None
        ordered = points if order is None else points.take(order, axis=0)
        return small_gicp.KdTree(ordered, num_threads=self.num_threads), order

    def __reduce__(self) -> tuple[Any, ...]:
        # The tree itself cannot be pickled or copied; it is built again.
        return functools.partial(HostTree, num_threads=self.num_threads), (self.points,)

    def nearest(
        self, queries: Float[np.ndarray, "m d"], k: int
    ) -> tuple[Int[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
        """Finds the nearest points of each query; queries near in space, one after another, are searched faster.

        Args:
            queries: finite.
            k: number of neighbours, at most the number of points.

        Returns:
            Rows of the points and their distances, nearest first; equally near points come in any order.
        """
        if len(self.points) == 0 or k == 0 or len(queries) == 0:
            return np.zeros((len(queries), k), np.int64), np.zeros((len(queries), k))
        tree, order = self._built
        queries = _in_space(np.ascontiguousarray(queries, np.float64))
        found, squared = tree.batch_knn_search(queries, k, num_threads=self.num_threads)
        rows = found.view(np.int64)
        return rows if order is None else order.take(rows), np.sqrt(squared)


def _in_space(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n 3"]:
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def along_curve(points: Float[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
    """Returns the rows of points along a Z-order curve over 256 x 256 cells of the first two axes."""
    x, y = (column - column.min(initial=np.inf) for column in points.T[:2])
    scale = 255 / max(x.max(initial=0), y.max(initial=0), 1e-9)
    of_x, of_y = (SPREAD_BITS[(column * scale).astype(np.uint8)] for column in (x, y))
    return np.argsort(of_x | of_y << 1, kind="stable")  # a radix sort, because codes have 16 bits
