"""Joint alignment of each scan with its neighbours in time and in space: sparse Gauss-Newton over all poses.

A pair of scans in a corridor constrains the direction across the corridor alone. Along it, the posterior of the shift
constrains open steps, and torn steps are put at their most probable shift (see `Slides`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import scipy.spatial
from jaxtyping import Array

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, join_edges
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.registration2d.held_steps import held_steps, open_projections, pose_steps, prior_steps
from dpmjax.registration2d.pair_alignment import PairSystem, Schedule, linearise_pair
from dpmjax.registration2d.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration2d.range_profiles import RangeProfiles, make_profiles
from dpmjax.registration2d.step_prior import StepPrior
from dpmjax.registration2d.step_slides import slide_steps

# Beams of the sources are left out so that a round has fewer distances than this: about two seconds on two cores.
_ROUND_DISTANCES = 1.5e9
# Pairs that are linearised side by side: few enough for the cache, enough for all cores.
_PAIRS_AT_ONCE = 128
# The number of pairs is rounded up to a power of two up to this one, then to its multiples, so that few shapes compile.
_PAIRS_ROUNDED = 1024
# Gates and kernels of the rounds.
_ROUNDS = Schedule(gate=(0.09, 0.015), kernel=(0.06, 0.0015), num_iterations=14)
# Gauss-Newton steps that restore unconstrained directions after the adjustment to lines.
_NUM_RESTORATIONS = 3
# Offsets of the neighbours in time, of ordered scans; largest difference of heading of neighbours in space, radians.
_TEMPORAL, _MAX_TURN = (1, 2, 3), 2.0
_NO_EDGES = Edges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))


@dataclass(frozen=True)
class JointAlignmentConfig:
    """Settings of the joint alignment. Lengths are in typical ranges of the scans.

    Attributes:
        num_spatial: largest number of neighbours in space, each from another visit.
        radius: largest distance of neighbours in space.
        refresh: number of rounds after which the neighbours are chosen anew.
    """

    num_spatial: int = 8
    radius: float = 0.6
    refresh: int = 4


def align_all(scans: PlanarScans, poses: Floats, config: JointAlignmentConfig, prior: StepPrior | None) -> Floats:
    """Aligns all scans from nearby poses, point to line.

    Args:
        scans: n scans.
        poses: (n, 3) initial poses T_world_scan; the first one is fixed.
        config: settings.
        prior: of the steps of ordered scans; None: no prior.

    Returns:
        (n, 3) poses.
    """
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


def restore_open(
    profiles: RangeProfiles, aligned: Floats, adjusted: Floats, config: JointAlignmentConfig, prior: StepPrior
) -> Floats:
    """Restores relative poses along their unconstrained directions after an adjustment without constraints there.

    Args:
        profiles: n scans in time order.
        aligned: (n, 3) poses before the adjustment.
        adjusted: (n, 3) poses after it.
        config: settings.
        prior: of the steps.

    Returns:
        (n, 3) adjusted poses; along the unconstrained directions the relative poses are those of `aligned`.
    """
    scans, unit = profiles.scans, profiles.scans.typical_range
    pairs, poses = _choose_aligned(profiles, aligned, config, prior), adjusted
    if not len(pairs.held.source):
        return adjusted
    scale = tuple(x[-1] for x in _ROUNDS.gates_and_kernels(unit, 1.25 * scans.noise))
    edges, _ = _linearise(scans, pairs.source, pairs.target, adjusted, (scale[0], scale[1]))
    edges = edges._replace(information=pairs.across @ edges.information @ pairs.across)
    kept, information = se2.relative(aligned[pairs.held.target], aligned[pairs.held.source]), pairs.held.information
    # As much information as if all beams of a scan measured the unconstrained direction.
    information = information * (scans.mask.shape[1] / np.trace(information, axis1=1, axis2=2))[:, None, None]
    edges = join_edges(edges, Edges(pairs.held.source, pairs.held.target, kept, information))
    for _ in range(_NUM_RESTORATIONS):
        here = se2.relative(poses[edges.target], poses[edges.source])
        pull = np.einsum("eij,ej->ei", edges.information, se2.relative(edges.measurements, here))
        poses = se2.compose(poses, solve_step(len(poses), edges._replace(measurements=here), pull))
    return poses


class _AlignedPairs(NamedTuple):
    """Pairs of scans that are aligned (p), and the steps that the scans do not constrain.

    Attributes:
        source: (p,) rows.
        target: (p,) rows.
        across: (p, 3, 3) projections of tangents that remove the unconstrained direction of a pair.
        held: edges of open and of torn steps, see `held_steps`.
    """

    source: Indices
    target: Indices
    across: Floats
    held: Edges


def _choose_aligned(
    profiles: RangeProfiles, poses: Floats, config: JointAlignmentConfig, prior: StepPrior | None
) -> _AlignedPairs:
    """Chooses the pairs to align at these poses; instead of a torn step, `held` has its most probable shift."""
    scans, later = profiles.scans, np.arange(1, len(poses))
    source, target = choose_pairs(scans, poses, config)
    steps = se2.relative(poses[:-1], poses[1:])
    if prior is None:
        return _AlignedPairs(source, target, np.broadcast_to(np.eye(3), (len(source), 3, 3)), _NO_EDGES)
    slides = slide_steps(profiles, later, later - 1, steps, prior)
    crossed = np.append(0, np.cumsum(slides.is_torn))
    is_kept = (crossed[source] == crossed[target]) | (source - target > max(_TEMPORAL))
    source, target = source[is_kept], target[is_kept]
    relative = se2.relative(poses[target], poses[source])
    across = open_projections(slide_steps(profiles, source, target, relative), relative)
    return _AlignedPairs(source, target, across, held_steps(slides, poses, scans.typical_range))


def solve_step(num_poses: int, edges: Edges, gradient: Floats) -> Floats:
    """Computes one Gauss-Newton step of all poses in their own frames; the first pose is fixed.

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


def choose_pairs(scans: PlanarScans, poses: Floats, config: JointAlignmentConfig) -> tuple[Indices, Indices]:
    """Returns pairs (source, target) of neighbours in time and in space; of each visit of a place the nearest scan."""
    num_scans = len(poses)
    temporal = _TEMPORAL if scans.is_ordered else ()
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
        near = near[np.abs(se2.wrap_angle(poses[near, 2] - poses[scan, 2])) < _MAX_TURN]
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
    """Linearises all pairs at these poses, gate and kernel; their number is rounded up, so that few shapes compile."""
    relative = se2.relative(poses[target], poses[source])
    stride = max(1, int(np.ceil(len(source) * scans.mask.shape[1] ** 2 / _ROUND_DISTANCES)))
    filled = np.resize(np.arange(len(source)), _rounded_up(len(source)))
    pairs = source[filled], target[filled], relative[filled].astype(np.float32)
    system = _linearise_pairs(scans.replace(is_ordered=False), pairs, scale, source_stride=stride)
    system = jax.tree.map(lambda x: np.asarray(x, np.float64)[: len(source)], system)
    return Edges(source, target, relative, np.asarray(system.information)), system


def _rounded_up(num_pairs: int) -> int:
    """Returns the padded number of pairs."""
    if num_pairs > _PAIRS_ROUNDED:
        return _PAIRS_ROUNDED * -(-num_pairs // _PAIRS_ROUNDED)
    return max(_PAIRS_AT_ONCE, 1 << (num_pairs - 1).bit_length())
