"""Exhaustive search of the relative pose of two planar scans: all turns, all shifts, hits and free space, by FFT.

Each scan is drawn twice, as hits and as evidence (positive at its surfaces, negative in its free space). The score of a
pose is the sum of the evidence of each scan at the hits of its partner. One inverse FFT computes this score for all
shifts of one turn. The views of both scans then refine the best poses on ever finer local grids.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Complex, Float, Int
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import join_rows
from dpmjax.scan.apart import apart
from dpmjax.scan.planar.compare import compare_pairs
from dpmjax.scan.planar.record import Booleans, Floats, Indices, Pairs, PlanarScans, Tolerances

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


class Hypotheses(NamedTuple):
    """Scored relative poses of pairs of scans. A pair may have several, side by side, the best first.

    Attributes:
        source: (h,) rows.
        target: (h,) rows.
        poses: (h, 3) T_target_source.
        scores: (h,) matched less weighted contradicting beams, or the score that the maker says.
    """

    source: Indices
    target: Indices
    poses: Floats
    scores: Floats

    @property
    def pair(self) -> Indices:
        """Number (h,) of the pair of each hypothesis, in order from 0."""
        is_new = (np.diff(self.source) != 0) | (np.diff(self.target) != 0)
        return np.cumsum(np.append(False, is_new))[: len(self.source)]

    def in_both_directions(self) -> Hypotheses:
        """Returns all hypotheses, then all of them with exchanged scans."""
        return join_rows(self, Hypotheses(self.target, self.source, se2.inverse(self.poses), self.scores))

    def take(self, rows: NDArray[Any]) -> Hypotheses:
        """Returns the hypotheses of these rows, or those where a mask is True."""
        return Hypotheses(*(x[rows] for x in self))

    def world_poses(self, poses: Floats) -> Floats:
        """Computes the world pose (h, 3) of each source from the world pose of its target."""
        return np.asarray(se2.compose(poses[self.target], self.poses))


def chance_level(found: Hypotheses) -> float:
    """Estimates the score of a wrong pose of a pair: the median of second hypotheses, which are mostly wrong."""
    first = np.unique(found.pair, return_index=True)[1]
    second = found.scores[np.setdiff1d(first + 1, np.append(first, len(found.scores)))]
    return max(0.0, float(np.median(second))) if len(second) else 0.0


def noisy_share(scans: PlanarScans, found: Hypotheses) -> float:
    """Computes a bound on the share of beams that range noise makes contradictory, from the best-scored pairs."""
    first = found.take(np.unique(found.pair, return_index=True)[1])
    best = first.take(np.argsort(-first.scores)[: len(scans)])
    views = compare_pairs(scans, best.source, best.target, best.poses)
    share = views.contradicted / np.maximum(views.visible, 1.0)
    return 3.0 * float(np.percentile(share, 90)) if len(share) else 0.0


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
) -> Hypotheses:
    """Finds the best-scored relative poses of pairs of scans, without initial poses.

    Args:
        scans: n scans.
        source: (p,) rows. These scans are turned, so few distinct rows are faster.
        target: (p,) rows.
        config: settings.
        turns: (p, num_turns) True for headings of T_target_source to try. Turn k is k 2 pi / num_turns. None: all.

    Returns:
        Hypotheses, in the order of the pairs.
    """
    # Pairs with one source lie side by side, so that few scans are turned for a batch.
    order, numbers, found = np.lexsort((target, source)), [], []
    for start in range(0, max(len(order), 1), _SEARCH_BATCH):
        rows = order[start : start + _SEARCH_BATCH]
        tried = None if turns is None else turns[rows]
        number, some = _search_batch(scans, (source[rows], target[rows]), config, tried)
        numbers.append(rows[number])
        found.append(some)
    return join_rows(*found).take(np.argsort(np.concatenate(numbers), kind="stable"))


def _search_batch(
    scans: PlanarScans, pairs: Pairs, config: CorrelativeConfig, turns: Booleans | None
) -> tuple[Indices, Hypotheses]:
    """Finds hypotheses of one batch of pairs, and the number of the pair of each."""
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
    for k in range(config.num_turns):
        rows = np.arange(len(source)) if turns is None else np.flatnonzero(turns[:, k])
        turn = 2 * np.pi * k / config.num_turns
        used, turned = np.unique(source[rows], return_inverse=True)
        sources = _spectra(tuple(x[used] for x in views), turn, cell, config).conj() if len(used) else targets
        for first in range(0, len(rows), _IMAGES):
            some = slice(first, first + _IMAGES)
            i, j = turned[some], still[rows[some]]
            product = sources[0, i] * targets[1, j] + sources[1, i] * targets[0, j]
            score, shift = _best_shifts(product, outside, config)
            scores[rows[some], k], poses[rows[some], k, :, :2] = score, cell * shift
        poses[:, k, :, 2] = se2.wrap_angle(turn)
    all_pairs = np.repeat(np.arange(len(source)), config.num_turns * config.num_peaks)
    everything = Hypotheses(source[all_pairs], target[all_pairs], poses.reshape(-1, 3), scores.ravel())
    number, found = _keep_apart(all_pairs, everything, config, unit)
    # Two hypotheses may converge to one pose in the refinement.
    return _keep_apart(number, refine_candidates(scans, found, config), config, unit)


def _keep_apart(
    number: Indices, found: Hypotheses, config: CorrelativeConfig, typical_range: float
) -> tuple[Indices, Hypotheses]:
    """Selects the best poses of each pair that lie apart; returns the numbers of their pairs, too."""
    kept, ends = [np.zeros(0, np.int64)], np.searchsorted(number, np.arange(number.max(initial=-1) + 2))
    for first, last in itertools.pairwise(ends):
        own = slice(first, last)
        kept.append(first + poses_apart(found.poses[own], found.scores[own], typical_range, config.num_candidates))
    rows = np.concatenate(kept)
    return number[rows], found.take(rows)


def refine_candidates(scans: PlanarScans, found: Hypotheses, config: CorrelativeConfig) -> Hypotheses:
    """Refines hypotheses on local grids of five steps along each axis, from a spacing of half a cell down.

    Args:
        scans: n scans.
        found: hypotheses.
        config: settings of the grids.

    Returns:
        Hypotheses with the best poses near the given ones, in the given order.
    """
    cell = config.cell * scans.typical_range
    row, poses, scores = np.arange(len(found.scores)), found.poses, found.scores
    match, contradict, _ = scans.tolerances
    axis = np.arange(-2.0, 3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    for level in range(config.num_levels):
        share = 0.5 ** (level + 1)
        step = share * np.array([cell, cell, 2 * np.pi / config.num_turns])
        blurred = Tolerances.of(max(match, 0.7 * share * cell), max(contradict, 2.1 * share * cell))
        places = poses[:, None] + grid * step
        views = compare_pairs(scans, found.source, found.target, places, stride=4, tolerances=blurred)
        score = views.matched - _CONTRADICTION_WEIGHT * views.contradicted
        best = score.argmax(axis=1) if len(row) else row
        poses, scores = places[row, best], np.asarray(score[row, best])
    return found._replace(poses=poses, scores=scores)
