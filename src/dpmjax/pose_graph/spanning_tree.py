"""A start for graphs without poses: measurements chained along a spanning tree."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dpmjax.geometry import rigid, se2
from dpmjax.pose_graph.graph import Edges, Floats


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
