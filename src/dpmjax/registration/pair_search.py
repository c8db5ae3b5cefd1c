"""Exhaustive search of the relative pose of two planar scans: all turns, all shifts, hits and free space, by FFT.

Each scan is drawn twice: where it has hit, and as evidence (positive at its surfaces, negative in its free space). A
pose is as good as the hits of each scan lie on the evidence of the other one; one inverse FFT gives all shifts of one
turn. What is best is then sharpened on ever finer local grids, by the profiles of both scans instead of pictures.
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
from dpmjax.registration.cores import on_all_cores
from dpmjax.registration.range_profiles import Margins, Profiles, judge_pair

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Pairs of one turn are filled up to a power of two, at least this, so that few shapes are compiled.
_SMALLEST = 64
_REFINE_BATCH = 256


@dataclass(frozen=True)
class CorrelativeConfig:
    """Settings of the search. Lengths are in length scales of the scans.

    Attributes:
        num_cells: cells along a side of the pictures; a scan fills the inner half, so that no shift wraps around.
        cell: side of a cell.
        num_turns: turns that are tried in a circle.
        free_weight: how much a cell of free space counts against one of surface.
        num_peaks: shifts that are kept of each turn, from different blocks of cells.
        block: cells along a block.
        num_candidates: poses that are kept of each pair.
        apart: two candidates of a pair differ by more than this: length scales, radians.
        num_levels: local grids, each half as coarse as the one before.
        crossed_weight: beams on the other's surface that make up for one in its free space.
    """

    num_cells: int = 128
    cell: float = 0.3
    num_turns: int = 120
    free_weight: float = 0.6
    num_peaks: int = 4
    block: int = 16
    num_candidates: int = 4
    apart: tuple[float, float] = (0.8, 0.12)
    num_levels: int = 4
    crossed_weight: float = 2.0

    def __post_init__(self) -> None:
        if self.num_cells % self.block or self.num_cells % 4:
            raise ValueError(f"num_cells: expected a multiple of 4 and of block {self.block}, got {self.num_cells}")


class Candidates(NamedTuple):
    """Relative poses of pairs of scans, k for each of p pairs, the best first.

    Attributes:
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, k, 3) T_target_source.
        scores: (p, k) matched less weighted crossed beams; minus infinity where there is no further candidate.
    """

    source: Indices
    target: Indices
    poses: Floats
    scores: Floats


def join_candidates(*candidates: Candidates) -> Candidates:
    """All pairs in one; each has as many candidates."""
    return Candidates(*(np.concatenate(parts) for parts in zip(*candidates, strict=True)))


def _draw(
    profiles: Profiles, turn: Float[Array, ""], cell: Float[Array, ""], config: CorrelativeConfig
) -> tuple[Complex[Array, "n g f"], Complex[Array, "n g f"]]:
    """Spectra of the two pictures of each scan, turned by `turn`, its sensor in the middle."""
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


_spectra = jax.jit(_draw, static_argnames="config")


@partial(jax.jit, static_argnames="config")
def _search_turn(
    sources: tuple[Array, Array], targets: tuple[Array, Array], source: Int[Array, " p"], target: Int[Array, " p"],
    *, config: CorrelativeConfig,
) -> tuple[Float[Array, "p k"], Int[Array, "p k 2"]]:  # fmt: skip
    """Best scores and shifts (x, y in cells) of pairs of spectra."""
    size, block = config.num_cells, config.block
    num_blocks = size // block

    def search(pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        i, j = pair
        spectrum = jnp.conj(sources[0][i]) * targets[1][j] + jnp.conj(sources[1][i]) * targets[0][j]
        score = jnp.fft.irfft2(spectrum, s=(size, size))
        blocks = score.reshape(num_blocks, block, num_blocks, block).transpose(0, 2, 1, 3).reshape(-1, block**2)
        value, which = jax.lax.top_k(blocks.max(-1), config.num_peaks)
        inner = blocks.argmax(-1)[which]
        row = which // num_blocks * block + inner // block
        column = which % num_blocks * block + inner % block
        shift = jnp.stack([column, row], -1)
        return value, (shift + size // 2) % size - size // 2

    return jax.lax.map(search, (source, target), batch_size=32)


def search_pairs(
    profiles: Profiles,
    source: Indices,
    target: Indices,
    config: CorrelativeConfig | None = None,
    *,
    scale: float,
    margins: Margins,
    turns: NDArray[np.bool_] | None = None,
) -> Candidates:
    """The most likely relative poses of pairs of scans, from no guess at all.

    Args:
        profiles: n scans.
        source: (p,) rows; these scans are turned, so few different ones are quicker.
        target: (p,) rows.
        config: settings.
        scale: `length_scale` of the scans.
        margins: how exactly hits are compared in the end.
        turns: (p, num_turns) which headings of T_target_source to try, multiples of 2 pi / num_turns; None: all.

    Returns:
        Candidates.
    """
    config = config or CorrelativeConfig()
    cell = config.cell * scale
    used, compact = np.unique(source, return_inverse=True)
    sources = jax.tree.map(lambda x: x[used], profiles)
    still = _spectra(profiles, jnp.zeros(()), jnp.asarray(cell, jnp.float32), config=config)
    poses = np.zeros((len(source), config.num_turns, config.num_peaks, 3))
    scores = np.full(poses.shape[:-1], -np.inf)

    def search_turn(number: int) -> None:
        rows = np.arange(len(source)) if turns is None else np.flatnonzero(turns[:, number])
        if not len(rows):
            return
        turn = 2 * np.pi * number / config.num_turns
        turned = _spectra(sources, jnp.asarray(turn, jnp.float32), jnp.asarray(cell, jnp.float32), config=config)
        filled = np.resize(rows, max(_SMALLEST, 1 << (len(rows) - 1).bit_length()))
        score, shift = _search_turn(
            turned, still, jnp.asarray(compact[filled]), jnp.asarray(target[filled]), config=config
        )
        scores[rows, number] = np.asarray(score, np.float64)[: len(rows)]
        poses[rows, number, :, :2] = cell * np.asarray(shift, np.float64)[: len(rows)]
        poses[rows, number, :, 2] = se2.wrap_angle(np.asarray(turn))

    on_all_cores(search_turn, range(config.num_turns))
    best, values = _keep_apart(poses.reshape(len(source), -1, 3), scores.reshape(len(source), -1), config, scale)
    return _refine(profiles, Candidates(source, target, best, values), config, scale=scale, margins=margins)


def _keep_apart(poses: Floats, scores: Floats, config: CorrelativeConfig, scale: float) -> tuple[Floats, Floats]:
    """The best poses of each pair that are no neighbours of a better one."""
    scores, rows = scores.copy(), np.arange(len(poses))
    best = np.zeros((len(poses), config.num_candidates, 3))
    values = np.full(best.shape[:2], -np.inf)
    for k in range(config.num_candidates):
        first = scores.argmax(axis=1)
        best[:, k], values[:, k] = poses[rows, first], scores[rows, first]
        off = poses - best[:, k][:, None]
        is_near = np.hypot(off[..., 0], off[..., 1]) < config.apart[0] * scale
        scores[is_near & (np.abs(se2.wrap_angle(off[..., 2])) < config.apart[1])] = -np.inf
    return best, values


@partial(jax.jit, static_argnames="config")
def _refine_batch(
    profiles: Profiles, source: Int[Array, " p"], target: Int[Array, " p"], poses: Float[Array, "p 3"],
    step: Float[Array, " 3"], margins: Margins, *, config: CorrelativeConfig,
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:  # fmt: skip
    """The best pose on a grid of five steps along each axis around each pose."""
    axis = jnp.arange(-2.0, 3.0)
    grid = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * step

    def refine(pair: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        i, j, pose = pair
        one, other = jax.tree.map(lambda x: x[i], profiles), jax.tree.map(lambda x: x[j], profiles)
        verdict = jax.vmap(lambda offset: judge_pair(one, other, pose + offset, margins, stride=4))(grid)
        score = 4.0 * (verdict.matched - config.crossed_weight * verdict.crossed)
        best = score.argmax()
        return pose + grid[best], score[best]

    return jax.lax.map(refine, (source, target, poses), batch_size=4)


def _refine(
    profiles: Profiles, found: Candidates, config: CorrelativeConfig, *, scale: float, margins: Margins
) -> Candidates:
    """Sharper candidates, from a grid of half a cell down."""
    count = found.poses.shape[1]
    rows = np.flatnonzero(np.isfinite(found.scores).reshape(-1))
    source, target = np.repeat(found.source, count)[rows], np.repeat(found.target, count)[rows]
    poses, scores = found.poses.reshape(-1, 3).copy(), np.full(found.scores.size, -np.inf)
    turn = 2 * np.pi / config.num_turns
    for level in range(config.num_levels):
        share = 0.5 ** (level + 1)
        step = share * np.array([config.cell * scale, config.cell * scale, turn])
        blur = 0.7 * share * config.cell * scale
        blurred = Margins(max(margins.match, blur), max(margins.cross, 3.0 * blur))

        def refine(start: int, step: Floats = step, blurred: Margins = blurred) -> None:
            part = np.resize(np.arange(start, min(start + _REFINE_BATCH, len(rows))), _REFINE_BATCH)
            moved, score = _refine_batch(
                profiles, jnp.asarray(source[part]), jnp.asarray(target[part]),
                jnp.asarray(poses[rows[part]], jnp.float32), jnp.asarray(step, jnp.float32),
                blurred, config=config,
            )  # fmt: skip
            poses[rows[part]], scores[rows[part]] = np.asarray(moved, np.float64), np.asarray(score, np.float64)

        on_all_cores(refine, range(0, len(rows), _REFINE_BATCH))
    # Two may have met at one place.
    best, values = _keep_apart(poses.reshape(found.poses.shape), scores.reshape(found.scores.shape), config, scale)
    return found._replace(poses=best, scores=values)
