"""Loop closure: matches scans far apart in time, independent of drift, and solves a pose graph with the matches.

A single pair of half-circle scans in a corridor fits at many wrong poses. Three measures make a loop reliable. The
target is a small submap of several scans. Neighbouring loops must agree. The robust graph rejects loops that contradict
it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, PoseGraph, join_rows, take_rows
from dpmjax.pose_graph.optimize import ROBUST, optimize_pose_graph
from dpmjax.scan.planar.align import PairMatches, PairPrior, Schedule, fan, match_pairs
from dpmjax.scan.planar.compare import contradicted_share, weak_steps
from dpmjax.scan.planar.record import Floats, Indices, Pairs, PlanarScans
from dpmjax.scan.planar.slide import BEAM_DEVIATION, pose_steps

_SEARCH = Schedule(gate=(0.18, 0.045), kernel=(0.09, 0.0225), num_iterations=7, source_beams=36, target_beams=300)
_REFINE = Schedule(gate=(0.075, 0.0225), kernel=(0.0225, 0.0045), num_iterations=10, source_beams=180, target_beams=450)
# Number of candidates that are matched at a time, all batches of one shape.
_BATCH = 512
# Two views that overlap well are nearer than twice this, in typical ranges, in addition to the drift.
_NEARBY = 0.15
# Largest distance of a candidate, and least distance travelled between the two scans of a loop, in typical ranges.
_MAX_RADIUS, _MIN_WAY = 2.25, 2.25
# Largest number of candidates in a round.
_MAX_CANDIDATES = 2000
# Number of scans before and after the target that its submap holds.
_SUBMAP_WIDTH = 2
# Least robust share of matched beams, and largest share of beams that contradict their partner scan.
_MIN_FITNESS, _MAX_CONTRADICTED = 0.4, 0.08
# Share of the beams that the weakest eigenvalue of a pair must reach.
_MIN_EIGENVALUE = 0.03
# Least number of agreeing loops; largest number of scans between them; and the limits of agreement: translation in
# typical ranges, radians.
_MIN_SUPPORT, _NEIGHBOURHOOD, _AGREEMENT = 2, 6, (0.045, 0.08)
# Number of searches, each from the corrected poses of the previous one. Error of a relative pose as a share of the
# travelled distance: a larger one finds loops after more drift, among more candidates.
_NUM_ROUNDS, _DRIFT = 3, 0.05


class LoopResult(NamedTuple):
    """Result of `correct_by_loops`.

    Attributes:
        poses: (n, 3) corrected T_world_scan.
        loops: edges of the last round.
        weights: their final weights, 0 (rejected) to 1.
    """

    poses: Floats
    loops: Edges
    weights: Floats


def correct_by_loops(scans: PlanarScans, poses: Floats, steps: Edges | None = None) -> LoopResult:
    """Corrects the drift of a trajectory by loop closures.

    Args:
        scans: n scans in time order.
        poses: (n, 3) initial poses T_world_scan: locally correct, with drift.
        steps: edges between neighbours in time; None: those of `poses`.

    Returns:
        LoopResult; without a loop the poses are the initial ones.
    """
    steps = steps or pose_steps(poses, scans.typical_range)
    loops = take_rows(steps, np.zeros(0, np.int64))
    # The graph may reject a step with a weak score like a loop.
    is_weak = weak_steps(scans, poses, np.arange(len(poses)))
    # Weight of a step relative to a loop: number of loops that must contradict a step before the graph rejects it.
    step_trust = np.where(is_weak, 1.0, 30.0)
    found, weights, tried = loops, np.zeros(0), dict[tuple[int, int], Floats]()
    for _ in range(_NUM_ROUNDS):
        new = _untried(find_candidates(poses, scans.typical_range), poses, tried, scans.typical_range)
        more = _find_loops(scans, poses, new)
        is_matched_again = np.isin(found.source * len(poses) + found.target, more.source * len(poses) + more.target)
        found = join_rows(take_rows(found, ~is_matched_again), more)
        loops = take_rows(found, count_support(found, poses, scans.typical_range) >= _MIN_SUPPORT)
        if not len(more.source) or not len(loops.source):
            break
        trust = np.append(step_trust, np.ones(len(loops.source)))
        solved = optimize_pose_graph(PoseGraph.create(poses, join_rows(steps, loops)), ROBUST, trust=trust)
        poses, weights = solved.graph.poses, solved.weights[len(steps.source) :]
    return LoopResult(poses, loops, weights)


def _untried(pairs: Pairs, poses: Floats, tried: dict[tuple[int, int], Floats], typical_range: float) -> Pairs:
    """Returns the pairs that were not matched from a similar relative pose before, and records them in `tried`."""
    source, target = pairs
    predicted = se2.relative(poses[target], poses[source])
    names = list(zip(source.tolist(), target.tolist(), strict=True))
    before = np.array([tried.get(name, np.full(3, np.inf)) for name in names]).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        # A pair is matched again where its relative pose was corrected by more than `_NEARBY`, or by this turn.
        is_new = ~se2.is_within(predicted - before, _NEARBY * typical_range, 0.15)
    tried.update((name, pose) for name, pose, new in zip(names, predicted, is_new, strict=True) if new)
    return source[is_new], target[is_new]


def _find_loops(scans: PlanarScans, poses: Floats, pairs: Pairs) -> Edges:
    """Matches pairs of scans of one trajectory and returns those that fit."""
    unit, (source, target) = scans.typical_range, pairs
    matches = PairMatches(np.zeros((len(source), 3)), np.zeros(len(source)), np.zeros((len(source), 3, 3)))
    for start in range(0, len(source), _BATCH):
        part = slice(start, start + _BATCH)
        for kept, found in zip(matches, _match(scans, poses, source[part], target[part]), strict=True):
            kept[part] = found
    fits = matches.fitness > _MIN_FITNESS
    fits &= matches.weakest_eigenvalue() > _MIN_EIGENVALUE * scans.num_on_line[source] * _REFINE.source_share(scans)
    fits[fits] = contradicted_share(scans, source[fits], target[fits], matches.poses[fits]) < _MAX_CONTRADICTED
    # A beam that was left out would measure as much as those beside it.
    information = matches.information[fits] / _REFINE.source_share(scans) / (BEAM_DEVIATION * unit) ** 2
    return Edges(source[fits], target[fits], matches.poses[fits], information)


def find_candidates(poses: Floats, typical_range: float) -> Pairs:
    """Finds pairs of scans that may overlap: a later one (source) and an earlier one (target)."""
    way, nearby = se2.driven_lengths(poses), 2.0 * _NEARBY * typical_range
    radius = min(_MAX_RADIUS * typical_range, nearby + _DRIFT * way[-1])
    first, second = scipy.spatial.cKDTree(poses[:, :2]).query_pairs(radius, output_type="ndarray").T
    apart = way[second] - way[first]
    distance = np.hypot(*(poses[second, :2] - poses[first, :2]).T)
    keep = (apart > _MIN_WAY * typical_range) & (distance < nearby + _DRIFT * apart) & (second - first > 5)
    source, target = second[keep], first[keep]
    if len(source) > _MAX_CANDIDATES:
        # Nearer pairs overlap more often; random factors on their distances keep some far pairs among the candidates.
        rng = np.random.default_rng(0)
        order = np.argsort(distance[keep] * rng.uniform(0.1, 1.0, len(source)))[:_MAX_CANDIDATES]
        source, target = source[np.sort(order)], target[np.sort(order)]
    return source.astype(np.int64), target.astype(np.int64)


def _match(scans: PlanarScans, poses: Floats, source: Indices, target: Indices) -> PairMatches:
    """Matches scans to submaps around their targets, one batch of candidates."""
    unit, way = scans.typical_range, se2.driven_lengths(poses)
    submaps, ones = _build_submaps(scans, poses, target), scans.take(source)
    predicted = se2.relative(poses[target], poses[source])
    # The prior has the standard deviation of the drift: it constrains the position along a corridor.
    sigma = 0.045 * unit + 0.5 * _DRIFT * (way[source] - way[target])
    belief = np.stack([sigma, sigma, np.full_like(sigma, np.inf)], axis=-1) ** -2.0
    prior = PairPrior(predicted, (0.015 * unit) ** 2 * belief)
    matches = match_pairs(ones, submaps, _guesses(predicted, unit), _SEARCH, prior)
    # A finer kernel lowers the fitness.
    rows = np.flatnonzero(matches.fitness > _MIN_FITNESS)
    prior = PairPrior(predicted[rows], (3.0 * scans.noise) ** 2 * belief[rows])
    fine = match_pairs(ones.take(rows), submaps.take(rows), matches.poses[rows][:, None], _REFINE, prior)
    for kept, found in zip(matches, fine, strict=True):
        kept[rows] = found
    matches.fitness[matches.fitness <= _MIN_FITNESS] = 0.0
    return matches


def _guesses(predicted: Floats, typical_range: float) -> Floats:
    """Returns guesses (p, h, 3) of each pair: near shifts, with headings around the predicted one."""
    around = fan(np.radians([0.0, -12.0, 12.0]), (0.0, 1.5 * _NEARBY * typical_range), 4)
    guesses = around + predicted[:, None] * [0.0, 0.0, 1.0]
    return np.concatenate([guesses, predicted[:, None]], axis=1)


def _build_submaps(scans: PlanarScans, poses: Floats, centres: Indices) -> PlanarScans:
    """Builds a submap in the frame of each centre scan: some scans before and after it, the nearest first."""
    rows = centres[:, None] + np.array(sorted(range(-_SUBMAP_WIDTH, _SUBMAP_WIDTH + 1), key=abs))
    is_there = (rows >= 0) & (rows < len(poses))
    rows = np.clip(rows, 0, len(poses) - 1)
    relative, there = se2.relative(poses[centres][:, None], poses[rows]).astype(np.float32), is_there[..., None]
    points, centroids = (se2.transform_points(relative, x[rows]) for x in (scans.points, scans.centroids))
    normals = se2.transform_points(relative * np.array([0.0, 0.0, 1.0], np.float32), scans.normals[rows])
    arrays = points, scans.mask[rows] & there, normals, centroids, scans.is_on_line[rows] & there
    points, mask, normals, centroids, is_on_line = (x.reshape(len(rows), -1, *x.shape[3:]) for x in arrays)
    return PlanarScans(points, mask, normals, centroids, is_on_line, scans.noise, scans.typical_range, False)


def count_support(edges: Edges, poses: Floats, typical_range: float) -> Indices:
    """Counts the neighbouring loops that agree with each loop through the trajectory between them."""
    near = np.abs(edges.source[:, None] - edges.source) <= _NEIGHBOURHOOD
    near &= np.abs(edges.target[:, None] - edges.target) <= _NEIGHBOURHOOD
    near &= (edges.source[:, None] != edges.source) | (edges.target[:, None] != edges.target)
    one, other = np.nonzero(near)
    step_target = se2.relative(poses[edges.target[one]], poses[edges.target[other]])
    step_source = se2.relative(poses[edges.source[other]], poses[edges.source[one]])
    through = se2.compose(se2.compose(step_target, edges.measurements[other]), step_source)
    error = se2.relative(edges.measurements[one], through)
    agrees = se2.is_within(error, _AGREEMENT[0] * typical_range, _AGREEMENT[1])
    return np.bincount(one[agrees], minlength=len(edges.source))
