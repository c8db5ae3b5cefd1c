"""Robust alignment of many pairs of planar scans at once, for incremental ICP, loop search and refinement.

A pose is a vector (x, y, heading). Errors of a pair are linearised in the tangent space of T_target_source on the
right, T_target_source @ exp(delta). So every pair costs a 3 x 3 matrix and a 3-vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dpmjax.geometry import se2
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.kept_programs import kept_jit
from dpmjax.scan.planar.record import Floats, Indices, Lines, PlanarScans, batches
from dpmjax.types import AnyArray

# Number of distances of one batch of pairs, few enough for the cache, and the largest number of pairs in it.
_LIVE_DISTANCES, _MAX_BATCH = 1 << 22, 256

Metric = Literal["point", "plane"]


@dataclass(frozen=True)
class Schedule:
    """Search distances of a matching, which shrink from iteration to iteration, in typical ranges of the scans.

    Attributes:
        gate: largest distance of matched points, first and last iteration.
        kernel: scale of the robust weight, first and last iteration; never below twice the range noise.
        num_iterations: number of iterations of Gauss-Newton.
        source_beams: approximate number of used beams of the source, evenly spread; None: all.
        target_beams: the same for the target.
    """

    gate: tuple[float, float]
    kernel: tuple[float, float]
    num_iterations: int
    source_beams: int | None = None
    target_beams: int | None = None

    def gates_and_kernels(self, typical_range: float, noise: float) -> Floats:
        """Returns gate and kernel (i, 2) of the iterations in the unit of the points, bounded by the range noise."""
        scales = typical_range * np.stack([np.geomspace(*x, self.num_iterations) for x in (self.gate, self.kernel)], 1)
        return np.maximum(scales, np.array([4.0, 2.0]) * noise)

    def source_share(self, scans: PlanarScans) -> float:
        """Returns the share of used beams of these sources."""
        return 1.0 / _stride(scans, self.source_beams)


COARSE = Schedule(gate=(0.18, 0.045), kernel=(0.09, 0.0225), num_iterations=8, source_beams=60)
FINE = Schedule(gate=(0.075, 0.0225), kernel=(0.0225, 0.00225), num_iterations=12)


# Of many guesses, this share is aligned further after some iterations, at least the second number.
_KEPT_SHARE, _LEAST_KEPT, _FIRST_ITERATIONS = 0.25, 4, 3


def _thinned(scans: PlanarScans, num_beams: int | None) -> Lines:
    """Returns about `num_beams` beams of each scan."""
    return scans.lines(stride=_stride(scans, num_beams))


def _stride(scans: PlanarScans, num_beams: int | None) -> int:
    return max(1, round(scans.mask.shape[1] / (num_beams or scans.mask.shape[1])))


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


def fan(turns: Sequence[float] | Floats, radii: Sequence[float] = (0.0,), num_ways: int = 1) -> Floats:
    """Returns guesses (h, 3) of a motion: all turns, each with shifts by `radii` in `num_ways` directions."""
    ways = 2 * np.pi * np.arange(num_ways) / num_ways
    shifts = [(r * np.cos(w), r * np.sin(w)) for r in radii for w in (ways if r else ways[:1])]
    return np.array([(x, y, turn) for turn in turns for x, y in shifts])


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
    source: Lines, target: Lines, pose: Float[Array, " 3"], scale: Float[Array, " 2"], *, metric: Metric
) -> PairSystem:
    """Pairs every source beam with its nearest target beam and linearises the distances.

    Args:
        source: one scan, (b, 2) arrays.
        target: one scan.
        pose: T_target_source (x, y, heading).
        scale: gate and kernel, in the unit of the points. Pairs farther apart than the gate do not count. The kernel is
            the scale of the Geman-McClure weight on the residual.
        metric: distance to the target's line ("plane") or to its nearest point.

    Returns:
        PairSystem at this pose.
    """
    (gate, kernel), cos, sin = scale, jnp.cos(pose[2]), jnp.sin(pose[2])
    points = se2.transform_points(pose, source.points)
    nearest = k_nearest(points, target.points, 1, mask=target.mask).indices[:, 0]
    (x, y), (matched_x, matched_y), (normal_x, normal_y) = points.T, target.points[nearest].T, target.normals[nearest].T
    source_x, source_y = source.normals[:, 0], source.normals[:, 1]
    cosine = (cos * source_x - sin * source_y) * normal_x + (sin * source_x + cos * source_y) * normal_y
    is_near = (x - matched_x) ** 2 + (y - matched_y) ** 2 < gate**2
    counts = source.mask & target.mask[nearest] & is_near & (cosine > 0.7)
    # Distances along the normal to the line, or along both axes to the point.
    if metric == "plane":
        goal_x, goal_y = target.centroids[nearest].T
        axes = [(normal_x, normal_y)]
    else:
        goal_x, goal_y, zero = matched_x, matched_y, jnp.zeros_like(x)
        axes = [(zero + 1.0, zero), (zero, zero + 1.0)]
    residuals = [(x - goal_x) * axis_x + (y - goal_y) * axis_y for axis_x, axis_y in axes]
    squared = sum(residual**2 for residual in residuals)
    weight = jnp.where(counts, (kernel**2 / (kernel**2 + squared)) ** 2, 0.0)
    information, gradient = jnp.zeros((3, 3), pose.dtype), jnp.zeros(3, pose.dtype)
    # Sums of products, because products of small matrices are slow on a CPU.
    for residual, (axis_x, axis_y) in zip(residuals, axes, strict=True):
        lever = (x - pose[0]) * axis_y - (y - pose[1]) * axis_x
        jacobian = jnp.stack([axis_x * cos + axis_y * sin, axis_y * cos - axis_x * sin, lever])
        weighted = weight * jacobian
        information += (weighted[:, None] * jacobian).sum(-1)
        gradient += (weighted * residual).sum(-1)
    return PairSystem(information, gradient, weight.sum())


@kept_jit("metric")
def _linearise(
    source: Lines, target: Lines, poses: Float[Array, "p 3"], scale: Float[Array, " 2"], *, metric: Metric
) -> PairSystem:
    return jax.vmap(partial(linearise_pair, metric=metric), in_axes=(0, 0, 0, None))(source, target, poses, scale)


def _step(system: PairSystem, poses: Floats, prior: PairPrior | None) -> Floats:
    """Computes the poses (p, 3) after a Gauss-Newton step of the scans and the prior together."""
    information, gradient = (np.asarray(x, np.float64) for x in system[:2])
    # Damping in proportion to each axis: a pair in a corridor moves along its constrained direction alone.
    diagonal = np.einsum("pii->pi", information)
    damping = 1e-3 * diagonal + 1e-6 * diagonal.max(axis=1, keepdims=True) + 1e-9
    matrix = information + damping[:, None] * np.eye(3)
    turn = np.zeros((len(poses), 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = se2.rotation(poses[:, 2]), 1.0
    if prior is not None:
        offset = poses - prior.mean
        offset[:, 2] = se2.wrap_angle(offset[:, 2])
        weighted = prior.information[..., None] * turn
        matrix = matrix + np.swapaxes(turn, 1, 2) @ weighted
        gradient = gradient + np.einsum("pij,pi->pj", weighted, offset)
    return np.asarray(poses - np.einsum("pij,pj->pi", turn, np.linalg.solve(matrix, gradient[..., None])[..., 0]))


class _Aligned(NamedTuple):
    """Poses (t, 3) of aligned pairs and their systems, on the host."""

    poses: Floats
    information: Floats
    gradient: Floats
    weight: Floats


def _align_batches(
    pairs: tuple[Lines, Lines], rows: tuple[Indices, Indices], guesses: Floats, prior: PairPrior | None, scales: Floats,
    *, metric: Metric = "plane",
) -> _Aligned:  # fmt: skip
    """Aligns t pairs, rows of the sources and of the targets, in batches of one shape."""
    # Gate and kernel of the last row of `scales` (i, 2) are those of the result: with one row, no pair moves.
    found = _Aligned(*(np.zeros((len(guesses), *size)) for size in ((3,), (3, 3), (3,), ())))
    batch = _LIVE_DISTANCES // (pairs[0].mask.shape[1] * pairs[1].mask.shape[1])
    for part, some in batches(len(guesses), 1 << int(np.log2(np.clip(batch, 1, _MAX_BATCH)))):
        source, target = (
            Lines(*(jax.device_put(x[end[some]]) for x in lines)) for lines, end in zip(pairs, rows, strict=True)
        )
        belief = None if prior is None else PairPrior(*(x[some] for x in prior))
        poses = guesses[some]
        for number, scale in enumerate(scales.astype(np.float32)):
            system = _linearise(source, target, poses.astype(np.float32), scale, metric=metric)
            if number < len(scales) - 1:
                poses = _step(system, poses, belief)
        for kept, values in zip(found, (poses, *system), strict=True):
            kept[part] = np.asarray(values)[: part.stop - part.start]
    return found


def linearise_pairs(
    scans: PlanarScans, source: Indices, target: Indices, poses: Floats, scale: Floats, *, stride: int = 1
) -> tuple[Floats, Floats]:
    """Linearises p pairs of scans at T_target_source.

    Args:
        scans: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source.
        scale: gate and kernel, as `linearise_pair`.
        stride: every `stride`-th beam of the sources is used.

    Returns:
        Information (p, 3, 3) and gradient (p, 3).
    """
    lines = scans.lines(stride=stride), scans.lines()
    found = _align_batches(lines, (source, target), poses, None, np.asarray(scale)[None])
    return found.information, found.gradient


def match_pairs(
    source: PlanarScans, target: PlanarScans, guesses: Floats, schedule: Schedule, prior: PairPrior | None = None,
    *, metric: Metric = "plane",
) -> PairMatches:  # fmt: skip
    """Aligns source scan p to target scan p from each guess, and keeps the best result.

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
    scales = schedule.gates_and_kernels(source.typical_range, source.noise)
    scales = np.concatenate([scales, scales[-1:]])
    lines = _thinned(source, schedule.source_beams), _thinned(target, schedule.target_beams)
    row = np.arange(len(guesses))[:, None]
    if guesses.shape[1] > 2 * _LEAST_KEPT:
        rough = _align_guesses(lines, guesses, prior, scales[: _FIRST_ITERATIONS + 1], metric)
        count = max(_LEAST_KEPT, int(np.ceil(_KEPT_SHARE * guesses.shape[1])))
        guesses = rough.poses[row, np.argsort(-rough.weight, axis=1, kind="stable")[:, :count]]
        scales = scales[_FIRST_ITERATIONS:]
    found = _align_guesses(lines, guesses, prior, scales, metric)
    best = found.weight.argmax(axis=1)
    poses, information, _, weight = (x[row[:, 0], best] for x in found)
    num_beams = np.maximum(np.minimum(lines[0].mask.sum(1), lines[1].mask.sum(1)), 1)
    return PairMatches(poses, np.asarray(weight / num_beams, np.float64), information)


def _align_guesses(
    lines: tuple[Lines, Lines], guesses: Floats, prior: PairPrior | None, scales: Floats, metric: Metric
) -> _Aligned:
    """Aligns each pair from each of its guesses (p, h, 3); arrays of the result are (p, h, ...)."""
    rows = np.repeat(np.arange(len(guesses)), guesses.shape[1])
    belief = None if prior is None else PairPrior(*(np.asarray(x)[rows] for x in prior))
    found = _align_batches(lines, (rows, rows), guesses.reshape(-1, 3), belief, scales, metric=metric)
    return _Aligned(*(x.reshape(*guesses.shape[:2], *x.shape[1:]) for x in found))
