"""Joint alignment of each scan with its neighbours in time and in space: sparse Gauss-Newton over all poses.

A pair of scans in a corridor constrains only the direction across the corridor. Along the corridor, the posterior of
the shift constrains open steps, and torn steps are set to their most probable shift (see `Slides`).

A loop over a long step, or a wrong pair in space, moves single scans away from their neighbours, beyond the basin of
convergence of an alignment. These steps are torn, too: their two scans fit each other before a refinement but not
after it. The pose graph is solved again with the previous relative poses of these steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, join_rows, take_rows
from dpmjax.pose_graph.normal_equations import solve_blocks
from dpmjax.scan.planar.align import Schedule, linearise_pairs
from dpmjax.scan.planar.compare import WEAK_SCORE, pair_scores
from dpmjax.scan.planar.motion_prior import StepPrior
from dpmjax.scan.planar.record import Floats, Indices, Pairs, PlanarScans
from dpmjax.scan.planar.slide import Slides, held_steps, pose_steps, prior_steps, slide_steps

# Gates and kernels of the rounds, and number of rounds after which the neighbours are chosen anew.
_ROUNDS, _REFRESH = Schedule(gate=(0.09, 0.015), kernel=(0.06, 0.0015), num_iterations=14), 4
# Gauss-Newton steps that restore unconstrained directions after the adjustment to lines, and torn steps.
_NUM_OPEN_ROUNDS, _NUM_TORN_ROUNDS = 3, 5
# A step is torn by a refinement where its score has fallen by this much, from a score that was not weak. Least weight
# of a step, whose score may be negative.
_LOST_SCORE, _LEAST_WEIGHT = 0.25, 0.01
# Two scans are aligned if they are at most this far apart, in typical ranges, and their headings differ by less than
# this, radians: farther ones share few walls. Number of nearest scans of each scan.
_RADIUS, _MAX_TURN, _NUM_NEAREST = 0.6, 2.0, 8


def align_all(scans: PlanarScans, poses: Floats, prior: StepPrior | None) -> Floats:
    """Aligns all scans from nearby poses, point to line.

    Args:
        scans: n scans.
        poses: (n, 3) initial poses T_world_scan; the first one is fixed.
        prior: of the steps of ordered scans; None: no prior.

    Returns:
        (n, 3) poses.
    """
    scales = _ROUNDS.gates_and_kernels(scans.typical_range, 1.25 * scans.noise)
    expected = pose_steps(poses, scans.typical_range) if prior is None else prior_steps(prior)
    # In units of one beam's information, as the systems of the pairs are.
    trust = 1e-9 if prior is None else max(scans.noise, 0.00075 * scans.typical_range) ** 2
    for round_number, scale in enumerate(scales):
        if round_number % _REFRESH == 0:
            pairs = _choose_aligned(scans, poses, prior)
            steps = join_rows(expected, pairs.held)
            steps = steps._replace(information=trust * steps.information)
        edges, gradient = _linearise(scans, pairs, poses, scale)
        held, pull = _linearise_edges(steps, poses)
        poses = se2.compose(poses, solve_step(len(poses), join_rows(edges, held), np.concatenate([gradient, pull])))
    return poses


def restore_open(scans: PlanarScans, aligned: Floats, adjusted: Floats, prior: StepPrior) -> Floats:
    """Restores relative poses along unconstrained directions after an adjustment that has changed them.

    Args:
        scans: n scans in time order.
        aligned: (n, 3) poses before the adjustment.
        adjusted: (n, 3) poses after it.
        prior: of the steps.

    Returns:
        (n, 3) adjusted poses; along the unconstrained directions the relative poses are those of `aligned`.
    """
    pairs = _choose_aligned(scans, aligned, prior)
    if not len(pairs.held.source):
        return adjusted
    scale = _ROUNDS.gates_and_kernels(scans.typical_range, 1.25 * scans.noise)[-1]
    edges, _ = _linearise(scans, pairs, adjusted, scale)
    kept, information = se2.relative(aligned[pairs.held.target], aligned[pairs.held.source]), pairs.held.information
    # As much information as if all beams of a scan measured the unconstrained direction.
    information = information * (scans.mask.shape[1] / np.trace(information, axis1=1, axis2=2))[:, None, None]
    edges = join_rows(edges, pairs.held._replace(measurements=kept, information=information))
    return _relax(edges, adjusted, _NUM_OPEN_ROUNDS)


def restore_torn(scans: PlanarScans, steps: Floats, poses: Floats, prior: StepPrior) -> Floats | None:
    """Restores torn steps and distributes the difference over the pairs that constrain the map.

    Args:
        scans: n scans in time order.
        steps: (n - 1, 3) T_scan_next before the refinement.
        poses: (n, 3) T_world_scan after the refinement.
        prior: prior of the steps. If a step is torn in `Slides` with this prior, it is shifted to its mode.

    Returns:
        (n, 3) T_world_scan, to be aligned again; None if no step is torn.
    """
    later, kept = np.arange(1, len(poses)), np.asarray(se2.relative(poses[:-1], poses[1:]))
    before, after = (pair_scores(scans, later, later - 1, found) for found in (steps, kept))
    is_lost = (before > WEAK_SCORE) & (after < before - _LOST_SCORE)
    slides = slide_steps(scans, kept, prior)
    is_slid = slides.is_torn & (slides.scores > WEAK_SCORE) & ~is_lost
    if not (is_lost | is_slid).any():
        return None
    weights = np.select([is_slid, is_lost], [slides.scores, before], np.maximum(after, _LEAST_WEIGHT))
    restored = np.select([is_slid[:, None], is_lost[:, None]], [slides.moved(kept), steps], kept)
    return _relax_steps(scans, poses, _fitting_pairs(scans, poses), restored, weights)


def restore_slid(scans: PlanarScans, poses: Floats, slides: Slides) -> Floats:
    """Puts slid steps back to their modes, and distributes the difference over the pairs that do not cross them.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.
        slides: slides of their steps, from `slid_steps`.

    Returns:
        (n, 3) T_world_scan. Do not align them again, because the steps would slide again.
    """
    steps = np.asarray(se2.relative(poses[:-1], poses[1:]))
    is_moved = slides.is_torn & (slides.scores > WEAK_SCORE)
    pairs = _fitting_pairs(scans, poses)
    crossed = np.append(0, np.cumsum(is_moved))
    # Pairs up to this number of steps apart that cross a slid step have slid with it.
    # Scans that have collapsed onto each other hold each other there.
    is_kept = (crossed[pairs.source] == crossed[pairs.target]) | (np.abs(pairs.source - pairs.target) > 20)
    restored = np.where(is_moved[:, None], slides.moved(steps), steps)
    return _relax_steps(scans, poses, take_rows(pairs, is_kept), restored, np.maximum(slides.scores, _LEAST_WEIGHT))


def _relax_steps(scans: PlanarScans, poses: Floats, pairs: Edges, steps: Floats, weights: Floats) -> Floats:
    """Relaxes pairs and weighted steps together; the information of `pairs` is their weights, too."""
    later = np.arange(1, len(poses))
    edges = join_rows(pairs, Edges(later, later - 1, steps, weights))
    scale = np.diag([1.0, 1.0, scans.typical_range**2])
    return _relax(edges._replace(information=edges.information[:, None, None] * scale), poses, _NUM_TORN_ROUNDS)


def _fitting_pairs(scans: PlanarScans, poses: Floats) -> Edges:
    """Returns edges of the pairs that fit, without steps; their information is the scores (e,)."""
    source, target = choose_pairs(poses, _RADIUS * scans.typical_range)
    is_pair = source != target + 1
    source, target = source[is_pair], target[is_pair]
    relative = np.asarray(se2.relative(poses[target], poses[source]))
    scores = pair_scores(scans, source, target, relative)
    fits = scores > WEAK_SCORE
    return Edges(source[fits], target[fits], relative[fits], scores[fits])


def _linearise_edges(edges: Edges, poses: Floats) -> tuple[Edges, Floats]:
    """Returns the edges at the relative poses of these poses, and J^T W r (e, 3), as `solve_step` takes them."""
    here = se2.relative(poses[edges.target], poses[edges.source])
    pull = np.einsum("eij,ej->ei", edges.information, se2.relative(edges.measurements, here))
    return edges._replace(measurements=here), pull


def _relax(edges: Edges, poses: Floats, num_rounds: int) -> Floats:
    """Returns the poses after Gauss-Newton steps towards the measurements of the edges."""
    for _ in range(num_rounds):
        poses = np.asarray(se2.compose(poses, solve_step(len(poses), *_linearise_edges(edges, poses))))
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


def _choose_aligned(scans: PlanarScans, poses: Floats, prior: StepPrior | None) -> _AlignedPairs:
    """Chooses the pairs to align at these poses; instead of a torn step, `held` has its most probable shift."""
    source, target = choose_pairs(poses, _RADIUS * scans.typical_range)
    if prior is None:
        none = take_rows(pose_steps(poses, scans.typical_range), np.zeros(0, np.int64))
        return _AlignedPairs(source, target, np.broadcast_to(np.eye(3), (len(source), 3, 3)), none)
    slides = slide_steps(scans, se2.relative(poses[:-1], poses[1:]), prior)
    crossed = np.append(0, np.cumsum(slides.is_torn))
    # A pair of scans more steps apart may cross a torn step.
    is_kept = (crossed[source] == crossed[target]) | (source - target > 3)
    source, target = source[is_kept], target[is_kept]
    relative = se2.relative(poses[target], poses[source])
    across = np.eye(3) - slide_steps(scans, relative, pairs=(source, target)).open_directions(relative)
    return _AlignedPairs(source, target, across, held_steps(slides, poses))


def solve_step(num_poses: int, edges: Edges, gradient: Floats) -> Floats:
    """Computes one Gauss-Newton step of all poses in their own frames; the first pose is fixed.

    Args:
        num_poses: n.
        edges: relative poses of the linearised system, with J^T W J as information.
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


def choose_pairs(poses: Floats, radius: float) -> Pairs:
    """Returns pairs (source, target) of each scan and its nearest scans.

    Args:
        poses: (n, 3).
        radius: largest distance of a pair, unit of the poses.

    Returns:
        Rows of the sources and of the targets.
    """
    tree, count = scipy.spatial.cKDTree(poses[:, :2]), min(len(poses), 6 * _NUM_NEAREST)
    distances, rows = (np.atleast_2d(x) for x in tree.query(poses[:, :2], k=count, distance_upper_bound=radius))
    turns = np.abs(se2.wrap_angle(poses[np.minimum(rows, len(poses) - 1), 2] - poses[:, None, 2]))
    is_near = np.isfinite(distances) & (rows != np.arange(len(poses))[:, None]) & (turns < _MAX_TURN)
    source, column = np.nonzero(is_near & (np.cumsum(is_near, axis=1) <= _NUM_NEAREST))
    return source.astype(np.int64), rows[source, column].astype(np.int64)


def _linearise(scans: PlanarScans, pairs: _AlignedPairs, poses: Floats, scale: Floats) -> tuple[Edges, Floats]:
    """Linearises all pairs at these poses, gate and kernel."""
    source, target, across, _ = pairs
    relative = se2.relative(poses[target], poses[source])
    # Beams of the sources are left out so that a round has fewer distances than this: about two seconds on two cores.
    stride = max(1, int(np.ceil(len(source) * scans.mask.shape[1] ** 2 / 1.5e9)))
    information, gradient = linearise_pairs(scans, source, target, relative, scale, stride=stride)
    return Edges(source, target, relative, across @ information @ across), np.einsum("eij,ej->ei", across, gradient)
