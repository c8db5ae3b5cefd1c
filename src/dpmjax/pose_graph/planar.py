"""Sparse Gauss-Newton over all planar poses: the solver under the polish and under loop closure.

Poses move on the right, T_i @ exp(delta_i). The tangent of an edge T_j_i then moves by delta_i - Ad(T_i_j) delta_j, so
one 3 x 3 matrix and one 3-vector of each edge make the whole sparse system.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from dpmjax.geometry import se2

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class Edges(NamedTuple):
    """Relative poses that were measured (e edges).

    Attributes:
        source: row of the pose that moves in the edge, i.
        target: row of the pose in whose frame the edge is, j.
        poses: (e, 3) T_j_i.
        information: (e, 3, 3) inverse covariance in the tangent of the source frame.
    """

    source: Indices
    target: Indices
    poses: Floats
    information: Floats


def join_edges(*edges: Edges) -> Edges:
    """All edges in one."""
    return Edges(*(np.concatenate(parts) for parts in zip(*edges, strict=True)))


@dataclass(frozen=True)
class GraphConfig:
    """Settings of the robust pose graph.

    Attributes:
        outlier_chi2: squared Mahalanobis distance beyond which an edge loses most of its say (3 degrees of freedom);
            the most that a contradicted edge costs.
        num_iterations: at most so many solves.
        widening: the graduated kernel starts so many times wider; all edges count, then outliers are let go.
    """

    outlier_chi2: float = 10.0
    num_iterations: int = 30
    widening: float = 1000.0


def solve_poses(num_poses: int, edges: Edges, gradient: Floats, *, damping: float = 1e-6) -> Floats:
    """One Gauss-Newton step of all poses; the first one is held.

    Args:
        num_poses: n.
        edges: the relative poses at which the system was linearised, with J^T W J as information.
        gradient: (e, 3) J^T W r of each edge in the tangent of its source frame.
        damping: share of the diagonal that is added, so that poses without a sharp edge stay where they are.

    Returns:
        (n, 3) steps in each pose's own frame.
    """
    i, j, information = edges.source, edges.target, edges.information
    turn = se2.adjoint(se2.inverse(edges.poses))
    turned = np.swapaxes(turn, 1, 2)
    blocks = [(i, i, information), (i, j, -information @ turn), (j, i, -turned @ information)]
    blocks.append((j, j, turned @ information @ turn))
    axes = np.arange(3)
    rows = np.concatenate(
        [np.broadcast_to(3 * a[:, None, None] + axes[:, None], m.shape).ravel() for a, _, m in blocks]
    )
    cols = np.concatenate([np.broadcast_to(3 * b[:, None, None] + axes, m.shape).ravel() for _, b, m in blocks])
    values = np.concatenate([m.ravel() for _, _, m in blocks])
    matrix = sp.csc_matrix((values, (rows, cols)), shape=(3 * num_poses, 3 * num_poses))
    right = np.zeros((num_poses, 3))
    np.add.at(right, i, -gradient)
    np.add.at(right, j, np.einsum("eji,ej->ei", turn, gradient))
    diagonal = matrix.diagonal()
    extra = damping * diagonal + 1e-9 * max(diagonal.max(initial=0.0), 1e-300)
    extra[:3] += 1e9 * max(diagonal.max(initial=0.0), 1.0)
    solved = scipy.sparse.linalg.splu((matrix + sp.diags(extra)).tocsc()).solve(right.ravel())
    return solved.reshape(num_poses, 3)


def optimize_planar_graph(
    poses: Floats, edges: Edges, config: GraphConfig | None = None, *, trust: Floats | float = 1.0
) -> tuple[Floats, Floats]:
    """Poses that agree with most edges, by graduated non-convexity with a Geman-McClure kernel on every edge.

    Args:
        poses: (n, 3) start, T_world_scan; the first one is held.
        edges: measured relative poses; wrong ones are let go.
        config: settings.
        trust: (e,) how many edges of the ordinary kind must contradict an edge before it is let go.

    Returns:
        The poses and each edge's final weight, 0 (let go) to 1.
    """
    config = config or GraphConfig()
    widening = config.widening
    weight = np.ones(len(edges.source))
    for _ in range(config.num_iterations):
        here = se2.relative(poses[edges.target], poses[edges.source])
        error = se2.relative(edges.poses, here)
        chi2 = np.einsum("ei,eij,ej->e", error, edges.information, error)
        scaled = widening * config.outlier_chi2 * np.asarray(trust)
        weight = (scaled / (scaled + chi2)) ** 2
        weighted = edges.information * weight[:, None, None]
        gradient = np.einsum("eij,ej->ei", weighted, error)
        step = solve_poses(len(poses), edges._replace(poses=here, information=weighted), gradient)
        poses = se2.compose(poses, step)
        widening = max(1.0, widening / 1.6)
    return poses, weight
