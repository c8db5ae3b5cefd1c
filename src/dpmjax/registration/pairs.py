"""Relative poses of many pairs of planar scans: several guesses each, the best one refined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.pair_alignment import Metric, StepPrior, align_pairs
from dpmjax.types import ScanSet

# How many distances one batch of pairs may hold at once: 128 MB of float32 with what XLA keeps beside them.
_LIVE_DISTANCES = 1 << 24


@dataclass(frozen=True)
class Schedule:
    """How the reach of a matching shrinks from iteration to iteration, in units of the scans' length scale.

    Attributes:
        gate: largest distance of matched points, first and last iteration.
        kernel: scale of the robust weight, first and last iteration; never below twice the range noise.
        num_iterations: iterations of Gauss-Newton.
        source_stride: every so manyth beam of the source is used.
        target_stride: every so manyth beam of the target is used.
    """

    gate: tuple[float, float]
    kernel: tuple[float, float]
    num_iterations: int
    source_stride: int = 1
    target_stride: int = 1

    def __post_init__(self) -> None:
        if min(*self.gate, *self.kernel) <= 0 or self.num_iterations < 1:
            raise ValueError(f"schedule: gates, kernels and iterations must be positive, got {self}")


COARSE = Schedule(gate=(1.2, 0.3), kernel=(0.6, 0.15), num_iterations=8, source_stride=3)
FINE = Schedule(gate=(0.5, 0.15), kernel=(0.15, 0.015), num_iterations=12)


class PairMatches(NamedTuple):
    """Aligned pairs (p) on the host.

    Attributes:
        poses: (p, 3) x, y, heading of T_target_source.
        fitness: (p,) robust share of beams that found their partner, 0 to 1.
        information: (p, 3, 3) J^T W J in the source frame, one unit a beam.
        squares: (p,) weighted mean of squared residuals.
    """

    poses: NDArray[np.float64]
    fitness: NDArray[np.float64]
    information: NDArray[np.float64]
    squares: NDArray[np.float64]


def length_scale(lines: LineScans | ScanSet) -> float:
    """A typical length of the place: 15 % of the range that nine beams in ten stay below, median over the scans.

    Gates and kernels are multiples of it, so that pixels, rooms and streets need no settings of their own.
    """
    reach = np.linalg.norm(np.asarray(lines.points), axis=-1)
    far = [np.percentile(r[m], 90) for r, m in zip(reach, np.asarray(lines.mask), strict=True) if m.any()]
    return 0.15 * float(np.median(far)) if far else 1.0


def take_scans(lines: LineScans, index: NDArray[np.integer]) -> LineScans:
    """The scans of these rows."""
    return jax.tree.map(lambda x: x[index], lines)


def thin_beams(lines: LineScans, stride: int) -> LineScans:
    """The same scans with every `stride`-th beam."""
    return jax.tree.map(lambda x: x[:, ::stride] if x.ndim > 1 else x, lines)


def scales(schedule: Schedule, scale: float, noise: float) -> tuple[jax.Array, jax.Array]:
    """Gates and kernels of each iteration in the unit of the points."""
    gates = scale * np.geomspace(*schedule.gate, schedule.num_iterations)
    kernels = np.maximum(scale * np.geomspace(*schedule.kernel, schedule.num_iterations), 2.0 * noise)
    return jnp.asarray(np.maximum(gates, 4.0 * noise), jnp.float32), jnp.asarray(kernels, jnp.float32)


def no_prior(num_pairs: int) -> StepPrior:
    """No belief in any relative pose."""
    return StepPrior(mean=np.zeros((num_pairs, 3)), information=np.zeros((num_pairs, 3)))


def match_pairs(
    source: LineScans,
    target: LineScans,
    guesses: NDArray[np.float64],
    schedule: Schedule,
    prior: StepPrior,
    *,
    scale: float,
    metric: Metric = "plane",
) -> PairMatches:
    """Aligns source scan p to target scan p from each of its guesses and keeps the best.

    Args:
        source: p scans.
        target: p scans, or submaps of as many points as wanted.
        guesses: (p, h, 3) relative poses T_target_source to start from.
        schedule: how the reach shrinks.
        prior: belief in the relative poses, (p, 3) each.
        scale: `length_scale` of the scans, unit of the points.
        metric: "plane" or "point".

    Returns:
        PairMatches of the guess with the best fitness for each pair.
    """
    num_pairs, num_guesses = guesses.shape[:2]
    source, target = thin_beams(source, schedule.source_stride), thin_beams(target, schedule.target_stride)
    distances = num_guesses * source.mask.shape[1] * target.mask.shape[1]
    # A power of two whatever the number of pairs: calls of about the same size share one compiled program.
    batch = 1 << int(np.log2(np.clip(_LIVE_DISTANCES // distances, 1, max(2 * num_pairs - 1, 1))))
    gates, kernels = scales(schedule, scale, float(jnp.max(source.noise, initial=0.0)))
    parts = []
    for start in range(0, num_pairs, batch):
        # The last batch is filled up with repetitions, so that every call has the same shapes.
        rows = np.resize(np.arange(start, min(num_pairs, start + batch)), batch)
        repeated = np.repeat(rows, num_guesses)
        poses, system = align_pairs(
            take_scans(source, repeated),
            take_scans(target, repeated),
            jnp.asarray(guesses[rows].reshape(-1, 3), jnp.float32),
            gates,
            kernels,
            StepPrior(*(jnp.asarray(np.asarray(x)[repeated], jnp.float32) for x in prior)),
            metric=metric,
        )
        shaped = [np.asarray(x, np.float64).reshape(batch, num_guesses, *x.shape[1:]) for x in (poses, *system)]
        parts.append([x[: min(num_pairs - start, batch)] for x in shaped])
    if not parts:
        return PairMatches(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3, 3)), np.zeros(0))
    poses, information, _, weight, squares = (np.concatenate(x) for x in zip(*parts, strict=True))
    best = weight.argmax(axis=1)
    row = np.arange(num_pairs)
    num_beams = np.minimum(np.asarray(source.mask.sum(1)), np.asarray(target.mask.sum(1)))
    chosen = weight[row, best]
    return PairMatches(
        poses=poses[row, best],
        fitness=chosen / np.maximum(num_beams, 1),
        information=information[row, best],
        squares=squares[row, best] / np.maximum(chosen, 1e-9),
    )


def nearest_tour(poses: NDArray[np.float64]) -> NDArray[np.int64]:
    """An order in which neighbours are near each other: from each pose to the nearest one not yet visited.

    Args:
        poses: (n, 3) x, y, heading.

    Returns:
        (n,) rows, the first one 0.
    """
    left = set(range(1, len(poses)))
    tour = [0]
    while left:
        here = poses[tour[-1], :2]
        tour.append(min(left, key=lambda scan: (float(np.hypot(*(poses[scan, :2] - here))), scan)))
        left.remove(tour[-1])
    return np.array(tour, np.int64)
