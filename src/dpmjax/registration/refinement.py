"""Multi-view refinement: every scan against its neighbours in time and in space, all poses in one sparse Gauss-Newton.

Under range noise the scans are then adjusted to lines that they make together (line_adjustment.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy.spatial
from jaxtyping import Array
from numpy.typing import ArrayLike

from dpmjax.checks import as_beams
from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, join_edges
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.registration.held_steps import (
    held_steps,
    matched_steps,
    open_projections,
    pose_steps,
    prior_steps,
    settle_steps,
)
from dpmjax.registration.incremental import incremental_icp
from dpmjax.registration.line_adjustment import adjust_to_lines
from dpmjax.registration.loop_closure import LoopConfig, close_loops
from dpmjax.registration.pair_alignment import FINE, PairSystem, Schedule, linearise_pair, match_pairs
from dpmjax.registration.planar_scans import Floats, Indices, PlanarScans, planar_scans
from dpmjax.registration.quality import choose_trajectory
from dpmjax.registration.range_profiles import RangeProfiles, make_profiles
from dpmjax.registration.step_prior import StepPrior
from dpmjax.registration.step_scores import fitting_scans, interpolate
from dpmjax.registration.step_slides import slide_steps
from dpmjax.types import ScanSet

# Distances of one round are kept below this by leaving out beams of the sources: about two seconds on two cores.
_ROUND_DISTANCES = 1.5e9
# Pairs that are linearised side by side: few enough for the cache, enough for all cores.
_PAIRS_AT_ONCE = 128
# The number of pairs is rounded up to a power of two up to this one, then to its multiples, so that few shapes compile.
_PAIRS_ROUNDED = 1024
# How gates and kernels shrink over the rounds.
_ROUNDS = Schedule(gate=(0.09, 0.015), kernel=(0.06, 0.0015), num_iterations=14)
# The start is sound, and no loops are searched, if the fitness of all its steps is above this, and so is the weakest
# eigenvalue of each, as a share of the beams.
_MIN_FITNESS, _MIN_EIGENVALUE = 0.35, 0.005
# Scans are adjusted to common lines above this range noise, in typical ranges.
_MIN_NOISE = 1.5e-4
# Gauss-Newton steps that put open steps back after the adjustment to lines.
_NUM_RESTORATIONS = 3
_NO_EDGES = Edges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class RefinementConfig:
    """Settings of the refinement. Lengths are in typical ranges of the scans.

    Attributes:
        temporal: offsets of the neighbours in time; only of ordered scans.
        num_spatial: at most so many neighbours in space, each from another visit.
        radius: within which neighbours in space are looked for.
        max_turn: largest difference of heading of two neighbours in space, radians.
        refresh: neighbours are chosen anew after so many rounds.
        loops: settings of the loop search, which only ordered scans get; None: never.
    """

    temporal: tuple[int, ...] = (1, 2, 3)
    num_spatial: int = 8
    radius: float = 0.6
    max_turn: float = 2.0
    refresh: int = 4
    loops: LoopConfig | None = field(default_factory=LoopConfig)


class Refined(NamedTuple):
    """Result of `refine`.

    Attributes:
        poses: (n, 3) x, y, heading.
        num_loops: loops that were found and kept; 0 where none was needed.
    """

    poses: Floats
    num_loops: int

    @property
    def T_world_scan(self) -> Floats:
        """(n, 3, 3) the poses as matrices."""
        return se2.to_matrix(self.poses)


def refine(
    scans: PlanarScans | ScanSet | ArrayLike,
    poses: ArrayLike,
    config: RefinementConfig | None = None,
    *,
    prior: StepPrior | None = None,
) -> Refined:
    """Closes loops where the start leaves doubt, then aligns all scans together, and to common lines if there is noise.

    Loops are searched from a chain of the start's steps, which forgets what else the start knows; so the start is
    aligned without loops too, and the better map counts. Of scans that are not ordered only neighbours in space count,
    the steps of the start mean nothing, and no loops are searched.

    Args:
        scans: (n, b, 2) beam end points in the sensor frames, any unit, in the order of time; all-zero or non-finite
            beams are left out. Or a ScanSet. Or PlanarScans: scans without an order are
            `planar_scans(scans, is_ordered=False)`.
        poses: start, (n, 3) x, y, heading or (n, 3, 3) matrices, in the unit of the scans.
        config: settings.
        prior: of the steps of ordered scans; None: that of the start, at the usual deviations.

    Returns:
        Refined; the first pose is that of the start, unless loops are kept.

    Raises:
        ValueError: the scans or the poses have a wrong shape or are not finite.
    """
    config = config or RefinementConfig()
    scans = scans if isinstance(scans, PlanarScans) else planar_scans(as_beams("scans", scans))
    start = se2.as_poses("poses", poses, len(scans))
    candidates, num_loops = {"start": start}, {"start": 0}
    prior = (prior or StepPrior.of_poses(start, scans.typical_range)) if scans.is_ordered else None
    if prior is not None and config.loops is not None and not _is_sound(scans, start):
        # The steps again, with those of the start as guess, and with the prior where the scans leave a direction open.
        chained, steps = incremental_icp(scans, odometry=start, prior=prior)
        rows = np.flatnonzero(fitting_scans(scans, chained))
        if len(rows) < len(scans):
            some = scans.take(rows).replace(is_ordered=True)
            fitting = refine(some, start[rows], config, prior=prior.through(rows))
            return fitting._replace(poses=interpolate(len(scans), rows, fitting.poses))
        settled, slides = settle_steps(scans, steps, prior)
        matched = matched_steps(settled, slides, scans.typical_range)
        candidates["loops"], _, weights = close_loops(scans, se2.chain(settled.poses), config.loops, steps=matched)
        num_loops["loops"] = int((weights > 0.25).sum())
    aligned = {name: _align_all(scans, candidate, config, prior) for name, candidate in candidates.items()}
    kept = "start" if len(aligned) == 1 else choose_trajectory(scans, aligned, prior=prior)[0]
    best = aligned[kept]
    if scans.noise > _MIN_NOISE * scans.typical_range:
        adjusted = adjust_to_lines(scans, best)
        best = adjusted if prior is None else _restore_open(make_profiles(scans), best, adjusted, config, prior)
    return Refined(best, num_loops[kept])


def _align_all(scans: PlanarScans, poses: Floats, config: RefinementConfig, prior: StepPrior | None) -> Floats:
    """Multi-view point-to-line alignment of all scans from nearby poses; the first pose is held."""
    scales, profiles = _ROUNDS.gates_and_kernels(scans.typical_range, 1.25 * scans.noise), make_profiles(scans)
    expected = pose_steps(poses, scans.typical_range) if prior is None else prior_steps(prior)
    # In units of one beam's information, as the systems of the pairs are.
    trust = 1e-9 if prior is None else max(scans.noise, 0.00075 * scans.typical_range) ** 2
    for round_number, scale in enumerate(zip(*scales, strict=True)):
        if round_number % config.refresh == 0:
            pairs = _choose_aligned(profiles, poses, config, prior)
            steps = join_edges(expected, pairs.held)
            steps = steps._replace(information=trust * steps.information)
        edges, system = _linearise(scans, pairs.source, pairs.target, poses, scale)
        edges = edges._replace(information=pairs.across @ edges.information @ pairs.across)
        here = se2.relative(poses[steps.target], poses[steps.source])
        pull = np.einsum("eij,ej->ei", steps.information, se2.relative(steps.measurements, here))
        gradient = np.einsum("eij,ej->ei", pairs.across, np.asarray(system.gradient))
        edges, gradient = join_edges(edges, steps._replace(measurements=here)), np.concatenate([gradient, pull])
        poses = se2.compose(poses, solve_step(len(poses), edges, gradient))
    return poses


def _restore_open(
    profiles: RangeProfiles, aligned: Floats, adjusted: Floats, config: RefinementConfig, prior: StepPrior
) -> Floats:
    """Returns the adjusted poses, but along open directions the steps of the aligned ones: lines do not hold them."""
    scans, unit = profiles.scans, profiles.scans.typical_range
    pairs, poses = _choose_aligned(profiles, aligned, config, prior), adjusted
    if not len(pairs.held.source):
        return adjusted
    scale = tuple(x[-1] for x in _ROUNDS.gates_and_kernels(unit, 1.25 * scans.noise))
    edges, _ = _linearise(scans, pairs.source, pairs.target, adjusted, (scale[0], scale[1]))
    edges = edges._replace(information=pairs.across @ edges.information @ pairs.across)
    kept, information = se2.relative(aligned[pairs.held.target], aligned[pairs.held.source]), pairs.held.information
    # As firm as if all beams of a scan measured the open direction.
    information = information * (scans.mask.shape[1] / np.trace(information, axis1=1, axis2=2))[:, None, None]
    edges = join_edges(edges, Edges(pairs.held.source, pairs.held.target, kept, information))
    for _ in range(_NUM_RESTORATIONS):
        here = se2.relative(poses[edges.target], poses[edges.source])
        pull = np.einsum("eij,ej->ei", edges.information, se2.relative(edges.measurements, here))
        poses = se2.compose(poses, solve_step(len(poses), edges._replace(measurements=here), pull))
    return poses


class _AlignedPairs(NamedTuple):
    """Pairs of scans that are aligned (p), and the steps that the scans do not fix.

    Attributes:
        source: (p,) rows.
        target: (p,) rows.
        across: (p, 3, 3) projections of tangents that drop the open direction of a pair.
        held: edges of open and of torn steps.
    """

    source: Indices
    target: Indices
    across: Floats
    held: Edges


def _choose_aligned(
    profiles: RangeProfiles, poses: Floats, config: RefinementConfig, prior: StepPrior | None
) -> _AlignedPairs:
    """Chooses the pairs to align at these poses; a torn step is held at its most probable place instead."""
    scans, later = profiles.scans, np.arange(1, len(poses))
    source, target = choose_pairs(scans, poses, config)
    steps = se2.relative(poses[:-1], poses[1:])
    if prior is None:
        return _AlignedPairs(source, target, np.broadcast_to(np.eye(3), (len(source), 3, 3)), _NO_EDGES)
    slides = slide_steps(profiles, later, later - 1, steps, prior)
    crossed = np.append(0, np.cumsum(slides.is_torn))
    is_kept = (crossed[source] == crossed[target]) | (source - target > max(config.temporal, default=0))
    source, target = source[is_kept], target[is_kept]
    relative = se2.relative(poses[target], poses[source])
    across = open_projections(slide_steps(profiles, source, target, relative), relative)
    return _AlignedPairs(source, target, across, held_steps(slides, poses, scans.typical_range))


def solve_step(num_poses: int, edges: Edges, gradient: Floats) -> Floats:
    """One Gauss-Newton step of all poses in their own frames (n, 3); the first one is held.

    Args:
        num_poses: n.
        edges: the relative poses at which the system was linearised, with J^T W J as information.
        gradient: (e, 3) J^T W r of each edge in the tangent of its source frame.

    Returns:
        (n, 3) steps.
    """
    # A step of the target moves the tangent of an edge by minus the adjoint of T_source_target.
    adjoint = se2.adjoint(se2.inverse(edges.measurements))
    jacobian = np.stack([-adjoint, np.broadcast_to(np.eye(3), adjoint.shape)], axis=1)
    transposed = np.swapaxes(jacobian, 2, 3)
    blocks = (transposed @ edges.information[:, None])[:, :, None] @ jacobian[:, None]
    gradients = np.einsum("esij,ej->esi", transposed, gradient)
    return solve_blocks(np.stack([edges.target, edges.source], axis=1), blocks, gradients, num_poses)


def choose_pairs(scans: PlanarScans, poses: Floats, config: RefinementConfig) -> tuple[Indices, Indices]:
    """Pairs (source, target) of neighbours in time and in space; of each visit of a place the nearest scan."""
    num_scans = len(poses)
    temporal = config.temporal if scans.is_ordered else ()
    source = [np.arange(k, num_scans) for k in temporal]
    target = [np.arange(num_scans - k) for k in temporal]
    tree = scipy.spatial.cKDTree(poses[:, :2])
    # Of each visit of a place one scan is enough; without an order every scan is a visit.
    apart, visit = (max(temporal, default=0) + 2, 2) if scans.is_ordered else (0, 0)
    count = min(num_scans, 6 * config.num_spatial + 2 * apart)
    nearest = tree.query(poses[:, :2], k=count, distance_upper_bound=config.radius * scans.typical_range)
    distances, rows = np.atleast_2d(nearest[0]), np.atleast_2d(nearest[1])
    for scan in range(num_scans):
        near = rows[scan][np.isfinite(distances[scan])]
        near = near[(np.abs(near - scan) > apart)]
        near = near[np.abs(se2.wrap_angle(poses[near, 2] - poses[scan, 2])) < config.max_turn]
        chosen: list[int] = []
        while len(near) and len(chosen) < config.num_spatial:
            chosen.append(int(near[0]))
            near = near[np.abs(near - near[0]) > visit]
        source.append(np.full(len(chosen), scan))
        target.append(np.array(chosen, np.int64))
    return np.concatenate(source).astype(np.int64), np.concatenate(target).astype(np.int64)


@partial(jax.jit, static_argnames="source_stride")
def _linearise_pairs(
    scans: PlanarScans, pairs: tuple[Array, Array, Array], scale: tuple[Array, Array], *, source_stride: int
) -> PairSystem:
    thinned = scans.thin(source_stride)

    def linearise(pair: tuple[Array, Array, Array]) -> PairSystem:
        return linearise_pair(thinned.take(pair[0]), scans.take(pair[1]), pair[2], scale, metric="plane")

    return jax.lax.map(linearise, pairs, batch_size=_PAIRS_AT_ONCE)


def _linearise(
    scans: PlanarScans, source: Indices, target: Indices, poses: Floats, scale: tuple[jax.Array, jax.Array]
) -> tuple[Edges, PairSystem]:
    """Systems of all pairs at these poses, gate and kernel; the count is rounded up, so that few shapes compile."""
    relative = se2.relative(poses[target], poses[source])
    stride = max(1, int(np.ceil(len(source) * scans.mask.shape[1] ** 2 / _ROUND_DISTANCES)))
    filled = np.resize(np.arange(len(source)), _rounded_up(len(source)))
    pairs = source[filled], target[filled], relative[filled].astype(np.float32)
    system = _linearise_pairs(scans.replace(is_ordered=False), pairs, scale, source_stride=stride)
    system = jax.tree.map(lambda x: np.asarray(x, np.float64)[: len(source)], system)
    return Edges(source, target, relative, np.asarray(system.information)), system


def _rounded_up(num_pairs: int) -> int:
    """Returns the number of pairs that is computed in place of `num_pairs`."""
    if num_pairs > _PAIRS_ROUNDED:
        return _PAIRS_ROUNDED * -(-num_pairs // _PAIRS_ROUNDED)
    return max(_PAIRS_AT_ONCE, 1 << (num_pairs - 1).bit_length())


def _is_sound(scans: PlanarScans, poses: Floats) -> bool:
    """Whether all steps fit and are fixed in every direction, so that a chain of them cannot have gone far astray."""
    guesses = se2.relative(poses[:-1], poses[1:])[:, None]
    steps = match_pairs(scans.take(slice(1, None)), scans.take(slice(len(poses) - 1)), guesses, FINE)
    share = steps.weakest_eigenvalue() / np.maximum(np.asarray(scans.is_on_line.sum(1))[1:], 1)
    return bool((steps.fitness > _MIN_FITNESS).all() and (share > _MIN_EIGENVALUE).all())
