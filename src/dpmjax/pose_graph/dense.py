"""A pure solver for small pose graphs of fixed shape: dense Levenberg-Marquardt with an implicit gradient.

It minimises the cost that `optimize_pose_graph` minimises without a kernel, from the given poses alone. Time and memory
of a step grow with the third and second power of the number of nodes.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_mask, require_count
from dpmjax.geometry.traced import solution_tangent, typed_jit, with_axes_of
from dpmjax.pose_graph.graph import Edges
from dpmjax.pose_graph.residuals import as_arrays, joined_nodes, move, normal_blocks
from dpmjax.types import AnyArray

# Levenberg-Marquardt damping at the start, as a share of the diagonal, and its limit.
_FIRST_DAMPING, _MOST_DAMPING = 1e-6, 1e6
# Damping above which a small step is no sign of the minimum.
_MOST_DAMPING_AT_END = 1e-3
# Below this share of the stiffest diagonal entry, damping goes by the stiffest entry.
_LEAST_STIFFNESS = 1e-6


class DenseSolution(NamedTuple):
    """Result of `solve_dense`.

    Attributes:
        poses: `T_world_node`, in the form of the given poses.
        chi2: sum of r^T W r over all edges at these poses.
        converged: True where a step became smaller than half of the digits.
    """

    poses: Float[Array, "n *s"]
    chi2: Float[Array, ""]
    converged: Bool[Array, ""]


@typed_jit("num_steps")
def solve_dense(
    poses: Float[AnyArray, "n *s"],
    edges: Edges,
    *,
    is_fixed: Bool[AnyArray, " n"] | None = None,
    edge_mask: Bool[AnyArray, " e"] | None = None,
    num_steps: int = 20,
) -> DenseSolution:
    """Finds the poses that agree best with the measured relative poses; all shapes and the number of steps are static.

    Padding nodes are those without a valid edge. They stay, and may hold anything.

    The gradient is that of the solution, by the implicit function theorem, so it is right where `converged` is True.
    It has derivatives by measurements, by information and by the poses of fixed nodes. The derivatives by initial poses
    of free nodes, and along motions that no edge measures, are zero.

    Args:
        poses: initial `T_world_node`; (n, 3) x, y, heading in the plane, (n, 4, 4) in space.
        edges: measured relative poses, arrays of NumPy or JAX.
        is_fixed: nodes that stay; the first one by default. One in each connected part makes the solution unique.
        edge_mask: False for padding edges, which may hold anything.
        num_steps: number of linear solves; static under `jit`.

    Returns:
        The poses, their cost, and True where the steps have converged.

    Raises:
        ValueError: the shapes do not match, or `num_steps` is below 1.

    >>> import numpy as np
    >>> measured = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.3, 0.0, 0.0]])
    >>> edges = Edges(np.array([1, 2, 2]), np.array([0, 1, 0]), measured, np.tile(np.eye(3), (3, 1, 1)))
    >>> solve_dense(np.zeros((3, 3)), edges).poses[:, 0].round(3).tolist()
    [0.0, 1.100000023841858, 2.200000047683716]
    """
    require_count("num_steps", num_steps)
    start, edges = as_arrays(poses, edges, edge_mask)
    fixed = jnp.arange(len(poses)) == 0 if is_fixed is None else as_mask("is_fixed", is_fixed, (len(poses),))
    found, converged = _solve(num_steps, start, edges, fixed)
    chi2 = normal_blocks(found, edges)[0].sum()
    poses = jnp.where(joined_nodes(start, edges), found, as_float("poses", poses))
    return DenseSolution(poses, chi2, converged > 0)


class _State(NamedTuple):
    """The poses between two steps, and the graph linearised there.

    Attributes:
        poses: `T_world_node`.
        cost: their chi2.
        blocks: (e, 2, 2, d, d) J^T W J of each edge.
        gradient: (n, d) J^T W r of all edges.
    """

    poses: Array
    cost: Array
    blocks: Array
    gradient: Array


def _linearised(poses: Array, edges: Edges) -> _State:
    chi2, blocks, gradient = normal_blocks(poses, edges)
    return _State(poses, chi2.sum(), blocks, _per_node(gradient, edges, len(poses)))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(num_steps: int, poses: Array, edges: Edges, is_fixed: Array) -> tuple[Array, Array]:
    """Returns the poses after all steps, and 1.0 where they have converged: the tangent of a float has its axes."""
    now = _linearised(poses, edges)
    # The loop's state depends on all arguments from the start, so that its type stays the same under `shard_map`.
    now = now._replace(poses=move(poses, 0 * now.gradient * ~is_fixed[:, None]))
    damping = _FIRST_DAMPING + 0 * now.cost

    def iterate(carry: tuple[_State, Array, Array], _: None) -> tuple[tuple[_State, Array, Array], None]:
        now, damping, converged = carry
        step = _damped_step(now, damping, edges, is_fixed)
        trial = _linearised(move(now.poses, step), edges)
        converged |= (damping < _MOST_DAMPING_AT_END) & _is_small(step, edges)
        # The cost is flat at the minimum: a small step improves the poses although the cost rises by its rounding.
        rounding = jnp.where(converged, jnp.sqrt(jnp.finfo(damping.dtype).eps), 0)
        is_better = trial.cost <= (1 + rounding) * now.cost
        less = jnp.maximum(0.1 * damping, jnp.finfo(damping.dtype).eps)
        more = jnp.where(converged, damping, jnp.minimum(10 * damping, _MOST_DAMPING))
        kept = jax.tree.map(partial(jnp.where, is_better), trial, now)
        return (kept, jnp.where(is_better, less, more), converged), None

    (last, _, converged), _ = jax.lax.scan(iterate, (now, damping, now.cost < 0), length=num_steps)
    return last.poses, converged.astype(last.cost.dtype)


def _damped_step(now: _State, damping: Array, edges: Edges, is_fixed: Array) -> Float[Array, "n d"]:
    """Solves the normal equations, scaled so that their diagonal is one; fixed nodes and those without edges stay."""
    num_nodes, axes = now.gradient.shape
    ends = jnp.stack([edges.target, edges.source], axis=1)
    matrix = jnp.zeros((num_nodes, num_nodes, axes, axes), now.cost.dtype)
    matrix = matrix.at[ends[:, :, None], ends[:, None]].add(now.blocks)
    is_free = jnp.repeat(~is_fixed, axes)
    matrix = jnp.swapaxes(matrix, 1, 2).reshape(len(is_free), len(is_free)) * is_free * is_free[:, None]
    diagonal = jnp.diagonal(matrix)
    floor = jnp.maximum(_LEAST_STIFFNESS * diagonal.max(), jnp.finfo(matrix.dtype).tiny)
    scale = 1 / jnp.sqrt(jnp.maximum(diagonal, floor))
    damped = matrix * scale * scale[:, None] + damping * jnp.eye(len(scale), dtype=matrix.dtype)
    right = -scale * is_free * now.gradient.reshape(-1)
    step = scale * jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(damped), right)
    return step.reshape(num_nodes, axes)


def _per_node(gradient: Float[Array, "e 2 d"], edges: Edges, num_nodes: int) -> Float[Array, "n d"]:
    """Sums the vectors of all edges at their nodes."""
    summed = jnp.zeros((num_nodes, gradient.shape[-1]), gradient.dtype).at[edges.target].add(gradient[:, 0])
    return summed.at[edges.source].add(gradient[:, 1])


def _is_small(step: Float[Array, "n d"], edges: Edges) -> Bool[Array, ""]:
    """Returns True for steps below half of the digits of the longest measurement, and of a radian."""
    dim = 2 if step.shape[1] == 3 else 3
    translations = edges.measurements[:, :2] if dim == 2 else edges.measurements[:, :3, 3]
    resolution = jnp.sqrt(jnp.finfo(step.dtype).eps)
    is_short = jnp.abs(step[:, :dim]).max() <= resolution * jnp.abs(translations).max(initial=0)
    return is_short & (jnp.abs(step[:, dim:]).max() <= resolution)


@_solve.defjvp
def _solve_jvp(num_steps: int, primals: Any, tangents: Any) -> tuple[tuple[Array, Array], Any]:
    # The gradient of the cost is the balance that is zero at the solution.
    poses, edges, is_fixed = primals
    found, converged = _solve(num_steps, *primals)
    axes = edges.information.shape[-1]
    is_held = is_fixed.reshape(-1, *[1] * (poses.ndim - 1))

    def moved(step: Array, given: Array) -> Array:
        step = jnp.where(is_fixed[:, None], 0, step.reshape(len(poses), axes))
        return move(jnp.where(is_held, given, found), step)

    at = normal_blocks(found, edges)[1]
    stiffness = _per_node(jnp.einsum("essii->esi", at), edges, len(poses)).reshape(-1)
    # All directions have one unit, so that one share tells open ones from weak ones.
    scale = 1 / jnp.sqrt(jnp.where(stiffness > 0, stiffness, 1))

    def balance(step: Array, given: Array, measurements: Array, information: Array) -> Array:
        changed = edges._replace(measurements=measurements, information=information)
        pull = _per_node(normal_blocks(moved(scale * step, given), changed)[2], edges, len(poses))
        return scale * jnp.where(is_fixed[:, None], 0, pull).reshape(-1)

    step = scale * solution_tangent(
        balance,
        (poses, edges.measurements, edges.information),
        (tangents[0], tangents[1].measurements, tangents[1].information),
        num_unknowns=len(scale),
        open_share=20 * float(jnp.finfo(scale.dtype).eps),
    )
    _, moving = jax.jvp(moved, (jnp.zeros_like(step), poses), (step, tangents[0]))
    return (found, converged), (moving, with_axes_of(converged, jnp.zeros_like(converged)))
