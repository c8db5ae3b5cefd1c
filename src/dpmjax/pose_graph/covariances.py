"""Covariance of each pose of a graph, from the sparse normal equations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from dpmjax.checks import runs_on_host
from dpmjax.pose_graph.graph import PoseGraph
from dpmjax.pose_graph.normal_equations import BlockPattern, factorise, linearise

# Number of nodes whose columns of the inverse are solved at once: more take more memory.
_BATCH = 64


@runs_on_host("invert the normal equations of pose_graph.residuals there")
def pose_covariances(graph: PoseGraph) -> Float[np.ndarray, "n d d"]:
    """Computes the marginal covariance of each pose at the present poses, the inverse of J^T W J.

    They are as right as the information of the edges. The held nodes (`PoseGraph.held_nodes`) are certain: all
    covariances are relative to them, in each connected part. Runs on the host.

    Args:
        graph: an optimised graph, in the plane or in space.

    Returns:
        (n, 3, 3) or (n, 6, 6) covariances of the step in the frame of each pose, translation first, metres and
        radians. They are zero for held nodes, and infinite for nodes that the edges leave free.

    Raises:
        ValueError: an array is traced.
    """
    held, size = graph.held_nodes(), graph.tangent_size
    covariances = np.zeros((len(held), size, size))
    pattern = BlockPattern.create(np.stack([graph.edges.target, graph.edges.source], axis=1), held)
    at = linearise(graph.poses, np.zeros((len(held), size)), graph.edges)
    matrix = pattern.matrix(at.blocks)
    try:
        factors = factorise(matrix, np.zeros(matrix.shape[0]), "NATURAL")
    except RuntimeError:
        covariances[~held] = np.inf
        return covariances
    for begin in range(0, len(pattern.free_nodes), _BATCH):
        nodes = pattern.free_nodes[begin : begin + _BATCH]
        rows = begin * size + np.arange(len(nodes) * size)
        units = np.zeros((matrix.shape[0], len(rows)))
        units[rows, np.arange(len(rows))] = 1.0
        columns = factors.solve(units)[rows].reshape(len(nodes), size, len(nodes), size)
        covariances[nodes] = columns[np.arange(len(nodes)), :, np.arange(len(nodes))]
    return covariances
