"""Exhaustive search of the relative pose of two planar scans: all turns, all shifts, hits and free space, by FFT.

Each scan is drawn twice: where it has hit, and as evidence (positive at its surfaces, negative in its free space). The
score of a pose is the sum of the evidence of each scan at the hits of the other one; one inverse FFT gives it for all
shifts of one turn. The best poses are then refined on ever finer local grids, by the profiles of both scans.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration.planar_scans import Floats, Indices, Tolerances, batches
from dpmjax.registration.range_profiles import RangeProfiles, compare_pair

# Pairs of one turn are filled up to a power of two, at least this, so that few shapes are compiled.
_SMALLEST = 64
_REFINE_BATCH = 256


@dataclass(frozen=True)
class CorrelativeConfig:
    """Settings of the search. Lengths are in typical ranges of the scans.

    Attributes:
        num_cells: cells along a side of the images; a scan fills the inner half, so that no shift wraps around.
        cell: side of a cell.
        num_turns: turns that are tried in a circle.
        free_weight: how much a cell of free space counts against one of surface.
        num_peaks: shifts that are kept of each turn, from different blocks of cells.
        block: cells along a block.
        num_candidates: poses that are kept of each pair.
        apart: two candidates of a pair differ by more than this: translation, radians.
        num_levels: local grids, each half as coarse as the one before.
        contradiction_weight: matched beams that make up for a contradicting one.
    """

    num_cells: int = 128
    cell: float = 0.045
    num_turns: int = 120
    free_weight: float = 0.6
    num_peaks: int = 4
    block: int = 16
    num_candidates: int = 4
    apart: tuple[float, float] = (0.12, 0.12)
    num_levels: int = 4
    contradiction_weight: float = 2.0

    def __post_init__(self) -> None:
        if self.num_cells % self.block or self.num_cells % 4:
            raise ValueError(f"num_cells: expected a multiple of 4 and of block {self.block}, got {self.num_cells}")


class Candidates(NamedTuple):
    """Relative poses of pairs of scans, k for each of p pairs, the best first.

    Attributes:
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, k, 3) T_target_source.
        scores: (p, k) matched less weighted contradicting beams; minus infinity where there is no further candidate.
    """

    source: Indices
    target: Indices
    poses: Floats
    scores: Floats


def join_candidates(*candidates: Candidates) -> Candidates:
    """Joins candidates of different pairs, of as many poses each."""
    return Candidates(*(np.concatenate(parts) for parts in zip(*candidates, strict=True)))


@partial(jax.jit, static_argnames="config")
def _spectra(
    profiles: RangeProfiles, turn: Float[Array, ""], cell: Float[Array, ""], config: CorrelativeConfig
) -> tuple[Complex[Array, "n g f"], Complex[Array, "n g f"]]:
    """Spectra of the two images of each scan, turned by `turn`, its sensor in the middle."""
    size = config.num_cells
    axis = (jnp.arange(size) - size // 2) * cell
    x, y = jnp.meshgrid(axis, axis)
    distance = jnp.hypot(x, y)
    count = profiles.surface.shape[-1]
    bearing = jnp.mod(jnp.arctan2(y, x) - turn, 2 * jnp.pi)
    k = jnp.minimum((bearing * count / (2 * jnp.pi)).astype(jnp.int32), count - 1)
    usable = profiles.is_seen[:, k] & (distance < (size // 4) * cell)
    slant = profiles.slant[:, k]
    off = (distance - profiles.surface[:, k]) * slant
    hit = jnp.where(usable, jnp.exp(-0.5 * (off / (0.6 * cell)) ** 2), 0.0)
    is_free = usable & (distance < profiles.near[:, k] - cell / slant)
    evidence = hit - jnp.where(is_free, config.free_weight, 0.0)
    return jnp.fft.rfft2(hit), jnp.fft.rfft2(evidence)


@partial(jax.jit, static_argnames="config")
def _search_turn(
    sources: tuple[Array, Array], targets: tuple[Array, Array], source: Int[Array, " p"], target: Int[Array, " p"],
    *, config: CorrelativeConfig,
) -> tuple[Float[Array, "p k"], Int[Array, "p k 2"]]:  # fmt: skip
    """Best scores and shifts (x, y in cells) of pairs of spectra, each from another block of cells."""
    size, block = config.num_cells, config.block
    num_blocks = size // block

    def search(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        i, j = pair
        spectrum = jnp.conj(sources[0][i]) * targets[1][j] + jnp.conj(sources[1][i]) * targets[0][j]
        score = jnp.fft.irfft2(spectrum, s=(size, size)).reshape(num_blocks, block, num_blocks, block)
        value, which = jax.lax.top_k(score.max((1, 3)).reshape(-1), config.num_peaks)
        # Where in its block each maximum lies; a search of all blocks for it would take longer than the rest.
        best_blocks = score[which // num_blocks, :, which % num_blocks].reshape(config.num_peaks, -1)
        inner = (best_blocks == value[:, None]).argmax(-1)
        row = which // num_blocks * block + inner // block
        column = which % num_blocks * block + inner % block
        return value, (jnp.stack([column, row], -1) + size // 2) % size - size // 2

    return jax.lax.map(search, (source, target), batch_size=32)


def search_pairs(
    profiles: RangeProfiles,
    source: Indices,
    target: Indices,
    config: CorrelativeConfig | None = None,
    *,
    turns: NDArray[np.bool_] | None = None,
) -> Candidates:
    """Finds the most likely relative poses of pairs of scans, from no guess at all.

    Args:
        profiles: n scans.
        source: (p,) rows; these scans are turned, so few different ones are quicker.
        target: (p,) rows.
        config: settings.
        turns: (p, num_turns) which headings of T_target_source to try, multiples of 2 pi / num_turns; None: all.

    Returns:
        Candidates.
    """
    config = config or CorrelativeConfig()
    cell = config.cell * profiles.typical_range
    used, compact = np.unique(source, return_inverse=True)
    sources, cell_side = profiles.take(used), jnp.asarray(cell, jnp.float32)
    still = _spectra(profiles, jnp.zeros(()), cell_side, config=config)
    poses = np.zeros((len(source), config.num_turns, config.num_peaks, 3))
    scores = np.full(poses.shape[:-1], -np.inf)
    for number in range(config.num_turns):
        rows = np.arange(len(source)) if turns is None else np.flatnonzero(turns[:, number])
        if not len(rows):
            continue
        turn = 2 * np.pi * number / config.num_turns
        turned = _spectra(sources, jnp.asarray(turn, jnp.float32), cell_side, config=config)
        filled = np.resize(rows, max(_SMALLEST, 1 << (len(rows) - 1).bit_length()))
        score, shift = _search_turn(
            turned, still, jnp.asarray(compact[filled]), jnp.asarray(target[filled]), config=config
        )
        scores[rows, number] = np.asarray(score, np.float64)[: len(rows)]
        poses[rows, number, :, :2] = cell * np.asarray(shift, np.float64)[: len(rows)]
        poses[rows, number, :, 2] = se2.wrap_angle(np.asarray(turn))
    apart = (config.apart[0] * profiles.typical_range, config.apart[1])
    flat = poses.reshape(len(source), -1, 3), scores.reshape(len(source), -1)
    best, values = _keep_apart(*flat, config.num_candidates, apart)
    poses, values = _refine(profiles, Candidates(source, target, best, values), config)
    # Two may have met at one place.
    return Candidates(source, target, *_keep_apart(poses, values, config.num_candidates, apart))


def _keep_apart(poses: Floats, scores: Floats, count: int, apart: tuple[float, float]) -> tuple[Floats, Floats]:
    """The best poses of each pair that are no neighbours of a better one."""
    scores, rows = scores.copy(), np.arange(len(poses))
    best = np.zeros((len(poses), count, 3))
    values = np.full(best.shape[:2], -np.inf)
    for k in range(count):
        first = scores.argmax(axis=1)
        best[:, k], values[:, k] = poses[rows, first], scores[rows, first]
        off = poses - best[:, k][:, None]
        is_near = np.hypot(off[..., 0], off[..., 1]) < apart[0]
        scores[is_near & (np.abs(se2.wrap_angle(off[..., 2])) < apart[1])] = -np.inf
    return best, values


@partial(jax.jit, static_argnames="weight")
def _refine_batch(
    profiles: RangeProfiles, pairs: Int[Array, "2 p"], poses: Float[Array, "p 3"], step: Float[Array, " 3"],
    tolerances: Tolerances, *, weight: float,
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:  # fmt: skip
    """The best pose, and its score, on a grid of five steps along each axis around each pose."""
    axis = jnp.arange(-2.0, 3.0)
    grid = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * step

    def refine(pair: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        i, j, pose = pair
        compare = partial(compare_pair, profiles.take(i), profiles.take(j), tolerances=tolerances, stride=4)
        views = jax.vmap(lambda offset: compare(pose + offset))(grid)
        score = 4.0 * (views.matched - weight * views.contradicted)
        best = score.argmax()
        return pose + grid[best], score[best]

    return jax.lax.map(refine, (pairs[0], pairs[1], poses), batch_size=4)


def _refine(profiles: RangeProfiles, found: Candidates, config: CorrelativeConfig) -> tuple[Floats, Floats]:
    """Poses and scores of the candidates, refined on local grids from half a cell down."""
    count, cell = found.poses.shape[1], config.cell * profiles.typical_range
    rows = np.flatnonzero(np.isfinite(found.scores).reshape(-1))
    pairs = np.stack([np.repeat(found.source, count), np.repeat(found.target, count)])[:, rows]
    poses, scores = found.poses.reshape(-1, 3).copy(), np.full(found.scores.size, -np.inf)
    match, contradict = profiles.tolerances
    for level in range(config.num_levels):
        share = 0.5 ** (level + 1)
        step = jnp.asarray(share * np.array([cell, cell, 2 * np.pi / config.num_turns]), jnp.float32)
        blurred = Tolerances(max(match, 0.7 * share * cell), max(contradict, 2.1 * share * cell))
        for _, part in batches(len(rows), _REFINE_BATCH):
            moved, score = _refine_batch(
                profiles, jnp.asarray(pairs[:, part]), jnp.asarray(poses[rows[part]], jnp.float32), step, blurred,
                weight=config.contradiction_weight,
            )  # fmt: skip
            poses[rows[part]], scores[rows[part]] = np.asarray(moved, np.float64), np.asarray(score, np.float64)
    return poses.reshape(found.poses.shape), scores.reshape(found.scores.shape)
