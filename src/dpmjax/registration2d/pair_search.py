"""Exhaustive search of the relative pose of two planar scans: all turns, all shifts, hits and free space, by FFT.

Each scan is drawn twice, as hits and as evidence (positive at its surfaces, negative in its free space). The score of a
pose is the sum of the evidence of each scan at the hits of its partner. One inverse FFT computes this score for all
shifts of one turn. The views of both scans then refine the best poses on ever finer local grids.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Complex, Float, Int
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import join_rows
from dpmjax.registration2d.planar_scans import Booleans, Floats, Indices, Pairs, PlanarScans, Tolerances
from dpmjax.registration2d.range_profiles import compare_pairs
from dpmjax.scans.apart import apart

# Pairs that are searched at a time, and images that are transformed at a time: their spectra take 250 MB, and fit into
# the cache.
_SEARCH_BATCH, _IMAGES = 512, 16
# Least difference of two candidates of a pair: typical ranges, and radians.
APART = 0.12
# Number of matched beams that outweigh a contradicting one.
_CONTRADICTION_WEIGHT = 2.0


class CorrelativeConfig(NamedTuple):
    """Settings of the search. Lengths are in typical ranges of the scans.

    Attributes:
        num_cells: number of cells along a side of the images, a multiple of 4 and of `block`. A scan fills the inner
            half, so that no shift wraps.
        cell: side of a cell.
        num_turns: number of turns in a circle.
        num_peaks: number of shifts kept for each turn, from different blocks of cells.
        block: number of cells along a block.
        num_candidates: number of poses kept for each pair.
        num_levels: number of local grids. Each has half the spacing of the previous grid.
        max_shift: largest shift, at most half the side of the images.
    """

    num_cells: int = 128
    cell: float = 0.045
    num_turns: int = 120
    num_peaks: int = 4
    block: int = 16
    num_candidates: int = 4
    num_levels: int = 4
    max_shift: float = np.inf


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


def noisy_share(scans: PlanarScans, candidates: Candidates) -> float:
    """Computes a bound on the share of beams that range noise makes contradictory, from the best-scored pairs."""
    best = np.argsort(-candidates.scores[:, 0])[: len(scans)]
    views = compare_pairs(scans, candidates.source[best], candidates.target[best], candidates.poses[best, 0])
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
        """Returns all hypotheses, then all of them with exchanged scans."""
        return join_rows(self, Hypotheses(self.target, self.source, se2.inverse(self.poses), self.scores))

    def take(self, rows: NDArray[Any]) -> Hypotheses:
        """Returns the hypotheses of these rows, or those where a mask is True."""
        return Hypotheses(*(x[rows] for x in self))

    def world_poses(self, poses: Floats) -> Floats:
        """Computes the world pose (h, 3) of each source from the world pose of its target."""
        return np.asarray(se2.compose(poses[self.target], self.poses))


def poses_apart(poses: Floats, scores: Floats, typical_range: float, count: int) -> Indices:
    """Selects the best distinct poses (m, 3) of a pair; returns their rows, the best one first."""
    return apart(scores, lambda best: se2.is_within(poses - poses[best], APART * typical_range, APART), count)


def _spectra(
    views: tuple[Floats, ...], turn: float, cell: float, config: CorrelativeConfig
) -> Complex[np.ndarray, "2 n g f"]:
    """Computes the spectra of the two images of each scan, turned by `turn`; a scan fills the first half of each side.

    Args:
        views: surface, near, slant, and is_seen of the scans.
        turn: radians.
        cell: side of a cell.
        config: settings.

    Returns:
        Spectra of the hits, and of the evidence.
    """
    surface, near, slant, is_seen = views
    inner = config.num_cells // 2
    axis = (np.arange(inner) - inner // 2) * cell
    x, y = np.meshgrid(axis, axis)
    distance = np.hypot(x, y).astype(np.float32)
    bearing = (np.arctan2(y, x) - turn) % (2 * np.pi)
    count = surface.shape[-1]
    k = np.minimum((bearing * count / (2 * np.pi)).astype(np.int64), count - 1)
    spectra = np.empty((2, len(surface), config.num_cells, config.num_cells // 2 + 1), np.complex64)
    for first in range(0, len(surface), _IMAGES):
        rows = slice(first, first + _IMAGES)
        slanted = slant[rows].take(k, axis=1)
        usable = is_seen[rows].take(k, axis=1) & (distance < (inner // 2) * cell)
        off = (distance - surface[rows].take(k, axis=1)) * slanted / np.float32(0.6 * cell)
        hit = np.exp(np.float32(-0.5) * off**2) * usable
        is_free = usable & (distance < near[rows].take(k, axis=1) - np.float32(cell) / slanted)
        # Weight of a cell of free space relative to a cell of surface.
        images = np.stack([hit, hit - np.float32(0.6) * is_free])
        spectra[:, rows] = scipy.fft.rfft2(images, s=(config.num_cells,) * 2)
    return spectra


def _best_shifts(
    spectra: Complex[np.ndarray, "p g f"], outside: Float[np.ndarray, "g g"], config: CorrelativeConfig
) -> tuple[Float[np.ndarray, "p k"], Int[np.ndarray, "p k 2"]]:
    """Finds the best scores and shifts (x, y in cells) of correlations, each from another block of cells."""
    size, block = config.num_cells, config.block
    num_blocks, row = size // block, np.arange(len(spectra))[:, None]
    score = (scipy.fft.irfft2(spectra, s=(size, size)) + outside).reshape(-1, num_blocks, block, num_blocks, block)
    best = score.max(axis=2).max(axis=3).reshape(len(score), -1)
    which = np.argpartition(-best, config.num_peaks - 1, axis=1)[:, : config.num_peaks]
    inner = score[row, which // num_blocks, :, which % num_blocks].reshape(*which.shape, -1).argmax(-1)
    y, x = which // num_blocks * block + inner // block, which % num_blocks * block + inner % block
    return best[row, which], (np.stack([x, y], -1) + size // 2) % size - size // 2


def search_pairs(
    scans: PlanarScans, source: Indices, target: Indices, config: CorrelativeConfig, turns: Booleans | None = None
) -> Candidates:
    """Finds the best-scored relative poses of pairs of scans, without initial poses.

    Args:
        scans: n scans.
        source: (p,) rows. These scans are turned, so few distinct rows are faster.
        target: (p,) rows.
        config: settings.
        turns: (p, num_turns) True for headings of T_target_source to try. Turn k is k 2 pi / num_turns. None: all.

    Returns:
        Candidates.
    """
    # Pairs with one source lie side by side, so that few scans are turned for a batch.
    order, found = np.lexsort((target, source)), []
    for start in range(0, max(len(order), 1), _SEARCH_BATCH):
        rows = order[start : start + _SEARCH_BATCH]
        tried = None if turns is None else turns[rows]
        found.append(_search_batch(scans, (source[rows], target[rows]), config, tried))
    joined, back = join_rows(*found), np.argsort(order)
    return Candidates(joined.source[back], joined.target[back], joined.poses[back], joined.scores[back])


def _search_batch(scans: PlanarScans, pairs: Pairs, config: CorrelativeConfig, turns: Booleans | None) -> Candidates:
    """Finds candidates of one batch of pairs."""
    unit, (source, target) = scans.typical_range, pairs
    cell, size = config.cell * unit, config.num_cells
    seen = scans.views
    views = tuple(np.asarray(x) for x in (seen.surface, seen.near, seen.slant, seen.is_seen))
    distance = np.minimum(np.arange(size), size - np.arange(size)) * config.cell
    outside = np.where(np.hypot(distance, distance[:, None]) > config.max_shift, -np.inf, 0.0).astype(np.float32)
    used, still = np.unique(target, return_inverse=True)
    targets = _spectra(tuple(x[used] for x in views), 0.0, cell, config)
    poses = np.zeros((len(source), config.num_turns, config.num_peaks, 3))
    scores = np.full(poses.shape[:-1], -np.inf)
    for number in range(config.num_turns):
        rows = np.arange(len(source)) if turns is None else np.flatnonzero(turns[:, number])
        turn = 2 * np.pi * number / config.num_turns
        used, turned = np.unique(source[rows], return_inverse=True)
        sources = _spectra(tuple(x[used] for x in views), turn, cell, config).conj() if len(used) else targets
        for first in range(0, len(rows), _IMAGES):
            some = slice(first, first + _IMAGES)
            i, j = turned[some], still[rows[some]]
            product = sources[0, i] * targets[1, j] + sources[1, i] * targets[0, j]
            score, shift = _best_shifts(product, outside, config)
            scores[rows[some], number], poses[rows[some], number, :, :2] = score, cell * shift
        poses[:, number, :, 2] = se2.wrap_angle(turn)
    found = Candidates(source, target, poses.reshape(len(source), -1, 3), scores.reshape(len(source), -1))
    # Two candidates may converge to one pose in the refinement.
    return _keep_apart(refine_candidates(scans, _keep_apart(found, config, unit), config), config, unit)


def _keep_apart(found: Candidates, config: CorrelativeConfig, typical_range: float) -> Candidates:
    """Selects the best poses of each pair that lie apart."""
    shape = len(found.source), config.num_candidates
    poses, scores = np.zeros((*shape, 3)), np.full(shape, -np.inf)
    for row in range(len(found.source)):
        kept = poses_apart(found.poses[row], found.scores[row], typical_range, config.num_candidates)
        poses[row, : len(kept)], scores[row, : len(kept)] = found.poses[row, kept], found.scores[row, kept]
    return found._replace(poses=poses, scores=scores)


def refine_candidates(scans: PlanarScans, found: Candidates, config: CorrelativeConfig) -> Candidates:
    """Refines candidates on local grids of five steps along each axis, from a spacing of half a cell down.

    Args:
        scans: n scans.
        found: candidates of p pairs. Candidates without a finite score are not refined.
        config: settings of the grids.

    Returns:
        Candidates with the best poses near the given ones, in the given order.
    """
    cell = config.cell * scans.typical_range
    first, which = np.nonzero(np.isfinite(found.scores))
    poses, scores = found.poses.copy(), np.full(found.scores.shape, -np.inf)
    match, contradict, _ = scans.tolerances
    axis = np.arange(-2.0, 3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    for level in range(config.num_levels):
        share = 0.5 ** (level + 1)
        step = share * np.array([cell, cell, 2 * np.pi / config.num_turns])
        blurred = Tolerances.of(max(match, 0.7 * share * cell), max(contradict, 2.1 * share * cell))
        places = poses[first, which][:, None] + grid * step
        views = compare_pairs(scans, found.source[first], found.target[first], places, stride=4, tolerances=blurred)
        score, row = views.matched - _CONTRADICTION_WEIGHT * views.contradicted, np.arange(len(first))
        best = score.argmax(axis=1) if len(row) else row
        poses[first, which], scores[first, which] = places[row, best], score[row, best]
    return found._replace(poses=poses, scores=scores)
