"""Sparse normal equations made of small dense blocks, solved by SuperLU.

A term of a least-squares problem touches a few nodes (two for an edge of a pose graph). Its share of J^T W J is a dense
block for every pair of them, its share of J^T W r a vector for each. Those of a pose graph are computed by JAX with
64-bit floats (`pose_graph/residuals.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Array, Float
from numpy.typing import NDArray

from dpmjax.pose_graph.graph import Edges, Floats, Indices
from dpmjax.pose_graph.residuals import move, normal_blocks


class Linearisation(NamedTuple):
    """All edges at given poses (n nodes, e edges, d degrees of freedom).

    Attributes:
        poses: the poses.
        chi2: (e,) squared Mahalanobis length r^T W r of each residual.
        blocks: (e, 2, 2, d, d) J^T W J between target and source.
        gradient: (e, 2, d) J^T W r.
    """

    poses: Floats
    chi2: Floats
    blocks: Floats
    gradient: Floats


def linearise(poses: Floats, edges: Edges, step: Floats | None = None) -> Linearisation:
    """Linearises all edges at poses, or at those after a step.

    The numbers of nodes and edges are rounded up to powers of two, so that few programs are compiled.

    Args:
        poses: (n, 3) or (n, 4, 4).
        edges: measured relative poses.
        step: (n, 3) or (n, 6) steps in the frame of each pose; None for none.

    Returns:
        The edges at the moved poses.
    """
    num_nodes, num_edges = len(poses), len(edges.source)
    identity, zero = np.zeros(3) if poses.ndim == 2 else np.eye(4), np.zeros(edges.information.shape[1:])
    step = np.zeros((num_nodes, len(zero))) if step is None else step
    fills = (np.int64(0), np.int64(0), identity, zero)
    padded = Edges(*(_padded(values, fill) for values, fill in zip(edges, fills, strict=True)))
    with jax.enable_x64(True):
        arrays = _linearise(_padded(poses, identity), _padded(step, zero[0]), padded)
        moved, *of_edges = (np.asarray(x) for x in arrays)
    return Linearisation(moved[:num_nodes], *(x[:num_edges] for x in of_edges))


def _padded(values: NDArray[Any], fill: Any) -> NDArray[Any]:
    """Appends rows up to a power of two, at least 16."""
    missing = (1 << max(len(values) - 1, 15).bit_length()) - len(values)
    return np.concatenate([values, np.broadcast_to(fill, (missing, *values.shape[1:]))])


@jax.jit
def _linearise(poses: Array, step: Array, edges: Edges) -> tuple[Array, Array, Array, Array]:
    poses = move(poses, step)
    return poses, *normal_blocks(poses, edges)


@dataclass(frozen=True, eq=False)
class BlockPattern:
    """The places of all blocks in the sparse matrix, which stay the same while the numbers change.

    Attributes:
        nodes: (m, s) the nodes of each term.
        num_nodes: n.
        free_nodes: (f,) the free node of each block row, in the order of elimination.
        order: the blocks between free nodes, of m * s * s in all, sorted by their place.
        starts: index in `order` at which each place of the matrix begins.
        columns: block column of each place.
        row_starts: index in `columns` at which each block row begins.
    """

    nodes: Indices
    num_nodes: int
    free_nodes: Indices
    order: Indices
    starts: Indices
    columns: Indices
    row_starts: Indices

    @classmethod
    def create(cls, nodes: Indices, is_held: NDArray[np.bool_]) -> BlockPattern:
        """Finds the places.

        Args:
            nodes: (m, s) the nodes of each term.
            is_held: (n,) nodes that do not move.

        Returns:
            The pattern.
        """
        free = np.flatnonzero(~is_held)
        num_free, rows = len(free), np.full(len(is_held), -1)
        rows[free] = np.arange(num_free)
        rank = _elimination_order(*_free_blocks(rows[nodes])[1:], num_free)
        rows[free] = rank
        used, block_row, block_column = _free_blocks(rows[nodes])
        place = block_row * num_free + block_column
        sorting = np.argsort(place, kind="stable")
        place = place[sorting]
        starts = np.flatnonzero(np.diff(place, prepend=-1))
        columns = place[starts] % max(num_free, 1)
        row_starts = np.searchsorted(place[starts], num_free * np.arange(num_free + 1))
        return cls(nodes, len(is_held), free[np.argsort(rank)], used[sorting], starts, columns, row_starts)

    def matrix(self, blocks: Float[np.ndarray, "m s s d d"]) -> sp.csc_matrix:
        """Sums all blocks over the free nodes.

        Args:
            blocks: J^T W J of each term, symmetric as a whole.

        Returns:
            The sparse matrix, d rows for each free node.
        """
        axes, num_free = blocks.shape[-1], len(self.row_starts) - 1
        ordered = blocks.reshape(-1, axes, axes)[self.order]
        summed = np.add.reduceat(ordered, self.starts, axis=0) if len(self.starts) else ordered
        shape = (axes * num_free, axes * num_free)
        by_rows = sp.bsr_matrix((summed, self.columns, self.row_starts), shape=shape).tocsr()
        # A symmetric matrix has the same arrays by rows and by columns.
        return sp.csc_matrix((by_rows.data, by_rows.indices, by_rows.indptr), shape=shape)

    def vector(self, parts: Float[np.ndarray, "m s *k"]) -> Floats:
        """Sums all vectors over the free nodes.

        Args:
            parts: (m, s, d) or (m, s, d, k), J^T W r of each term.

        Returns:
            (rows of the matrix,) or (rows of the matrix, k).
        """
        shape = parts.shape[2:]
        flat = parts.reshape(self.nodes.size, int(np.prod(shape)))
        summed = [np.bincount(self.nodes.ravel(), column, self.num_nodes) for column in flat.T]
        return np.stack(summed, axis=1).astype(np.float64)[self.free_nodes].reshape(-1, *shape[1:])

    def to_nodes(self, solution: Floats, axes: int) -> Floats:
        """Spreads a solution over all nodes.

        Args:
            solution: (rows of the matrix,) or (rows of the matrix, k).
            axes: d, rows of each node.

        Returns:
            (n, d) or (n, d, k), zero for held nodes.
        """
        full = np.zeros((self.num_nodes, axes, *solution.shape[1:]))
        full[self.free_nodes] = solution.reshape(-1, axes, *solution.shape[1:])
        return full


def _free_blocks(rows: Indices) -> tuple[Indices, Indices, Indices]:
    """Returns the indices of the blocks, of m * s * s in all, between free nodes, and their block rows and columns."""
    block_row, block_column = (x.ravel() for x in np.broadcast_arrays(rows[:, :, None], rows[:, None, :]))
    used = np.flatnonzero((block_row >= 0) & (block_column >= 0))
    return used, block_row[used], block_column[used]


def _elimination_order(block_row: Indices, block_column: Indices, num_free: int) -> Indices:
    """Returns the rank of each free node by minimum degree, which keeps the factors sparse."""
    if num_free == 0:
        return np.zeros(0, np.int64)
    ones = np.ones(len(block_row))
    joined = sp.csc_matrix((ones, (block_row, block_column)), (num_free, num_free))
    # The numbers only have to make a matrix that needs no pivots.
    return factorise(joined, 2.0 * joined.sum(axis=0).A1 + 1.0, "MMD_AT_PLUS_A").perm_c.astype(np.int64)


def factorise(
    matrix: sp.csc_matrix, diagonal: Floats, order: Literal["NATURAL", "MMD_AT_PLUS_A"]
) -> scipy.sparse.linalg.SuperLU:
    """Factorises a symmetric matrix without pivoting.

    Args:
        matrix: (m, m).
        diagonal: (m,) numbers added to its diagonal.
        order: order of elimination.

    Returns:
        The factors.

    Raises:
        RuntimeError: a pivot is zero.
    """
    options = {"SymmetricMode": True}
    damped = (matrix + sp.diags(diagonal)).tocsc()
    return scipy.sparse.linalg.splu(damped, permc_spec=order, diag_pivot_thresh=0.0, options=options)


def solve_symmetric(matrix: sp.csc_matrix, right: Floats, extra: Floats | float = 0.0) -> Floats:
    """Solves a positive definite sparse system by a factorisation that keeps its symmetry.

    Args:
        matrix: (m, m) symmetric, rows in the order of elimination.
        right: (m,) or (m, k) right sides.
        extra: (m,) damping, added to the diagonal.

    Returns:
        The solution, with the shape of `right`; NaN where the matrix is singular.
    """
    if not len(right):
        return right
    try:
        factors = factorise(matrix, np.broadcast_to(extra, (len(right),)), "NATURAL")
    except RuntimeError:
        return np.full_like(right, np.nan)
    return factors.solve(right)


def solve_blocks(
    nodes: Indices, blocks: Float[np.ndarray, "m s s d d"], gradient: Float[np.ndarray, "m s d"], num_nodes: int
) -> Floats:
    """Computes one Gauss-Newton step of all nodes; the first one is held.

    Args:
        nodes: (m, s) the nodes of each term.
        blocks: J^T W J of each term.
        gradient: J^T W r of each term.
        num_nodes: n.

    Returns:
        (n, d) steps.
    """
    pattern = BlockPattern.create(nodes, np.arange(num_nodes) == 0)
    matrix = pattern.matrix(blocks)
    diagonal = matrix.diagonal()
    # A little damping, so that nodes without a sharp term stay where they are.
    extra = 1e-6 * diagonal + 1e-9 * max(diagonal.max(initial=0.0), 1e-300)
    return pattern.to_nodes(solve_symmetric(matrix, -pattern.vector(gradient), extra), gradient.shape[-1])
