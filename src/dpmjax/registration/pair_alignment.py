"""Robust alignment of pairs of planar scans, many at once: the kernel under the warm start, loop search and polish.

A pose is a vector (x, y, heading). Errors of a pair are linearised in the tangent space of T_target_source on the
right, T_target_source @ exp(delta), so that a pair costs a 3 x 3 matrix and a 3-vector whoever asks.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.geometry.neighbours import k_nearest
from dpmjax.registration.line_fitting import LineScans
from dpmjax.types import AnyArray

# GPUs multiply in TF32 unless told otherwise: centimetres at a hundred metres.
_matmul = partial(jnp.matmul, precision="highest")

Metric = Literal["point", "plane"]


class PairSystem(NamedTuple):
    """Gauss-Newton system of one pair at one relative pose.

    Attributes:
        information: J^T W J in the tangent (dx, dy, dheading) of the source frame.
        gradient: J^T W r.
        weight: sum of the robust weights, at most the number of source beams.
        squares: weighted sum of squared residuals.
    """

    information: Float[Array, "3 3"]
    gradient: Float[Array, " 3"]
    weight: Float[Array, ""]
    squares: Float[Array, ""]


def rotation_of(heading: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Matrix of a heading."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])


def linearise_pair(
    source: LineScans,
    target: LineScans,
    pose_target_source: Float[Array, " 3"],
    gate: Float[Array, ""],
    kernel: Float[Array, ""],
    *,
    metric: Metric,
) -> PairSystem:
    """Pairs every source beam with its nearest target beam and linearises the distances.

    Args:
        source: one scan, (b, 2) arrays.
        target: one scan.
        pose_target_source: relative pose (x, y, heading).
        gate: pairs farther apart than this do not count, in the unit of the points.
        kernel: scale of the Geman-McClure weight on the residual.
        metric: distance to the target's line ("plane") or to its nearest point.

    Returns:
        PairSystem at this pose.
    """
    rotation = rotation_of(pose_target_source[2])
    points = _matmul(source.points, rotation.T) + pose_target_source[:2]
    nearest = k_nearest(points, target.points, 1, mask=target.mask).indices[:, 0]
    matched, normals = target.points[nearest], target.normals[nearest]
    faces_same_way = (_matmul(source.normals, rotation.T) * normals).sum(-1) > 0.7
    near = ((points - matched) ** 2).sum(-1) < gate**2
    counts = source.mask & target.mask[nearest] & near & faces_same_way
    lever = _matmul(jnp.stack([-source.points[:, 1], source.points[:, 0]], -1), rotation.T)
    if metric == "plane":
        residual = (normals * (points - target.centroids[nearest])).sum(-1)
        jacobian = jnp.concatenate([_matmul(normals, rotation), (normals * lever).sum(-1, keepdims=True)], -1)
        squared = residual**2
        jacobian, residual = jacobian[:, None], residual[:, None]
    else:
        residual = points - matched
        frame = jnp.broadcast_to(rotation, (points.shape[0], 2, 2))
        jacobian = jnp.concatenate([frame, lever[..., None]], -1)
        squared = (residual**2).sum(-1)
    weight = jnp.where(counts, (kernel**2 / (kernel**2 + squared)) ** 2, 0.0)
    weighted = weight[:, None, None] * jacobian
    return PairSystem(
        information=jnp.einsum("bki,bkj->ij", weighted, jacobian, precision="highest"),
        gradient=jnp.einsum("bki,bk->i", weighted, residual, precision="highest"),
        weight=weight.sum(),
        squares=(weight * squared).sum(),
    )


def move(pose: Float[Array, " 3"], delta: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """The pose after a small step in its own frame (first order: the step is a few percent of the pose)."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return pose + jnp.stack([c * delta[0] - s * delta[1], s * delta[0] + c * delta[1], delta[2]])


class StepPrior(NamedTuple):
    """What is believed of relative poses before a beam is compared; it decides where the scans leave a direction open.

    Attributes:
        mean: expected relative pose (x, y, heading).
        information: inverse variances of its three parts, in units of one beam's information; zero: no belief.
    """

    mean: Float[AnyArray, "... 3"]
    information: Float[AnyArray, "... 3"]


def _solve(system: PairSystem, pose: Float[Array, " 3"], prior: StepPrior) -> Float[Array, " 3"]:
    """The step that the scans and the belief ask for together."""
    offset = pose - prior.mean
    turn = offset.at[2].set(jnp.arctan2(jnp.sin(offset[2]), jnp.cos(offset[2])))
    rotation = jnp.eye(3).at[:2, :2].set(rotation_of(pose[2]))
    pull = _matmul(rotation.T, prior.information * turn)
    belief = _matmul(rotation.T, prior.information[:, None] * rotation)
    # Damping in proportion to each axis: a pair that fixes one direction only (a corridor) moves in that one alone.
    diagonal = jnp.diagonal(system.information)
    damping = 1e-3 * diagonal + 1e-6 * diagonal.max() + 1e-9
    return jnp.linalg.solve(system.information + belief + jnp.diag(damping), -system.gradient - pull)


@partial(jax.jit, static_argnames=("metric",))
def align_pairs(
    source: LineScans,
    target: LineScans,
    guesses: Float[Array, "p 3"],
    gates: Float[Array, " t"],
    kernels: Float[Array, " t"],
    prior: StepPrior,
    *,
    metric: Metric = "plane",
) -> tuple[Float[Array, "p 3"], PairSystem]:
    """Iterated closest point for many pairs at once.

    Args:
        source: scans (p, b, 2), one for each pair.
        target: scans (p, c, 2).
        guesses: where to start, x, y, heading of T_target_source.
        gates: largest distance of matched points in each iteration.
        kernels: scale of the robust weight in each iteration.
        prior: belief in each relative pose (p, 3).
        metric: "point" or "plane".

    Returns:
        The aligned relative poses and each pair's system there; its `information` and `weight` tell how well it is
        fixed.
    """

    def align(
        source: LineScans, target: LineScans, guess: Float[Array, " 3"], prior: StepPrior
    ) -> tuple[Array, PairSystem]:
        def iterate(pose: Array, scales: tuple[Array, Array]) -> tuple[Array, None]:
            system = linearise_pair(source, target, pose, *scales, metric=metric)
            return move(pose, _solve(system, pose, prior)), None

        pose, _ = jax.lax.scan(iterate, guess, (gates, kernels))
        return pose, linearise_pair(source, target, pose, gates[-1], kernels[-1], metric=metric)

    return jax.vmap(align)(source, target, guesses, prior)
