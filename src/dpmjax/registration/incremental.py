"""Incremental ICP: every scan against the one before, then the steps chained. The usual warm start of DeepMapping."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from dpmjax.geometry import se2
from dpmjax.registration.pair_alignment import COARSE, FINE, Metric, PairMatches, PosePrior, match_pairs
from dpmjax.registration.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration.range_profiles import contradicted_share, make_profiles

# Share of the typical range that a coarse match is off by; and that of a direction that the scans leave open.
_COARSE_RESIDUAL = 0.015
_OPEN_RESIDUAL = 0.0075


# Distance of the turns that are tried, degrees: the basin of one alignment is about as wide. The largest turn between
# two scans that is searched when the small ones do not fit.
_TURN_STEP, _MAX_TURN = 15.0, 90.0
# A pair with a better fitness is not searched further; one with a lower fitness even then is searched at longer steps.
_GOOD_FITNESS, _POOR_FITNESS = 0.75, 0.4
# Clear steps predict the translation of an open one if their turns differ by less, in radians.
_SIMILAR_TURN = 0.15
# Steps whose fitness less twice the contradicted share is below this are bridged.
_POOR_QUALITY = 0.2
# A step is open if its weakest eigenvalue is below this share of the beams.
_MIN_EIGENVALUE = 0.01
# Standard deviation of a step of the odometry: of its translation in typical ranges, and of its turn as the weight of a
# beam sees it.
_ODOMETRY_SIGMA = (0.0225, 0.015)


class IncrementalResult(NamedTuple):
    """Result of `incremental_icp`.

    Attributes:
        poses: (n, 3) T_world_scan, the first one zero.
        steps: the n - 1 matched steps T_scan_next.
    """

    poses: Floats
    steps: PairMatches


def incremental_icp(
    scans: PlanarScans, metric: Metric = "plane", *, odometry: Floats | None = None
) -> IncrementalResult:
    """Registers each scan to the one before and chains the steps.

    Without odometry, scans that fit no neighbour (a passer-by, a swapped line of the log) are bridged: the poses follow
    the best matches around them.

    Args:
        scans: n scans in time order.
        metric: distance to lines ("plane") or to points ("point").
        odometry: (n, 3) raw poses. Their steps serve as guesses and as prior; without them the steps are searched.

    Returns:
        IncrementalResult.
    """
    unit = scans.typical_range
    source, target = scans.take(slice(1, None)), scans.take(slice(len(scans) - 1))
    if len(scans) == 1:
        return IncrementalResult(np.zeros((1, 3)), match_pairs(source, target, np.zeros((0, 1, 3)), FINE))
    if odometry is None:
        rough, prior = _search_steps(source, target, metric)
    else:
        rough, prior = _match_odometry(source, target, se2.relative(odometry[:-1], odometry[1:]), metric)
    # Where the scans fix a step, the prior is weighed against their noise alone; an open step leans on the prior.
    num_beams = np.maximum(np.asarray(source.is_on_line.sum(1)), 1)
    is_open = rough.weakest_eigenvalue() < _MIN_EIGENVALUE * num_beams / COARSE.source_stride
    residual = np.where(is_open, _OPEN_RESIDUAL * unit, 3.0 * scans.noise) / (_COARSE_RESIDUAL * unit)
    prior = PosePrior(prior.mean, np.asarray(prior.information) * residual[:, None] ** 2)
    predicted = np.concatenate([np.asarray(prior.mean)[:, :2], rough.poses[:, 2:]], axis=1)
    guesses = np.stack([rough.poses, np.where(is_open[:, None], predicted, rough.poses)], axis=1)
    steps = match_pairs(source, target, guesses, FINE, prior, metric=metric)
    poses = se2.chain(steps.poses) if odometry is not None else _bridge_bad_scans(scans, steps, metric)
    return IncrementalResult(poses, steps)


def _match_odometry(
    source: PlanarScans, target: PlanarScans, guess: Floats, metric: Metric
) -> tuple[PairMatches, PosePrior]:
    """Coarse matches around the steps of the odometry, and these steps as prior."""
    sigma = np.array(_ODOMETRY_SIGMA)[[0, 0, 1]] / _COARSE_RESIDUAL
    prior = PosePrior(guess, np.broadcast_to(sigma**-2.0, guess.shape))
    fan = np.radians(_TURN_STEP) * np.outer([0.0, -0.5, 0.5, -1.5, 1.5], [0.0, 0.0, 1.0])
    return match_pairs(source, target, guess[:, None] + fan, COARSE, prior, metric=metric), prior


def _search_steps(source: PlanarScans, target: PlanarScans, metric: Metric) -> tuple[PairMatches, PosePrior]:
    """Coarse matches from small motions, then from larger ones where the fitness is poor; and the prior of them all."""
    unit = source.typical_range
    fan = np.radians(_TURN_STEP) * np.outer([0.0, -0.5, 0.5], [0.0, 0.0, 1.0])
    rough = match_pairs(source, target, np.broadcast_to(fan, (len(source), 3, 3)), COARSE, metric=metric)
    prior = _predict_open_steps(rough, unit)
    # Around the predicted translations, then far from zero.
    near, far = _fan(unit, (0.0, 0.15), 4), _fan(unit, (0.3, 0.525), 8, turn_share=0.5)
    centre = np.asarray(prior.mean) * [1.0, 1.0, 0.0]
    for limit, fan, middle in ((_GOOD_FITNESS, near, centre), (_POOR_FITNESS, far, 0.0 * centre)):
        rows = np.flatnonzero(rough.fitness < limit)
        if not len(rows):
            continue
        belief = PosePrior(prior.mean[rows], prior.information[rows])
        guesses = middle[rows][:, None] + fan
        wide = match_pairs(source.take(rows), target.take(rows), guesses, COARSE, belief, metric=metric)
        better = wide.fitness > rough.fitness[rows]
        for kept, found in zip(rough, wide, strict=True):
            kept[rows[better]] = found[better]
    return rough, _predict_open_steps(rough, unit)


def _fan(typical_range: float, radii: tuple[float, ...], num_ways: int, *, turn_share: float = 1.0) -> Floats:
    """Guesses (h, 3) of a step: every turn at every shift by `radii` (typical ranges) in `num_ways` directions."""
    last = turn_share * _MAX_TURN
    turns = np.radians(np.arange(-last, last + 1e-6, _TURN_STEP))
    ways = 2 * np.pi * np.arange(num_ways) / num_ways
    shifts = [(r * np.cos(w), r * np.sin(w)) for r in radii for w in (ways if r else ways[:1])]
    return np.array([(typical_range * x, typical_range * y, turn) for turn in turns for x, y in shifts])


def _predict_open_steps(matches: PairMatches, typical_range: float) -> PosePrior:
    """A prior for steps that the scans leave open: the median translation of the clear steps with a similar turn.

    In a corridor two scans fit at every shift along it; a robot that has made straight steps of one metre elsewhere
    will have made another one there.

    Returns:
        PosePrior of the translations; without five clear steps it is no belief.
    """
    eigenvalue = matches.weakest_eigenvalue()
    is_clear = (eigenvalue >= np.median(eigenvalue)) & (matches.fitness >= np.median(matches.fitness))
    clear, turns = matches.poses[is_clear], matches.poses[:, 2]
    mean, information = np.zeros((len(turns), 3)), np.zeros((len(turns), 3))
    for row, turn in enumerate(turns):
        alike = clear[np.abs(se2.wrap_angle(clear[:, 2] - turn)) < _SIMILAR_TURN]
        alike = alike if len(alike) >= 5 else clear
        if len(alike) >= 5:
            mean[row, :2] = np.median(alike[:, :2], axis=0)
            spread = 1.4826 * np.median(np.abs(alike[:, :2] - mean[row, :2]), axis=0) / typical_range
            information[row, :2] = (_COARSE_RESIDUAL / (spread + 0.015)) ** 2
    return PosePrior(mean, information)


def _bridge_bad_scans(scans: PlanarScans, steps: PairMatches, metric: Metric) -> Floats:
    """Poses through the best matches, around scans that fit no neighbour.

    Where a step is poor, the scans on either side are matched across it, two and three apart. The poses then follow the
    spanning tree of the most trustworthy matches instead of the plain chain, so that a bad scan is a leaf.

    Returns:
        (n, 3) poses, the first one zero.
    """
    later, profiles = np.arange(1, len(scans)), make_profiles(scans)

    def quality(source: Indices, target: Indices, matches: PairMatches) -> Floats:
        return matches.fitness - 2.0 * contradicted_share(profiles, source, target, matches.poses)

    links = [(later, later - 1, steps.poses, quality(later, later - 1, steps))]
    poor = np.flatnonzero(links[0][3] < _POOR_QUALITY)
    if not len(poor):
        return se2.chain(steps.poses)
    fan = _fan(scans.typical_range, (0.0, 0.225, 0.45), 8)
    for apart in (2, 3):
        # All pairs that span a poor step.
        target = np.unique(np.concatenate([poor - k for k in range(apart)]))
        target = target[(target >= 0) & (target + apart < len(scans))]
        one, other = scans.take(target + apart), scans.take(target)
        guesses = np.broadcast_to(fan, (len(target), *fan.shape))
        for schedule in (COARSE, FINE):
            found = match_pairs(one, other, guesses, schedule, metric=metric)
            guesses = found.poses[:, None]
        links.append((target + apart, target, found.poses, quality(target + apart, target, found)))
    return _follow_tree(len(scans), *(np.concatenate(x) for x in zip(*links, strict=True)))


def _follow_tree(num_scans: int, source: Indices, target: Indices, poses: Floats, quality: Floats) -> Floats:
    """Poses from the first scan on, along the spanning tree of the best links, T_target_source each."""
    cost = 2.0 - np.clip(quality, -0.9, 1.0)
    graph = scipy.sparse.csr_matrix((cost, (source, target)), shape=(num_scans, num_scans))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    order, parents = scipy.sparse.csgraph.breadth_first_order(tree, 0, directed=False)
    step_of = dict(zip(zip(source.tolist(), target.tolist(), strict=True), poses, strict=True))
    step_of |= {(j, i): se2.inverse(pose) for (i, j), pose in step_of.items()}
    world = np.zeros((num_scans, 3))
    for scan in order[1:].tolist():
        world[scan] = se2.compose(world[parents[scan]], step_of[scan, int(parents[scan])])
    return world
