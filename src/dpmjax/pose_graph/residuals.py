"""Residuals of the edges and their derivatives on the tangent space, in JAX with 64-bit floats.

Poses move on the right, T_world_node @ exp(delta). The residual of an edge is the logarithm of the motion from the
measured to the present relative pose, translation first, in the tangent of the source frame. GTSAM uses the same.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.geometry import rigid, se2, se3
from dpmjax.pose_graph.graph import Edges, Floats


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


def linearise(poses: Floats, step: Floats, edges: Edges) -> Linearisation:
    """Moves the poses and linearises all edges there.

    The numbers of nodes and edges are rounded up to powers of two, so that few programs are compiled.

    Args:
        poses: (n, 3) or (n, 4, 4).
        step: (n, 3) or (n, 6) steps in the frame of each pose.
        edges: measured relative poses.

    Returns:
        The edges at the moved poses.
    """
    num_nodes, num_edges = len(poses), len(edges.source)
    to_nodes, to_edges = _round_up(num_nodes) - num_nodes, _round_up(num_edges) - num_edges
    identity = np.zeros((1, 3)) if poses.ndim == 2 else np.eye(4)[None]
    padded = Edges(
        np.append(edges.source, np.zeros(to_edges, np.int64)),
        np.append(edges.target, np.zeros(to_edges, np.int64)),
        np.concatenate([edges.measurements, np.repeat(identity, to_edges, axis=0)]),
        np.concatenate([edges.information, np.zeros((to_edges, *edges.information.shape[1:]))]),
    )
    poses = np.concatenate([poses, np.repeat(identity, to_nodes, axis=0)])
    step = np.concatenate([step, np.zeros((to_nodes, step.shape[1]))])
    with jax.enable_x64(True):
        moved, *of_edges = (np.asarray(x) for x in _linearise(poses, step, padded))
    return Linearisation(moved[:num_nodes], *(x[:num_edges] for x in of_edges))


def _round_up(count: int) -> int:
    return 1 << max(count - 1, 15).bit_length()


@jax.jit
def _linearise(poses: Array, step: Array, edges: Edges) -> tuple[Array, Array, Array, Array]:
    poses = _retract(poses, step)
    relative = _relative(poses[edges.target], poses[edges.source])
    residual, of_source = _residuals(relative, jnp.asarray(edges.measurements))
    adjoint = se2.adjoint(se2.inverse(relative)) if poses.ndim == 2 else se3.adjoint(rigid.inverse(relative))
    with jax.default_matmul_precision("highest"):
        jacobian = jnp.stack([-of_source @ adjoint, of_source], axis=1)
        weighted = jnp.einsum("eij,esjk->esik", edges.information, jacobian)
        blocks = jnp.einsum("eski,etkj->estij", jacobian, weighted)
        gradient = jnp.einsum("eski,ek->esi", weighted, residual)
        chi2 = jnp.einsum("ei,eij,ej->e", residual, edges.information, residual)
    return poses, chi2, blocks, gradient


def _retract(poses: Float[Array, "n *s"], step: Float[Array, "n d"]) -> Float[Array, "n *s"]:
    if poses.ndim == 2:
        return se2.compose(poses, step)
    return rigid.compose(poses, se3.exp(step))


def _relative(target: Float[Array, "e *s"], source: Float[Array, "e *s"]) -> Float[Array, "e *s"]:
    if source.ndim == 2:
        return se2.relative(target, source)
    return rigid.compose(rigid.inverse(target), source)


def _residuals(relative: Array, measured: Array) -> tuple[Float[Array, "e d"], Float[Array, "e d d"]]:
    """Returns residuals, and their derivatives by steps of the source poses."""
    algebra = se2 if relative.ndim == 2 else se3
    difference = _relative(measured, relative)
    return algebra.log(difference), algebra.log_jacobian(difference)
