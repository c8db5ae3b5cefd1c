"""Exhaustive search of the relative pose of two planar scans: all turns, all shifts, hits and free space, by FFT.

Each scan is drawn twice: where it has hit, and as evidence (positive at its surfaces, negative in its free space). The
score of a pose is the sum of the evidence of each scan at the hits of its partner. One inverse FFT computes this score
for all shifts of one turn. The best poses are then refined on ever finer local grids, by the profiles of both scans.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import join_rows
from dpmjax.registration2d.planar_scans import Booleans, Floats, Indices, Pairs, Tolerances, batches, rounded_up
from dpmjax.registration2d.range_profiles import RangeProfiles, compare_pair, compare_pairs

# The number of pairs of one turn is rounded up to a power of two, at least this, so that few shapes compile; the number
# of scans is rounded up to a multiple of this. Larger values are no quicker, because `lax.map` works piece by piece.
_SMALLEST = 32
_REFINE_BATCH = 32
# Pairs that are searched at a time: their spectra and images take at most 250 MB at 128 cells.
_SEARCH_BATCH = 512
# Weight of a cell of free space relative to a cell of surface.
_FREE_WEIGHT = 0.6
# Least difference of two candidates of a pair: typical ranges, and radians.
APART = 0.12
# Number of matched beams that outweigh a contradicting one.
_CONTRADICTION_WEIGHT = 2.0


@dataclass(frozen=True)
class CorrelativeConfig:
    """Settings of the search. Lengths are in typical ranges of the scans.

    Attributes:
        num_cells: number of cells along a side of the images; a scan fills the inner half, so that no shift wraps.
        cell: side of a cell.
        num_turns: number of turns in a circle.
        num_peaks: number of shifts kept for each turn, from different blocks of cells.
        block: number of cells along a block.
        num_candidates: number of poses kept for each pair.
        num_levels: number of local grids, each with half the spacing of the one before.
        max_shift: largest shift; None: half the side of the images.
    """

    num_cells: int = 128
    cell: float = 0.045
    num_turns: int = 120
    num_peaks: int = 4
    block: int = 16
    num_candidates: int = 4
    num_levels: int = 4
    max_shift: float | None = None

    def __post_init__(self) -> None:
        if self.num_cells % self.block or self.num_cells % 4:
            raise ValueError(f"num_cells: expected a multiple of 4 and of block {self.block}, got {self.num_cells}")


class Candidates(NamedTuple):
    """Relative poses of pairs of scans, k for each of p pairs, the best first.

    Attributes:
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, k, 3) T_target_source.
        scores: (p, k) matched less weighted contradicting beams; minus infinity for missing candidates.
    """

    source: Indices
    target: Indices
    poses: Floats
    scores: Floats


def chance_level(candidates: Candidates) -> float:
    """Estimates the score of a wrong pose of a pair: the median of second candidates, which are mostly wrong."""
    second = candidates.scores[:, 1]
    second = second[np.isfinite(second)]
    return max(0.0, float(np.median(second))) if len(second) else 0.0


def noisy_share(profiles: RangeProfiles, candidates: Candidates) -> float:
    """Computes a bound on the share of beams that range noise makes contradictory, from the best-scored pairs."""
    best = np.argsort(-candidates.scores[:, 0])[: len(profiles)]
    views = compare_pairs(profiles, candidates.source[best], candidates.target[best], candidates.poses[best, 0])
    share = views.contradicted / np.maximum(views.visible, 1.0)
    return 3.0 * float(np.percentile(share, 90)) if len(share) else 0.0


class Hypotheses(NamedTuple):
    """Scored relative poses of pairs: (h,) rows, (h, 3) T_target_source, (h,) scores; a pair may have several."""

    source: Indices
    target: Indices
    poses: Floats
    scores: Floats

    @classmethod
    def of(cls, candidates: Candidates, least_score: float = -np.inf) -> Hypotheses:
        """Makes hypotheses of all candidates with a score above `least_score`."""
        row, column = np.nonzero(candidates.scores > least_score)
        poses, scores = candidates.poses[row, column], candidates.scores[row, column]
        return cls(candidates.source[row], candidates.target[row], poses, scores)

    def in_both_directions(self) -> Hypotheses:
        """Returns each hypothesis, then each with its scans exchanged."""
        return join_rows(self, Hypotheses(self.target, self.source, se2.inverse(self.poses), self.scores))

    def take(self, rows: NDArray[Any]) -> Hypotheses:
        """Returns the hypotheses of these rows, or those where a mask is True."""
        return Hypotheses(*(x[rows] for x in self))

    def world_poses(self, poses: Floats) -> Floats:
        """Computes the world pose (h, 3) of each source from the world pose of its target."""
        return np.asarray(se2.compose(poses[self.target], self.poses))


@partial(jax.jit, static_argnames="config")
def _spectra(
    profiles: RangeProfiles, turn: Float[Array, ""], cell: Float[Array, ""], config: CorrelativeConfig
) -> Complex[Array, "2 n g f"]:
    """Computes the spectra of the two images of each scan, turned by `turn`, its sensor in the middle."""
    inner = config.num_cells // 2
    axis = (jnp.arange(inner) - inner // 2) * cell
    x, y = jnp.meshgrid(axis, axis)
    distance = jnp.hypot(x, y)
    count = profiles.surface.shape[-1]
    bearing = jnp.mod(jnp.arctan2(y, x) - turn, 2 * jnp.pi)
    k = jnp.minimum((bearing * count / (2 * jnp.pi)).astype(jnp.int32), count - 1)
    usable = profiles.is_seen[:, k] & (distance < (inner // 2) * cell)
    slant = profiles.slant[:, k]
    off = (distance - profiles.surface[:, k]) * slant
    hit = jnp.where(usable, jnp.exp(-0.5 * (off / (0.6 * cell)) ** 2), 0.0)
    is_free = usable & (distance < profiles.near[:, k] - cell / slant)
    evidence = hit - jnp.where(is_free, _FREE_WEIGHT, 0.0)
    # Scans fill the inner half alone, and drawing takes longer than the transform.
    margin = (config.num_cells - inner) // 2
    images = jnp.pad(jnp.stack([hit, evidence]), ((0, 0), (0, 0), (margin, margin), (margin, margin)))
    # One transform of both, because two concurrent transforms deadlock on a CPU (XLA of JAX 0.11).
    return jnp.fft.rfft2(images)


@partial(jax.jit, static_argnames="config")
def _search_turn(
    sources: Array, targets: Array, pairs: tuple[Array, Array], *, config: CorrelativeConfig
) -> tuple[Float[Array, "p k"], Int[Array, "p k 2"]]:
    """Finds the best scores and shifts (x, y in cells) of pairs of spectra, each from another block of cells."""
    size, block = config.num_cells, config.block
    num_blocks = size // block
    apart = jnp.minimum(jnp.arange(size), size - jnp.arange(size)) * config.cell
    is_far = jnp.hypot(apart, apart[:, None]) > (jnp.inf if config.max_shift is None else config.max_shift)
    outside = jnp.where(is_far, -jnp.inf, 0.0)

    def search(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        i, j = pair
        spectrum = jnp.conj(sources[0, i]) * targets[1, j] + jnp.conj(sources[1, i]) * targets[0, j]
        score = jnp.fft.irfft2(spectrum, s=(size, size)) + outside
        score = score.reshape(num_blocks, block, num_blocks, block)
        value, which = jax.lax.top_k(score.max((1, 3)).reshape(-1), config.num_peaks)
        # Position of each maximum in its block; a search of all blocks for it would take longer than all other steps.
        best_blocks = score[which // num_blocks, :, which % num_blocks].reshape(config.num_peaks, -1)
        inner = (best_blocks == value[:, None]).argmax(-1)
        row = which // num_blocks * block + inner // block
        column = which % num_blocks * block + inner % block
        return value, (jnp.stack([column, row], -1) + size // 2) % size - size // 2

    return jax.lax.map(search, pairs, batch_size=32)


def search_pairs(
    profiles: RangeProfiles, source: Indices, target: Indices, config: CorrelativeConfig, turns: Booleans | None = None
) -> Candidates:
    """Finds the best-scored relative poses of pairs of scans, without initial poses.

    Args:
        profiles: n scans.
        source: (p,) rows; these scans are turned, so fewer distinct rows are quicker.
        target: (p,) rows.
        config: settings.
        turns: (p, num_turns) True for headings of T_target_source to try, multiples of 2 pi / num_turns; None: all.

    Returns:
        Candidates.
    """
    # Pairs with one source lie side by side, so that few scans are turned for a batch.
    order, found = np.lexsort((target, source)), []
    for start in range(0, max(len(order), 1), _SEARCH_BATCH):
        rows = order[start : start + _SEARCH_BATCH]
        tried = None if turns is None else turns[rows]
        found.append(_search_batch(profiles, (source[rows], target[rows]), config, tried))
    joined, back = join_rows(*found), np.argsort(order)
    return Candidates(joined.source[back], joined.target[back], joined.poses[back], joined.scores[back])


def _search_batch(
    profiles: RangeProfiles, pairs: Pairs, config: CorrelativeConfig, turns: Booleans | None
) -> Candidates:
    """Finds candidates of one batch of pairs."""
    unit, (source, target) = profiles.scans.typical_range, pairs
    cell = config.cell * unit
    sources, compact_source = _used_profiles(profiles, source)
    targets, compact_target = _used_profiles(profiles, target)
    cell_side = jnp.asarray(cell, jnp.float32)
    # Finished before the next transform starts, as above.
    still = jax.block_until_ready(_spectra(targets, jnp.zeros(()), cell_side, config=config))
    poses = np.zeros((len(source), config.num_turns, config.num_peaks, 3))
    scores = np.full(poses.shape[:-1], -np.inf)
    for number in range(config.num_turns):
        rows = np.arange(len(source)) if turns is None else np.flatnonzero(turns[:, number])
        if not len(rows):
            continue
        turn = 2 * np.pi * number / config.num_turns
        turned = _spectra(sources, jnp.asarray(turn, jnp.float32), cell_side, config=config)
        filled = np.resize(rows, rounded_up(len(rows), _SMALLEST, _SEARCH_BATCH))
        score, shift = _search_turn(turned, still, (compact_source[filled], compact_target[filled]), config=config)
        scores[rows, number] = score[: len(rows)]
        poses[rows, number, :, :2] = cell * np.asarray(shift, np.float64)[: len(rows)]
        poses[rows, number, :, 2] = se2.wrap_angle(turn)
    found = Candidates(source, target, poses.reshape(len(source), -1, 3), scores.reshape(len(source), -1))
    # Two candidates may converge to one pose in the refinement.
    return _keep_apart(refine_candidates(profiles, _keep_apart(found, config, unit), config), config, unit)


def _used_profiles(profiles: RangeProfiles, rows: Indices) -> tuple[RangeProfiles, Indices]:
    """Returns the distinct profiles of these rows, padded so that few shapes compile, and the index of each row."""
    used, compact = np.unique(rows, return_inverse=True)
    return profiles.take(np.resize(used, rounded_up(len(used), 1, _SMALLEST))), compact


def _keep_apart(found: Candidates, config: CorrelativeConfig, typical_range: float) -> Candidates:
    """Selects the best poses of each pair by non-maximum suppression."""
    poses, scores, rows = found.poses, found.scores.copy(), np.arange(len(found.poses))
    best = np.zeros((len(poses), config.num_candidates, 3))
    values = np.full(best.shape[:2], -np.inf)
    for k in range(config.num_candidates):
        first = scores.argmax(axis=1)
        best[:, k], values[:, k] = poses[rows, first], scores[rows, first]
        scores[se2.is_within(poses - best[:, k][:, None], APART * typical_range, APART)] = -np.inf
    return found._replace(poses=best, scores=values)


@jax.jit
def _refine_batch(
    profiles: RangeProfiles, pairs: tuple[Array, Array, Array], step: Float[Array, " 3"], tolerances: Tolerances
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:
    """Finds the best pose of each pair, and its score, on a grid of five steps along each axis around the pose."""
    axis = jnp.arange(-2.0, 3.0)
    grid = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * step

    def refine(pair: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        i, j, pose = pair
        compare = partial(compare_pair, profiles.take(i), profiles.take(j), tolerances=tolerances, stride=4)
        views = jax.vmap(lambda offset: compare(pose + offset))(grid)
        score = 4.0 * (views.matched - _CONTRADICTION_WEIGHT * views.contradicted)
        best = score.argmax()
        return pose + grid[best], score[best]

    return jax.lax.map(refine, pairs, batch_size=4)


def refine_candidates(profiles: RangeProfiles, found: Candidates, config: CorrelativeConfig) -> Candidates:
    """Refines candidates on local grids, from a spacing of half a cell down.

    Args:
        profiles: n scans.
        found: candidates of p pairs; those without a finite score stay out.
        config: settings of the grids.

    Returns:
        Candidates with the best poses near the given ones, in the given order.
    """
    cell = config.cell * profiles.scans.typical_range
    first, which = np.nonzero(np.isfinite(found.scores))
    poses, scores = found.poses.copy(), np.full(found.scores.shape, -np.inf)
    match, contradict, _ = profiles.scans.tolerances
    for level in range(config.num_levels):
        share = 0.5 ** (level + 1)
        step = jnp.asarray(share * np.array([cell, cell, 2 * np.pi / config.num_turns]), jnp.float32)
        blurred = Tolerances.of(max(match, 0.7 * share * cell), max(contradict, 2.1 * share * cell))
        for _, part in batches(len(first), _REFINE_BATCH):
            row, at = first[part], (first[part], which[part])
            pairs = found.source[row], found.target[row], poses[at].astype(np.float32)
            poses[at], scores[at] = _refine_batch(profiles, pairs, step, blurred)
    return found._replace(poses=poses, scores=scores)
