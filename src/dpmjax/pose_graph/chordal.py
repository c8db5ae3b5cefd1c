"""A start for pose graphs that needs no first guess: rotations by the chordal relaxation, then translations.

The difference of rotation matrices (a chord instead of an arc) is linear in their entries. So the rotations come out of
one sparse linear system and are then projected to the nearest rotations; with them known, the translations are
linear too (Martinec and Pajdla 2007; Carlone et al. 2015).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from numpy.typing import NDArray

from dpmjax.geometry import rigid, se2
from dpmjax.pose_graph.graph import Edges, Floats, PoseGraph
from dpmjax.pose_graph.normal_equations import BlockPattern, solve_symmetric


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
    T_source_target = rigid.inverse(T_target_source)
    size = T_target_source.shape[-1]
    T = np.tile(np.eye(size), (num_nodes, 1, 1))
    # Of several edges between two nodes, the first one counts; a number above 0 is an edge in its direction.
    first: dict[tuple[int, int], Floats] = {}
    for row, (source, target) in enumerate(zip(edges.source.tolist(), edges.target.tolist(), strict=True)):
        first.setdefault((target, source), T_target_source[row])
        first.setdefault((source, target), T_source_target[row])
    ends = np.array(list(first), np.int64).reshape(-1, 2)
    joined = sp.csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (num_nodes, num_nodes))
    is_placed = np.zeros(num_nodes, bool)
    for root in range(num_nodes):
        if is_placed[root]:
            continue
        order, before = sp.csgraph.breadth_first_order(joined, root, directed=True)
        is_placed[order] = True
        for node in order[1:].tolist():
            parent = int(before[node])
            T[node] = T[parent] @ first[parent, node]
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
    weight: NDArray[np.float64],
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
