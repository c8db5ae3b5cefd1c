"""Robust Levenberg-Marquardt over all poses of a graph, in the plane and in space.

Without a kernel this is plain least squares. With one, every edge has a Geman-McClure kernel that is narrowed step by
step (graduated non-convexity): all edges count at first, then wrong ones lose their weight.

A start that needs no first guess is the chordal relaxation. The difference of rotation matrices (a chord instead of an
arc) is linear in their entries. So the rotations come out of one sparse linear system and are then projected to the
nearest rotations; with them known, the translations are linear too (Martinec and Pajdla 2007; Carlone et al. 2015).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from dpmjax.checks import require_count, require_positive, require_value, runs_on_host
from dpmjax.geometry import rigid, se2
from dpmjax.pose_graph.free_nodes import FreeNodes, describe_free_nodes, find_free_nodes
from dpmjax.pose_graph.graph import Edges, Floats, PoseGraph, label_parts
from dpmjax.pose_graph.normal_equations import BlockPattern, Linearisation, linearise, solve_symmetric
from dpmjax.types import with_short_repr

LOGGER = logging.getLogger(__name__)

# Width of the kernel at the start, in final widths; each step narrows it.
_FIRST_WIDENING, _NARROWING = 1000.0, 1.6
# Levenberg-Marquardt damping at the start, as a share of the diagonal.
_FIRST_DAMPING = 1e-6
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e6
# Diagonal entries that damping goes by, in medians of all. By a larger one, an edge a billion times stiffer than the
# others would hold both of its nodes; by a smaller one, nodes that nothing holds would leave with the rounding.
_LEAST_STIFFNESS, _MOST_STIFFNESS = 1e-3, 1e3


# From a higher cost, each step must arrive at less than this share of it; else the optimisation returns.
_DETOUR = 0.1


@dataclass(frozen=True)
class PoseGraphConfig:
    """Settings of the optimisation.

    Attributes:
        outlier_chi2: largest cost of a contradicted edge (squared Mahalanobis distance; 10 is about the 98 %
            quantile in the plane). None for plain least squares.
        max_iterations: the largest number of linear solves.
        tolerance: share of the cost below which a decrease ends the optimisation.
        is_chordal_start: True also tries the chordal relaxation as a start, and takes it where its cost is lower.
    """

    outlier_chi2: float | None = None
    max_iterations: int = 100
    tolerance: float = 1e-5
    is_chordal_start: bool = True

    def __post_init__(self) -> None:
        """Checks the numbers."""
        require_count("max_iterations", self.max_iterations)
        require_positive("tolerance", self.tolerance)
        if self.outlier_chi2 is not None:
            require_positive("outlier_chi2", self.outlier_chi2)


# Wrong edges lose their weight; the given poses are the only start.
ROBUST = PoseGraphConfig(outlier_chi2=10.0, tolerance=1e-8, is_chordal_start=False)


@with_short_repr
class OptimizedPoseGraph(NamedTuple):
    """An optimised graph.

    Attributes:
        graph: the graph at the new poses.
        chi2: sum of r^T W r over all edges, each times its weight.
        chi2_initial: the same sum at the given poses, all weights one.
        iterations: number of linear solves, rejected ones included.
        weights: (e,) final weight of each edge, 0 (rejected) to 1; all one without a kernel.
        is_converged: False where the iterations ran out, or no step lowered the cost.
        free_nodes: nodes that the edges leave free; they stay near their given poses. Each group is logged, too.
    """

    graph: PoseGraph
    chi2: float
    chi2_initial: float
    iterations: int
    weights: Floats
    is_converged: bool
    free_nodes: tuple[FreeNodes, ...]


class _State(NamedTuple):
    """The optimisation between two solves.

    Attributes:
        at: the poses from which the next step begins.
        damping: the damping of the next step.
        widening: the width of the kernel in final widths.
        is_converged: True at a minimum.
        before: the poses of lower cost from which steps have led here; None where `at` has the lowest cost.
    """

    at: Linearisation
    damping: float
    widening: float
    is_converged: bool = False
    before: Linearisation | None = None

    @property
    def best(self) -> Linearisation:
        """The poses of the lowest cost."""
        return self.before or self.at


@runs_on_host("call pose_graph.solve_dense there")
def optimize_pose_graph(
    graph: PoseGraph, config: PoseGraphConfig | None = None, *, trust: Floats | float = 1.0
) -> OptimizedPoseGraph:
    """Moves all free poses so that the relative poses agree with the measured ones.

    The residuals are those of `pose_graph.residuals`. Fixed nodes stay. In each connected part without a fixed node the
    first node stays, so that a graph of several parts is no singular system. Nodes that the edges leave free are named
    in the result and in a logged warning. Runs on the host; `pose_graph.solve_dense` can be traced.

    Args:
        graph: poses and measurements, in the plane or in space.
        config: settings; plain least squares by default.
        trust: (e,) number of ordinary edges that must contradict an edge before the kernel rejects it.

    Returns:
        The optimised graph and its cost; the graph itself where no step lowers the cost.

    Raises:
        ValueError: the cost of the given poses is not a finite number, `trust` is not positive, or an array is traced.
    """
    config = config or PoseGraphConfig()
    require_value((np.asarray(trust) > 0).all(), "trust", "numbers above 0", "others")
    width = np.full(len(graph.edges.source), config.outlier_chi2 or np.inf) * trust
    pattern = BlockPattern.create(graph.ends, graph.held_nodes())
    at = linearise(graph.poses, graph.edges)
    chi2_initial = float(at.chi2.sum())
    require_value(np.isfinite(chi2_initial), "graph", "residuals of finite length", "NaN or infinity")
    if config.is_chordal_start and len(graph.edges.source):
        chordal = linearise(chordal_poses(graph, pattern), graph.edges)
        at = chordal if _cost(chordal.chi2, width) < _cost(at.chi2, width) else at
    state = _State(at, _FIRST_DAMPING, 1.0 if config.outlier_chi2 is None else _FIRST_WIDENING)
    iterations = 0
    while iterations < config.max_iterations and not state.is_converged and state.damping < _MOST_DAMPING:
        state = _iterate(state, graph, pattern, width, config)
        iterations += 1
    weights, moved = _weights(state.best.chi2, width), replace(graph, poses=state.best.poses)
    chi2 = float((weights * state.best.chi2).sum())
    free = find_free_nodes(moved)
    if free:
        LOGGER.warning("%s; they stay near their given poses", describe_free_nodes(free))
    return OptimizedPoseGraph(moved, chi2, chi2_initial, iterations, weights, state.is_converged, free)


def _iterate(state: _State, graph: PoseGraph, pattern: BlockPattern, width: Floats, config: PoseGraphConfig) -> _State:
    """Returns the state after one damped solve, whose step is taken if it lowers the cost.

    After a step that raises the cost, further steps are tried as long as they lower it fast. All are taken if the last
    one ends below the cost before them. This serves graphs with one very stiff edge: the first step follows it along a
    tangent, and the further steps return to it.
    """
    at, is_narrow = state.at, state.widening <= 1.0
    width = width * state.widening
    weights = _weights(at.chi2, width)
    matrix = pattern.matrix(at.blocks * weights[:, None, None, None, None])
    right = -pattern.vector(at.gradient * weights[:, None, None])
    diagonal = matrix.diagonal()
    typical = max(np.median(diagonal[diagonal > 0]), 1e-300) if diagonal.any() else 1e-300
    extra = state.damping * np.clip(diagonal, _LEAST_STIFFNESS * typical, _MOST_STIFFNESS * typical)
    step = solve_symmetric(matrix, right, extra)
    cost = _cost(state.best.chi2, width)
    small = config.tolerance * cost + 1e-12
    widening = max(1.0, state.widening / _NARROWING)
    trial, decrease = at, -np.inf
    if np.isfinite(step).all():
        if is_narrow and state.before is None and step @ right + step @ (extra * step) <= small:
            return state._replace(is_converged=True)
        trial = linearise(at.poses, graph.edges, pattern.to_nodes(step, graph.tangent_size))
        decrease = cost - _cost(trial.chi2, width)
    if decrease >= 0:
        return _State(trial, max(0.1 * state.damping, _LEAST_DAMPING), widening, is_narrow and decrease <= small)
    if np.isfinite(decrease) and (state.before is None or _cost(trial.chi2, width) < _DETOUR * _cost(at.chi2, width)):
        return state._replace(at=trial, before=state.best, widening=widening)
    return _State(state.best, 10.0 * state.damping, widening)


def _weights(chi2: Floats, width: Floats) -> Floats:
    """Returns weights of the edges under a Geman-McClure kernel of this width; one where the width is infinite."""
    return 1.0 / (1.0 + chi2 / width) ** 2


def _cost(chi2: Floats, width: Floats) -> float:
    """Returns the sum of the costs of all edges: chi2 where it is small, at most the width of the kernel."""
    return float((chi2 / (1.0 + chi2 / width)).sum())


def spanning_tree_poses(num_nodes: int, edges: Edges) -> Floats:
    """Chains the measurements from the first node of each connected part, by the fewest edges to each node.

    Args:
        num_nodes: number of nodes.
        edges: the measurements, in the plane or in space.

    Returns:
        (num_nodes, 3) or (num_nodes, 4, 4) `T_first_node`; the first node of each part has the identity.
    """
    is_planar = edges.measurements.ndim == 2
    T_target_source = se2.to_matrix(edges.measurements) if is_planar else edges.measurements
    # Each edge stands in both directions, in this order. The first of several edges between two nodes counts.
    ends = np.stack([edges.target, edges.source, edges.source, edges.target], axis=1).reshape(-1, 2)
    motions = np.stack([T_target_source, rigid.inverse(T_target_source)], axis=1).reshape(
        -1, *T_target_source.shape[1:]
    )
    keys, first = np.unique(ends @ [num_nodes, 1], return_index=True)
    joined = sp.csr_matrix((np.ones(len(keys)), np.divmod(keys, num_nodes)), (num_nodes, num_nodes))
    T = np.tile(np.eye(motions.shape[-1]), (num_nodes, 1, 1))
    for root in np.unique(label_parts(num_nodes, edges.source, edges.target), return_index=True)[1]:
        order, before = sp.csgraph.breadth_first_order(joined, root, directed=True)
        nodes, parents = order[1:].astype(np.int64), before[order[1:]].astype(np.int64)
        rows = first[np.searchsorted(keys, num_nodes * parents + nodes)]
        for node, parent, row in zip(nodes, parents, rows, strict=True):
            T[node] = T[parent] @ motions[row]
    return np.asarray(se2.from_matrix(T)) if is_planar else T


def chordal_poses(graph: PoseGraph, pattern: BlockPattern) -> Floats:
    """Computes poses from the measurements alone; only held nodes keep their poses.

    Args:
        graph: the graph; poses of nodes that are not held may be anything.
        pattern: pattern of its edges, nodes in the order target, source.

    Returns:
        Poses in the form of the graph's; not finite where the measurements leave a pose open.
    """
    is_planar = graph.poses.ndim == 2
    poses, measured = (se2.to_matrix(x) if is_planar else x for x in (graph.poses, graph.edges.measurements))
    dim = poses.shape[1] - 1
    is_free = np.isin(np.arange(len(poses)), pattern.free_nodes)
    information = np.einsum("eii->ei", graph.edges.information)
    # Rows of R_source - R_target @ R_measured; transposed, so that the unknowns are columns.
    turn = np.swapaxes(measured[:, :dim, :dim], 1, 2)
    jacobian = np.stack([-turn, np.broadcast_to(np.eye(dim), turn.shape)], axis=1)
    held = np.where(is_free[:, None, None], 0.0, np.swapaxes(poses[:, :dim, :dim], 1, 2))
    columns = held + _solve_linear(pattern, jacobian, held, information[:, dim:].mean(axis=1))
    rotations = np.swapaxes(poses[:, :dim, :dim], 1, 2).copy()
    rotations[is_free] = _nearest_rotations(columns[is_free])
    rotations = np.swapaxes(rotations, 1, 2)
    # Rows of t_source - t_target - R_target @ t_measured.
    shift = np.einsum("eij,ej->ei", rotations[graph.edges.target], measured[:, :dim, dim])
    ones = np.broadcast_to(np.array([-1.0, 1.0])[:, None, None], (len(turn), 2, 1, 1))
    held = np.where(is_free[:, None], 0.0, poses[:, :dim, dim])[:, None]
    weight = information[:, :dim].mean(axis=1)
    translations = (held + _solve_linear(pattern, ones, held, weight, shift[:, None]))[:, 0]
    start = poses.copy()
    start[:, :dim, :dim], start[:, :dim, dim] = rotations, translations
    return se2.from_matrix(start) if is_planar else start


def _solve_linear(
    pattern: BlockPattern,
    jacobian: Float[np.ndarray, "e 2 d d"],
    held: Float[np.ndarray, "n d k"],
    weight: Floats,
    constant: Float[np.ndarray, "e d k"] | float = 0.0,
) -> Float[np.ndarray, "n d k"]:
    """Returns unknowns that minimise |jacobian @ unknowns - constant|, zero for held nodes; k right sides at once."""
    weighted = weight[:, None, None, None] * np.swapaxes(jacobian, 2, 3)
    blocks = weighted[:, :, None] @ jacobian[:, None]
    residual = (jacobian @ held[pattern.nodes]).sum(axis=1) - constant
    right = -pattern.vector(weighted @ residual[:, None])
    matrix = pattern.matrix(blocks)
    return pattern.to_nodes(solve_symmetric(matrix, right), held.shape[1])


def _nearest_rotations(matrices: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n d d"]:
    if not np.isfinite(matrices).all():
        return np.full_like(matrices, np.nan)
    U, _, Vt = np.linalg.svd(matrices)
    U[:, :, -1] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt
