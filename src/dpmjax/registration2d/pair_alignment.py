"""Robust alignment of many pairs of planar scans at once, for incremental ICP, loop search and refinement.

A pose is a vector (x, y, heading). One program aligns a batch of pairs by `dpmjax.scans.align`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from dpmjax.geometry import se2
from dpmjax.kept_programs import kept_jit
from dpmjax.registration2d.planar_scans import Floats, Pairs, PlanarScans, batches
from dpmjax.scans.align import AlignedMotion, PairRule, Prior, align
from dpmjax.types import AnyArray, SurfaceElements

# Number of distances of one batch of pairs, few enough for the cache, and the largest number of pairs in it.
_LIVE_DISTANCES, _MAX_BATCH = 1 << 22, 256
# Largest number of steps: all schedules are padded to it, so that one program serves them.
_MAX_STEPS = 16
_RULE = PairRule(is_oriented=True, cosines=(0.699, 0.701), damping=1e-3)


@dataclass(frozen=True)
class Schedule:
    """Search distances of a matching, which shrink from iteration to iteration, in typical ranges of the scans.

    Attributes:
        gate: largest distance of matched points, first and last iteration.
        kernel: scale of the robust weight, first and last iteration; never below twice the range noise.
        num_iterations: iterations of Gauss-Newton.
        source_beams: about this number of beams of the source is used, evenly spread; None: all.
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
        """Returns the share of the beams of these sources that is used."""
        return 1.0 / _stride(scans, self.source_beams)


COARSE = Schedule(gate=(0.18, 0.045), kernel=(0.09, 0.0225), num_iterations=8, source_beams=60)
FINE = Schedule(gate=(0.075, 0.0225), kernel=(0.0225, 0.00225), num_iterations=12)


# Of many guesses, this share is aligned further after some iterations, at least the second number.
_KEPT_SHARE, _LEAST_KEPT, _FIRST_ITERATIONS = 0.25, 4, 3


def _stride(scans: PlanarScans, num_beams: int | None) -> int:
    return max(1, round(scans.mask.shape[1] / (num_beams or scans.mask.shape[1])))


class PairMatches(NamedTuple):
    """Aligned pairs (p) on the host.

    Attributes:
        poses: (p, 3) x, y, heading of T_target_source.
        fitness: (p,) robust share of matched beams, 0 to 1.
        information: (p, 3, 3) in the tangent (dx, dy, dheading) of the source frame, one unit a beam.
    """

    poses: Floats
    fitness: Floats
    information: Floats

    def weakest_eigenvalue(self) -> Floats:
        """Computes the information (p,) along the least constrained direction of the translation, in beams."""
        return np.asarray(np.linalg.eigvalsh(self.information[:, :2, :2])[:, 0], np.float64)


def fan(turns: Sequence[float] | Floats, radii: Sequence[float] = (0.0,), num_ways: int = 1) -> Floats:
    """Returns guesses (h, 3) of a motion: every turn at shifts by `radii` in `num_ways` directions."""
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


@kept_jit()
def _align_all(
    source: SurfaceElements, target: SurfaceElements, T: Float[Array, "p 3 3"], schedule: Float[Array, "k 2"],
    prior: Prior,
) -> AlignedMotion:  # fmt: skip
    return jax.vmap(partial(align, rule=_RULE), (0, 0, 0, None, 0))(source, target, T, schedule, prior)


class AlignedPairs(NamedTuple):
    """Aligned pairs (t), on the host.

    Attributes:
        poses: (t, 3) T_target_source.
        weight: (t,) sum of the robust weights, at most the number of source beams.
        information: (t, 3, 3) as in `PairMatches`, at the poses before the last step.
    """

    poses: Floats
    weight: Floats
    information: Floats


def align_pairs(
    sides: tuple[SurfaceElements, SurfaceElements], pairs: Pairs, guesses: Floats, scales: Floats,
    prior: PairPrior | None = None,
) -> AlignedPairs:  # fmt: skip
    """Aligns t pairs, in batches of one shape.

    Args:
        sides: surface elements of the sources and of the targets, arrays (n, b, ...).
        pairs: (t,) rows of the sources, and of the targets.
        guesses: (t, 3) T_target_source.
        scales: (k, 2) gate and kernel of the steps, 16 at most.
        prior: prior of the relative poses, (t, 3) each; None: none.

    Returns:
        AlignedPairs.
    """
    found = AlignedPairs(*(np.zeros((len(guesses), *size)) for size in ((3,), (), (3, 3))))
    prior = prior or PairPrior(guesses, np.zeros_like(guesses))
    T, T_prior = (se2.to_matrix(np.asarray(poses, np.float64)).astype(np.float32) for poses in (guesses, prior.mean))
    information = (prior.information[..., None] * np.eye(3)).astype(np.float32)
    schedule = np.pad(scales, ((0, _MAX_STEPS - len(scales)), (0, 0))).astype(np.float32)
    batch = _LIVE_DISTANCES // (sides[0].mask.shape[1] * sides[1].mask.shape[1])
    for part, some in batches(len(guesses), 1 << int(np.log2(np.clip(batch, 1, _MAX_BATCH)))):
        source, target = (jax.tree.map(itemgetter(end[some]), side) for side, end in zip(sides, pairs, strict=True))
        motion = _align_all(source, target, T[some], schedule, Prior(T_prior[some], information[some]))
        poses = se2.from_matrix(np.asarray(motion.T_target_source, np.float64))
        turn = se2.to_matrix(poses * [0.0, 0.0, 1.0])
        of_source = np.swapaxes(turn, 1, 2) @ np.asarray(motion.information, np.float64) @ turn
        for kept, values in zip(found, (poses, motion.weight, of_source), strict=True):
            kept[part] = np.asarray(values)[: part.stop - part.start]
    return found


def match_pairs(
    source: PlanarScans, target: PlanarScans, guesses: Floats, schedule: Schedule, prior: PairPrior | None = None
) -> PairMatches:
    """Aligns source scan p to target scan p from each of its guesses and keeps the best.

    Args:
        source: p scans.
        target: p scans, or submaps with any number of points.
        guesses: (p, h, 3) initial relative poses T_target_source.
        schedule: search distances of the iterations.
        prior: prior of the relative poses, (p, 3) each; None: none.

    Returns:
        PairMatches of the guess with the best fitness for each pair.
    """
    scales = schedule.gates_and_kernels(source.typical_range, source.noise)
    scales = np.concatenate([scales, scales[-1:]])
    sides = (
        source.beams(stride=_stride(source, schedule.source_beams)),
        target.elements(stride=_stride(target, schedule.target_beams)),
    )
    row = np.arange(len(guesses))[:, None]
    if guesses.shape[1] > 2 * _LEAST_KEPT:
        rough = _align_guesses(sides, guesses, scales[: _FIRST_ITERATIONS + 1], prior)
        count = max(_LEAST_KEPT, int(np.ceil(_KEPT_SHARE * guesses.shape[1])))
        guesses = rough.poses[row, np.argsort(-rough.weight, axis=1, kind="stable")[:, :count]]
        scales = scales[_FIRST_ITERATIONS:]
    found = _align_guesses(sides, guesses, scales, prior)
    best = found.weight.argmax(axis=1)
    poses, weight, information = (x[row[:, 0], best] for x in found)
    num_beams = np.maximum(np.minimum(*(side.mask.sum(1) for side in sides)), 1)
    return PairMatches(poses, np.asarray(weight / num_beams, np.float64), information)


def _align_guesses(
    sides: tuple[SurfaceElements, SurfaceElements], guesses: Floats, scales: Floats, prior: PairPrior | None
) -> AlignedPairs:
    """Aligns each pair from each of its guesses (p, h, 3); arrays of the result are (p, h, ...)."""
    rows = np.repeat(np.arange(len(guesses)), guesses.shape[1])
    belief = None if prior is None else PairPrior(*(np.asarray(x)[rows] for x in prior))
    found = align_pairs(sides, (rows, rows), guesses.reshape(-1, 3), scales, belief)
    return AlignedPairs(*(x.reshape(*guesses.shape[:2], *x.shape[1:]) for x in found))
