"""Residuals of edges and their derivatives, as pure functions of JAX; both solvers minimise these residuals.

With Z the measured and X the present `T_target_source`, a residual describes the motion Z^-1 X: the pose of the source
in the frame where the edge puts it.

In the plane it is that pose itself, x, y and heading, as in g2o and in GTSAM up to 4.2 (4.3 takes the logarithm).

In space it is the twist of that motion (its logarithm), translation first, as in GTSAM. The residual of g2o is the
translation and the vector part of the quaternion, to first order half the rotation vector. SE-Sync takes chords.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_mask, require_shape
from dpmjax.geometry import rigid, se2, se3
from dpmjax.geometry.traced import typed_jit
from dpmjax.pose_graph.graph import TANGENT_SIZE, Edges
from dpmjax.types import AnyArray


@typed_jit()
def residuals(
    poses: Float[AnyArray, "n *s"], edges: Edges, edge_mask: Bool[AnyArray, " e"] | None = None
) -> Float[Array, "e d"]:
    """Compares the relative poses of a graph with the measured ones.

    The cost of a graph, its chi2, is the sum of r^T W r over all edges, W the information. In the plane r
    is x, y, heading of `inverse(Z) @ X`; in space its twist (vx, vy, vz, wx, wy, wz). Metres and radians, in the frame
    in which the edge puts the source. Angles are at most half a turn, where the residual jumps.

    Args:
        poses: `T_world_node`; (n, 3) x, y, heading in the plane, (n, 4, 4) in space.
        edges: measured relative poses, arrays of NumPy or JAX.
        edge_mask: False for padding edges, which may hold anything; their residuals are zero.

    Returns:
        (e, 3) or (e, 6), in the widest dtype of poses and measurements.

    Raises:
        ValueError: the shapes do not match.

    >>> import numpy as np
    >>> edges = Edges(np.array([1]), np.array([0]), np.array([[1.0, 0.0, 0.5]]), np.eye(3)[None])
    >>> residuals(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.75]]), edges).tolist()
    [[0.0, 0.0, 0.25]]
    """
    return _log(_differences(*as_arrays(poses, edges, edge_mask))[0])


def as_arrays(
    poses: Float[AnyArray, "n *s"], edges: Edges, edge_mask: Bool[AnyArray, " e"] | None
) -> tuple[Array, Edges]:
    """Makes JAX arrays of one float type, in which padding holds numbers that change no result.

    Padding edges join node 0 to itself without information. Nodes without an edge are at the origin.

    Args:
        poses: `T_world_node`.
        edges: measured relative poses.
        edge_mask: False for padding edges.

    Returns:
        Poses and edges.

    Raises:
        ValueError: the shapes do not match.
    """
    poses, measured, information = (
        as_float(name, value)
        for name, value in (
            ("poses", poses),
            ("measurements", edges.measurements),
            ("information", edges.information),
        )
    )
    source, target = jnp.asarray(edges.source), jnp.asarray(edges.target)
    pose, count = poses.shape[1:], source.shape[:1]
    if pose not in TANGENT_SIZE or len(poses) == 0:
        raise ValueError(f"poses: expected shape (n, 3) or (n, 4, 4), n >= 1, got {poses.shape}")
    size = TANGENT_SIZE[pose]
    require_shape("source", source, count)
    require_shape("target", target, count)
    require_shape("measurements", measured, (*count, *pose))
    require_shape("information", information, (*count, size, size))
    dtype = jnp.result_type(poses, measured, information)
    mask = as_mask("edge_mask", edge_mask, count)
    identity = jnp.zeros(3, dtype) if size == 3 else jnp.eye(4, dtype=dtype)
    measured = jnp.where(mask.reshape(-1, *[1] * len(pose)), measured.astype(dtype), identity)
    information = jnp.where(mask[:, None, None], information.astype(dtype), 0)
    source, target = (jnp.where(mask, rows, 0) for rows in (source, target))
    arrays: Any = source, target, measured, information  # the record is typed for the host
    edges = Edges(*arrays)
    return jnp.where(joined_nodes(poses, edges), poses.astype(dtype), identity), edges


def joined_nodes(poses: Array, edges: Edges) -> Bool[Array, "n *s"]:
    """Returns True for nodes that an edge joins to another one; the axes after the first have size one.

    Args:
        poses: `T_world_node`; only its shape is used.
        edges: of JAX; a padding edge joins a node to itself.

    Returns:
        The mask, which broadcasts with the poses.
    """
    is_edge = edges.source != edges.target
    is_joined = jnp.zeros(len(poses), bool).at[edges.source].max(is_edge).at[edges.target].max(is_edge)
    return is_joined.reshape(-1, *[1] * (poses.ndim - 1))


def normal_blocks(
    poses: Float[Array, "n *s"], edges: Edges
) -> tuple[Float[Array, " e"], Float[Array, "e 2 2 d d"], Float[Array, "e 2 d"]]:
    """Linearises all edges by steps of their poses, `T_world_node @ exp(step)`; target first, then source.

    Args:
        poses: `T_world_node`, of JAX.
        edges: of JAX.

    Returns:
        r^T W r, J^T W J and J^T W r of each edge.
    """
    is_planar = poses.ndim == 2
    difference, relative = _differences(poses, edges)
    residual, of_source = _log(difference), _log_jacobian(difference)
    adjoint = (se2 if is_planar else se3).adjoint((se2 if is_planar else rigid).inverse(relative))
    with jax.default_matmul_precision("highest"):
        jacobian = jnp.stack([-of_source @ adjoint, of_source], axis=1)
        weighted = jnp.einsum("eij,esjk->esik", edges.information, jacobian)
        blocks = jnp.einsum("eski,etkj->estij", jacobian, weighted)
        gradient = jnp.einsum("eski,ek->esi", weighted, residual)
        chi2 = jnp.einsum("ei,eij,ej->e", residual, edges.information, residual)
    return chi2, blocks, gradient


def move(poses: Array, step: Float[Array, "n d"]) -> Array:
    """Moves poses by steps in their own frames.

    Args:
        poses: `T_world_node`, of JAX.
        step: the steps; in the plane x, y, heading, in space twists.

    Returns:
        `T_world_node`.
    """
    return se2.compose(poses, step) if poses.ndim == 2 else rigid.matmul(poses, rigid.exp(step))


def _differences(poses: Array, edges: Edges) -> tuple[Array, Array]:
    """Returns Z^-1 X and X, the poses of the sources in the frames of the targets."""
    relative = _relative(poses[edges.target], poses[edges.source])
    return _relative(jnp.asarray(edges.measurements), relative), relative


def _relative(target: Array, source: Array) -> Array:
    """Returns the poses of the sources in the frames of the targets."""
    return se2.relative(target, source) if source.ndim == 2 else rigid.matmul(rigid.inverse(target), source)


def _log(difference: Array) -> Float[Array, "e d"]:
    """Returns the residual of a motion."""
    return difference if difference.ndim == 2 else se3.log(difference)


def _log_jacobian(difference: Array) -> Float[Array, "e d d"]:
    """Returns the derivative of the residual by a step of the source, at zero."""
    if difference.ndim == 3:
        return se3.log_jacobian(difference)
    heading = jnp.zeros_like(difference).at[:, 2].set(difference[:, 2])
    return se2.to_matrix(heading)
