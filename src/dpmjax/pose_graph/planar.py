"""The solver in the form that registration of planar scans uses: poses (n, 3) in, poses out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, Floats, PoseGraph
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph


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
    # A step of the target moves the tangent of an edge by minus the adjoint of T_source_target.
    adjoint = se2.adjoint(se2.inverse(edges.measurements))
    jacobian = np.stack([-adjoint, np.broadcast_to(np.eye(3), adjoint.shape)], axis=1)
    transposed = np.swapaxes(jacobian, 2, 3)
    blocks = (transposed @ edges.information[:, None])[:, :, None] @ jacobian[:, None]
    nodes = np.stack([edges.target, edges.source], axis=1)
    is_held = np.arange(num_poses) == 0
    return solve_blocks(nodes, blocks, np.einsum("esij,ej->esi", transposed, gradient), is_held, damping=damping)


@dataclass(frozen=True)
class GraphConfig(PoseGraphConfig):
    """Settings of the robust planar graph: a kernel on every edge, and no other start than the one given."""

    outlier_chi2: float | None = 10.0
    tolerance: float = 1e-8
    is_chordal_start: bool = False


def optimize_planar_graph(
    poses: Floats, edges: Edges, config: GraphConfig | None = None, *, trust: Floats | float = 1.0
) -> tuple[Floats, Floats]:
    """Poses that agree with most edges; wrong edges are let go.

    Args:
        poses: (n, 3) start, T_world_scan; the first one is held.
        edges: measured relative poses.
        config: settings.
        trust: (e,) how many edges of the ordinary kind must contradict an edge before it is let go.

    Returns:
        The poses and each edge's final weight, 0 (let go) to 1.
    """
    solved = optimize_pose_graph(PoseGraph.create(poses, edges), config or GraphConfig(), trust=trust)
    return solved.graph.poses, solved.weights
