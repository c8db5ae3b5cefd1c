"""Robust alignment of many pairs of planar scans at once, for incremental ICP, loop search and refinement.

A pose is a vector (x, y, heading). Errors of a pair are linearised in the tangent space of T_target_source on the
right, T_target_source @ exp(delta). So every pair costs a 3 x 3 matrix and a 3-vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.geometry import se2
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.registration2d.planar_scans import Floats, PlanarScans, batches
from dpmjax.types import AnyArray

# GPUs multiply in TF32 by default, with errors of centimetres at a hundred metres.
_matmul = partial(jnp.matmul, precision="highest")
# Largest number of distances of one batch of pairs: 128 MB of float32 with the temporaries of XLA.
_LIVE_DISTANCES = 1 << 24

Metric = Literal["point", "plane"]


@dataclass(frozen=True)
class Schedule:
    """Search distances of a matching, which shrink from iteration to iteration, in typical ranges of the scans.

    Attributes:
        gate: largest distance of matched points, first and last iteration.
        kernel: scale of the robust weight, first and last iteration; never below twice the range noise.
        num_iterations: iterations of Gauss-Newton.
        source_stride: every `source_stride`-th beam of the source is used.
        target_stride: every `target_stride`-th beam of the target is used.
    """

    gate: tuple[float, float]
    kernel: tuple[float, float]
    num_iterations: int
    source_stride: int = 1
    target_stride: int = 1

    def gates_and_kernels(self, typical_range: float, noise: float) -> tuple[jax.Array, jax.Array]:
        """Returns gate and kernel of each iteration in the unit of the points, bounded below by the range noise."""
        gates, kernels = (typical_range * np.geomspace(*x, self.num_iterations) for x in (self.gate, self.kernel))
        gates, kernels = np.maximum(gates, 4.0 * noise), np.maximum(kernels, 2.0 * noise)
        return jnp.asarray(gates, jnp.float32), jnp.asarray(kernels, jnp.float32)


COARSE = Schedule(gate=(0.18, 0.045), kernel=(0.09, 0.0225), num_iterations=8, source_stride=3)
FINE = Schedule(gate=(0.075, 0.0225), kernel=(0.0225, 0.00225), num_iterations=12)


class PairMatches(NamedTuple):
    """Aligned pairs (p) on the host.

    Attributes:
        poses: (p, 3) x, y, heading of T_target_source.
        fitness: (p,) robust share of matched beams, 0 to 1.
        information: (p, 3, 3) J^T W J in the source frame, one unit a beam.
    """

    poses: Floats
    fitness: Floats
    information: Floats

    def weakest_eigenvalue(self) -> Floats:
        """Computes the information (p,) along the least constrained direction of the translation, in beams."""
        return np.asarray(np.linalg.eigvalsh(self.information[:, :2, :2])[:, 0], np.float64)


class PairPrior(NamedTuple):
    """Prior of relative poses, which constrains the directions that the scans do not constrain.

    Attributes:
        mean: expected relative pose (x, y, heading).
        information: inverse variances of x, y and heading, in units of one beam's information; zero: no prior.
    """

    mean: Float[AnyArray, "... 3"]
    information: Float[AnyArray, "... 3"]


class PairSystem(NamedTuple):
    """Gauss-Newton system of one pair at one relative pose.

    Attributes:
        information: J^T W J in the tangent (dx, dy, dheading) of the source frame.
        gradient: J^T W r.
        weight: sum of the robust weights, at most the number of source beams.
    """

    information: Float[Array, "3 3"]
    gradient: Float[Array, " 3"]
    weight: Float[Array, ""]


def linearise_pair(
    source: PlanarScans, target: PlanarScans, pose: Float[Array, " 3"], scale: tuple[Array, Array], *, metric: Metric
) -> PairSystem:
    """Pairs every source beam with its nearest target beam and linearises the distances.

    Args:
        source: one scan, (b, 2) arrays.
        target: one scan.
        pose: T_target_source (x, y, heading).
        scale: gate and kernel, in the unit of the points: pairs farther apart than the gate do not count; the kernel is
            the scale of the Geman-McClure weight on the residual.
        metric: distance to the target's line ("plane") or to its nearest point.

    Returns:
        PairSystem at this pose.
    """
    (gate, kernel), rotation = scale, se2.rotation(pose[2])
    points = se2.transform_points(pose, source.points)
    nearest = k_nearest(points, target.points, 1, mask=target.is_on_line).indices[:, 0]
    matched, normals = target.points[nearest], target.normals[nearest]
    faces_same_way = (_matmul(source.normals, rotation.T) * normals).sum(-1) > 0.7
    near = ((points - matched) ** 2).sum(-1) < gate**2
    counts = source.is_on_line & target.is_on_line[nearest] & near & faces_same_way
    lever = _matmul(jnp.stack([-source.points[:, 1], source.points[:, 0]], -1), rotation.T)
    # Distances along the normal to the line, or along both axes to the point: (b, k, 2) and (b, 2).
    if metric == "plane":
        axes, goal = normals[:, None], target.centroids[nearest]
    else:
        axes, goal = jnp.broadcast_to(jnp.eye(2), (len(points), 2, 2)), matched
    residual = ((points - goal)[:, None] * axes).sum(-1)
    jacobian = jnp.concatenate([_matmul(axes, rotation), (axes * lever[:, None]).sum(-1, keepdims=True)], -1)
    weight = jnp.where(counts, (kernel**2 / (kernel**2 + (residual**2).sum(-1))) ** 2, 0.0)
    weighted = weight[:, None, None] * jacobian
    information = jnp.einsum("bki,bkj->ij", weighted, jacobian, precision="highest")
    gradient = jnp.einsum("bki,bk->i", weighted, residual, precision="highest")
    return PairSystem(information, gradient, weight.sum())


def _move(pose: Float[Array, " 3"], delta: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """Applies a small step in the frame of the pose, to first order."""
    return pose + jnp.append(_matmul(se2.rotation(pose[2]), delta[:2]), delta[2])


def _solve(system: PairSystem, pose: Float[Array, " 3"], prior: PairPrior) -> Float[Array, " 3"]:
    """Computes the Gauss-Newton step of the scans and the prior together."""
    offset = pose - prior.mean
    offset = offset.at[2].set(se2.wrap_angle(offset[2]))
    rotation = jnp.eye(3).at[:2, :2].set(se2.rotation(pose[2]))
    pull = _matmul(rotation.T, prior.information * offset)
    belief = _matmul(rotation.T, prior.information[:, None] * rotation)
    # Damping in proportion to each axis: a pair in a corridor moves along its constrained direction alone.
    diagonal = jnp.diagonal(system.information)
    damping = 1e-3 * diagonal + 1e-6 * diagonal.max() + 1e-9
    return jnp.linalg.solve(system.information + belief + jnp.diag(damping), -system.gradient - pull)


@partial(jax.jit, static_argnames="metric")
def _align(
    pairs: tuple[PlanarScans, PlanarScans, Array, PairPrior], scales: tuple[Array, Array], *, metric: Metric
) -> tuple[Float[Array, "p 3"], PairSystem]:
    """Aligns pairs (source, target, guess, prior) by ICP; `scales` are gate and kernel of each iteration."""

    def align(source: PlanarScans, target: PlanarScans, guess: Array, prior: PairPrior) -> tuple[Array, PairSystem]:
        def iterate(pose: Array, scale: tuple[Array, Array]) -> tuple[Array, None]:
            system = linearise_pair(source, target, pose, scale, metric=metric)
            return _move(pose, _solve(system, pose, prior)), None

        pose, _ = jax.lax.scan(iterate, guess, scales)
        return pose, linearise_pair(source, target, pose, (scales[0][-1], scales[1][-1]), metric=metric)

    return jax.vmap(align)(*pairs)


def match_pairs(
    source: PlanarScans, target: PlanarScans, guesses: Floats, schedule: Schedule, prior: PairPrior | None = None,
    *, metric: Metric = "plane",
) -> PairMatches:  # fmt: skip
    """Aligns source scan p to target scan p from each of its guesses and keeps the best.

    Args:
        source: p scans.
        target: p scans, or submaps with any number of points.
        guesses: (p, h, 3) initial relative poses T_target_source.
        schedule: search distances of the iterations.
        prior: prior of the relative poses, (p, 3) each; None: none.
        metric: distance to the target's lines ("plane") or points.

    Returns:
        PairMatches of the guess with the best fitness for each pair.
    """
    num_pairs, num_guesses = guesses.shape[:2]
    if not num_pairs:
        return PairMatches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3)))
    prior = prior or PairPrior(np.zeros((num_pairs, 3)), np.zeros((num_pairs, 3)))
    scales = schedule.gates_and_kernels(source.typical_range, source.noise)
    source, target = source.thin(schedule.source_stride), target.thin(schedule.target_stride)
    distances = num_guesses * source.mask.shape[1] * target.mask.shape[1]
    # A power of two whatever the number of pairs: calls of about the same size share one compiled program.
    batch = 1 << int(np.log2(np.clip(_LIVE_DISTANCES // distances, 1, max(2 * num_pairs - 1, 1))))
    poses, weight = np.zeros((num_pairs, num_guesses, 3)), np.zeros((num_pairs, num_guesses))
    information = np.zeros((num_pairs, num_guesses, 3, 3))
    for part, rows in batches(num_pairs, batch):
        repeated = np.repeat(rows, num_guesses)
        belief = PairPrior(*(np.asarray(x, np.float32)[repeated] for x in prior))
        start = guesses[rows].reshape(-1, 3).astype(np.float32)
        pairs = source.take(repeated), target.take(repeated), start, belief
        aligned, system = _align(pairs, scales, metric=metric)
        for kept, found in ((poses, aligned), (weight, system.weight), (information, system.information)):
            kept[part] = np.asarray(found).reshape(batch, *kept.shape[1:])[: part.stop - part.start]
    row, best = np.arange(num_pairs), weight.argmax(axis=1)
    num_beams = np.minimum(np.asarray(source.is_on_line.sum(1)), np.asarray(target.is_on_line.sum(1)))
    return PairMatches(poses[row, best], weight[row, best] / np.maximum(num_beams, 1), information[row, best])
