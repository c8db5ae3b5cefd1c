"""The records of pose graphs: edges are measured relative poses, a graph is poses and edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from dpmjax.checks import require_value, runs_on_host
from dpmjax.types import with_short_repr

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
# A record of arrays of equal length.
Rows = TypeVar("Rows", bound=tuple[Any, ...])

# Degrees of freedom of a pose by its shape: x, y, heading in the plane; a homogeneous matrix in space.
TANGENT_SIZE = {(3,): 3, (4, 4): 6}
# Largest error of an information matrix that was computed in float32, relative to its largest entry.
_ROUNDING = 1e-5


@with_short_repr
class Edges(NamedTuple):
    """Measured relative poses (e edges).

    Attributes:
        source: (e,) row of the pose that was measured.
        target: (e,) row of the pose in whose frame it was measured.
        measurements: `T_target_source`; (e, 3) x, y, heading in the plane, (e, 4, 4) in space.
        information: inverse covariance of the residual (`pose_graph.residuals`), translation first; (e, 3, 3) or
            (e, 6, 6). In space its rotations are rotation vectors in radians.
    """

    source: Indices
    target: Indices
    measurements: Floats
    information: Floats


def join_rows(*records: Rows) -> Rows:
    """Joins records of arrays of one type, such as lists of edges, into one record.

    Args:
        *records: the records, in the order of the result.

    Returns:
        A record with all rows.
    """
    return jax.tree.map(lambda *parts: np.concatenate(parts), *records)


def take_rows(record: Rows, rows: NDArray[Any]) -> Rows:
    """Returns some rows of a record of arrays, such as a list of edges.

    Args:
        record: the record.
        rows: row numbers, or a mask that is True for the rows.

    Returns:
        A record with these rows.
    """
    return jax.tree.map(lambda values: values[rows], record)


def label_parts(size: int, source: NDArray[np.integer], target: NDArray[np.integer]) -> Indices:
    """Labels the connected parts of a graph.

    Args:
        size: number of nodes.
        source: (e,) rows of the nodes at one end of the edges.
        target: (e,) rows of the nodes at the opposite end.

    Returns:
        (size,) number of the part of each node.
    """
    joined = sp.coo_matrix((np.ones(len(source)), (source, target)), (size, size))
    return np.asarray(sp.csgraph.connected_components(joined, directed=False)[1], np.int64)


@with_short_repr
@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses (n nodes) and the relative poses measured between them. `PoseGraph.create` makes and checks one.

    Attributes:
        poses: `T_world_node`; (n, 3) x, y, heading in the plane, (n, 4, 4) in space; metres and radians.
        edges: measured relative poses.
        is_fixed: (n,) True for nodes that the optimisation does not move.
        ids: (n,) names of the nodes in files.
    """

    poses: Floats
    edges: Edges
    is_fixed: NDArray[np.bool_]
    ids: Indices

    @classmethod
    @runs_on_host("call pose_graph.residuals or pose_graph.solve_dense there")
    def create(
        cls, poses: ArrayLike, edges: Edges, *, is_fixed: ArrayLike | None = None, ids: ArrayLike | None = None
    ) -> PoseGraph:
        """Makes a graph out of anything that NumPy takes for arrays.

        Args:
            poses: (n, 3) or (n, 4, 4) `T_world_node`.
            edges: measured relative poses, as in `Edges`.
            is_fixed: (n,) nodes that stay; none by default.
            ids: (n,) names of the nodes; their rows by default.

        Returns:
            The graph, in float64.

        Raises:
            ValueError: the shapes do not match, a number is not finite, or an edge joins no two nodes of the graph.
                Also if an information matrix is not symmetric and positive semidefinite, or if an array is traced.
        """
        poses = np.asarray(poses, np.float64)
        source, target = (np.asarray(rows, np.int64) for rows in edges[:2])
        edges = Edges(source, target, *(np.asarray(values, np.float64) for values in edges[2:]))
        fixed = np.zeros(len(poses), bool) if is_fixed is None else np.asarray(is_fixed, bool)
        graph = cls(poses, edges, fixed, np.arange(len(poses)) if ids is None else np.asarray(ids, np.int64))
        _check(graph)
        return graph

    @property
    def tangent_size(self) -> int:
        """Degrees of freedom of a pose: 3 in the plane, 6 in space."""
        return TANGENT_SIZE[self.poses.shape[1:]]

    @property
    def ends(self) -> Indices:
        """Target and source of each edge (e, 2)."""
        return np.stack([self.edges.target, self.edges.source], axis=1)

    def held_nodes(self) -> NDArray[np.bool_]:
        """Finds the nodes that an optimisation does not move.

        Returns:
            (n,) True for fixed nodes, and for the first node of each connected part without any.
        """
        part = label_parts(len(self.poses), self.edges.source, self.edges.target)
        has_fixed = np.bincount(part[self.is_fixed], minlength=part.max() + 1) > 0
        first = np.unique(part, return_index=True)[1]
        held = self.is_fixed.copy()
        held[first[~has_fixed]] = True
        return held


def _check(graph: PoseGraph) -> None:
    edges, size, count = graph.edges, len(graph.poses), len(graph.edges.source)
    pose = graph.poses.shape[1:]
    require_value(pose in TANGENT_SIZE and size > 0, "poses", "shape (n, 3) or (n, 4, 4), n >= 1", graph.poses.shape)
    tangent = (graph.tangent_size, graph.tangent_size)
    arrays = {"poses": graph.poses, "is_fixed": graph.is_fixed, "ids": graph.ids, **edges._asdict()}
    leading = {"poses": size, "is_fixed": size, "ids": size}
    inner = {"poses": pose, "measurements": pose, "information": tangent}
    for name, array in arrays.items():
        shape = (leading.get(name, count), *inner.get(name, ()))
        require_value(array.shape == shape, name, f"shape {shape}", array.shape)
        bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
        require_value(not len(bad), name, "finite numbers", f"NaN or infinity in row {next(iter(bad), None)}")
    require_value(len(np.unique(graph.ids)) == size, "ids", "every id once", "an id twice")
    for name, rows in (("source", edges.source), ("target", edges.target)):
        is_node = (rows >= 0) & (rows < size)
        require_value(is_node.all(), name, f"rows of nodes in [0, {size})", rows[~is_node][:1])
    loops = np.flatnonzero(edges.source == edges.target)
    require_value(not len(loops), "source", "another node than the target", f"the same in edges {loops[:3]}")
    is_good = is_semidefinite(edges.information).all()
    require_value(is_good, "information", "symmetric, positive semidefinite matrices", "others")


def is_semidefinite(information: Floats) -> NDArray[np.bool_]:
    """Returns True for matrices that are symmetric and positive semidefinite, up to the rounding of float32.

    Args:
        information: (e, d, d), finite.

    Returns:
        (e,).
    """
    scale = np.abs(information).max(axis=(1, 2), initial=0.0)
    is_symmetric = np.abs(information - np.swapaxes(information, 1, 2)).max(axis=(1, 2)) <= _ROUNDING * scale
    return np.asarray(is_symmetric & (np.linalg.eigvalsh(information)[:, 0] >= -_ROUNDING * scale))


def nearest_semidefinite(information: Floats) -> Floats:
    """Projects symmetric matrices to the nearest positive semidefinite ones, in the Frobenius norm (Higham 1988).

    Args:
        information: (e, d, d) symmetric, finite.

    Returns:
        (e, d, d): negative eigenvalues are zero.
    """
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2))
