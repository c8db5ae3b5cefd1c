"""Incremental ICP: every scan against the one before, then the steps chained. The usual warm start of DeepMapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from dpmjax.geometry import se2
from dpmjax.registration.pair_alignment import COARSE, FINE, Metric, PairMatches, PosePrior, match_pairs
from dpmjax.registration.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration.range_profiles import RangeProfiles, compare_pairs, make_profiles

# Share of the typical range that a coarse match is off by; and that of a direction that the scans leave open.
_COARSE_RESIDUAL = 0.015
_OPEN_RESIDUAL = 0.0075


@dataclass(frozen=True)
class IncrementalConfig:
    """Settings of the incremental registration.

    Attributes:
        metric: distance to lines ("plane") or to points.
        max_turn_deg: largest turn between two scans that is searched when the small ones do not fit.
        turn_step_deg: distance of the turns that are tried; the basin of one alignment is about as wide.
        good_fitness: a pair with a better fitness is not searched further.
        poor_fitness: a pair with a lower fitness even then is searched at longer steps.
        similar_turn: clear steps predict the translation of an open one if their turns differ by less, in radians.
        poor_quality: steps whose fitness less twice the contradicted share is below this are bridged.
        min_eigenvalue: a step is open if its weakest eigenvalue is below this share of the beams.
        odometry_sigma: standard deviation of a step of the odometry in typical ranges: of its translation, and of its
            turn as the weight of a beam sees it.
    """

    metric: Metric = "plane"
    max_turn_deg: float = 90.0
    turn_step_deg: float = 15.0
    good_fitness: float = 0.75
    poor_fitness: float = 0.4
    similar_turn: float = 0.15
    poor_quality: float = 0.2
    min_eigenvalue: float = 0.01
    odometry_sigma: tuple[float, float] = (0.0225, 0.015)


class IncrementalResult(NamedTuple):
    """Result of `incremental_icp`.

    Attributes:
        poses: (n, 3) T_world_scan, the first one zero.
        steps: the n - 1 matched steps T_scan_next.
    """

    poses: Floats
    steps: PairMatches


def incremental_icp(
    scans: PlanarScans, config: IncrementalConfig | None = None, *, odometry: Floats | None = None
) -> IncrementalResult:
    """Registers each scan to the one before and chains the steps.

    Without odometry, scans that fit no neighbour (a passer-by, a swapped line of the log) are bridged: the poses follow
    the best matches around them.

    Args:
        scans: n scans in time order.
        config: settings.
        odometry: (n, 3) raw poses. Their steps serve as guesses and as prior; without them the steps are searched.

    Returns:
        IncrementalResult.
    """
    config = config or IncrementalConfig()
    unit = scans.typical_range
    source, target = scans.take(slice(1, None)), scans.take(slice(len(scans) - 1))
    if len(scans) == 1:
        return IncrementalResult(np.zeros((1, 3)), match_pairs(source, target, np.zeros((0, 1, 3)), FINE))
    if odometry is None:
        rough, prior = _search_steps(source, target, config)
    else:
        rough, prior = _match_odometry(source, target, se2.relative(odometry[:-1], odometry[1:]), config)
    # Where the scans fix a step, the prior is weighed against their noise alone; an open step leans on the prior.
    num_beams = np.maximum(np.asarray(source.is_on_line.sum(1)), 1)
    is_open = rough.weakest_eigenvalue() < config.min_eigenvalue * num_beams / COARSE.source_stride
    residual = np.where(is_open, _OPEN_RESIDUAL * unit, 3.0 * scans.noise) / (_COARSE_RESIDUAL * unit)
    prior = PosePrior(prior.mean, np.asarray(prior.information) * residual[:, None] ** 2)
    predicted = np.concatenate([np.asarray(prior.mean)[:, :2], rough.poses[:, 2:]], axis=1)
    guesses = np.stack([rough.poses, np.where(is_open[:, None], predicted, rough.poses)], axis=1)
    steps = match_pairs(source, target, guesses, FINE, prior, metric=config.metric)
    poses = se2.chain(steps.poses) if odometry is not None else _bridge_bad_scans(scans, steps, config)
    return IncrementalResult(poses, steps)


def _match_odometry(
    source: PlanarScans, target: PlanarScans, guess: Floats, config: IncrementalConfig
) -> tuple[PairMatches, PosePrior]:
    """Coarse matches around the steps of the odometry, and these steps as prior."""
    sigma = np.array(config.odometry_sigma)[[0, 0, 1]] / _COARSE_RESIDUAL
    prior = PosePrior(guess, np.broadcast_to(sigma**-2.0, guess.shape))
    turns = np.radians(config.turn_step_deg) * np.array([0.0, -0.5, 0.5, -1.5, 1.5])
    fan = np.stack([0 * turns, 0 * turns, turns], -1)
    return match_pairs(source, target, guess[:, None] + fan, COARSE, prior, metric=config.metric), prior


def _search_steps(source: PlanarScans, target: PlanarScans, config: IncrementalConfig) -> tuple[PairMatches, PosePrior]:
    """Coarse matches from small motions, then from larger ones where the fitness is poor; and the prior of them all."""
    turns = np.radians(config.turn_step_deg) * np.array([0.0, -0.5, 0.5])
    guesses = np.broadcast_to(np.stack([0 * turns, 0 * turns, turns], -1), (len(source), 3, 3))
    rough = match_pairs(source, target, guesses, COARSE, metric=config.metric)
    prior = _predict_open_steps(rough, config, source.typical_range)
    near = _fan(config, source.typical_range, (0.0, 0.15), 4)
    far = _fan(config, source.typical_range, (0.3, 0.525), 8, turn_share=0.5)
    for limit, fan, is_centred in ((config.good_fitness, near, True), (config.poor_fitness, far, False)):
        rows = np.flatnonzero(rough.fitness < limit)
        if not len(rows):
            continue
        centre = np.asarray(prior.mean)[rows][:, None] * [1.0, 1.0, 0.0] if is_centred else 0.0
        guesses = centre + np.broadcast_to(fan, (len(rows), *fan.shape))
        belief = PosePrior(prior.mean[rows], prior.information[rows])
        wide = match_pairs(source.take(rows), target.take(rows), guesses, COARSE, belief, metric=config.metric)
        better = wide.fitness > rough.fitness[rows]
        for kept, found in zip(rough, wide, strict=True):
            kept[rows[better]] = found[better]
    return rough, _predict_open_steps(rough, config, source.typical_range)


def _fan(
    config: IncrementalConfig, typical_range: float, radii: tuple[float, ...], num_ways: int, *, turn_share: float = 1.0
) -> Floats:
    """Guesses (h, 3) of a step: every turn at every shift by `radii` (typical ranges) in `num_ways` directions."""
    last = turn_share * config.max_turn_deg
    turns = np.radians(np.arange(-last, last + 1e-6, config.turn_step_deg))
    ways = 2 * np.pi * np.arange(num_ways) / num_ways
    shifts = [
        (typical_range * r * np.cos(w), typical_range * r * np.sin(w)) for r in radii for w in (ways if r else ways[:1])
    ]
    return np.array([(x, y, turn) for turn in turns for x, y in shifts])


def _predict_open_steps(matches: PairMatches, config: IncrementalConfig, typical_range: float) -> PosePrior:
    """A prior for steps that the scans leave open: the median translation of the clear steps with a similar turn.

    In a corridor two scans fit at every shift along it; a robot that has made straight steps of one metre elsewhere
    will have made another one there.
    """
    eigenvalue = matches.weakest_eigenvalue()
    is_clear = (eigenvalue >= np.median(eigenvalue)) & (matches.fitness >= np.median(matches.fitness))
    clear, turns = matches.poses[is_clear], matches.poses[:, 2]
    mean, information = np.zeros((len(turns), 3)), np.zeros((len(turns), 3))
    for row, turn in enumerate(turns):
        alike = clear[np.abs(se2.wrap_angle(clear[:, 2] - turn)) < config.similar_turn]
        alike = alike if len(alike) >= 5 else clear
        if len(alike) >= 5:
            mean[row, :2] = np.median(alike[:, :2], axis=0)
            spread = 1.4826 * np.median(np.abs(alike[:, :2] - mean[row, :2]), axis=0) / typical_range
            information[row, :2] = (_COARSE_RESIDUAL / (spread + 0.015)) ** 2
    return PosePrior(mean, information)


class _Links(NamedTuple):
    """Matched pairs of scans, and how far each can be trusted."""

    source: Indices
    target: Indices
    poses: Floats
    quality: Floats


def _link(profiles: RangeProfiles, source: Indices, target: Indices, matches: PairMatches) -> _Links:
    """Matches with their quality: the fitness, less twice the share of beams that contradict the other scan."""
    share = contradicted_share(profiles, source, target, matches.poses)
    return _Links(source, target, matches.poses, matches.fitness - 2.0 * share)


def contradicted_share(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> Floats:
    """(p,) share of the visible beams of two scans that contradict each other; of few beams a low one."""
    views = compare_pairs(profiles, source, target, poses, stride=1)
    return np.asarray(views.contradicted, np.float64) / np.maximum(np.asarray(views.visible, np.float64), 20.0)


def _bridge_bad_scans(scans: PlanarScans, steps: PairMatches, config: IncrementalConfig) -> Floats:
    """Poses through the best matches, around scans that fit no neighbour.

    Where a step is poor, the scans on either side are matched across it, two and three apart. The poses then follow the
    spanning tree of the most trustworthy matches instead of the plain chain, so that a bad scan is a leaf.
    """
    later, profiles = np.arange(1, len(scans)), make_profiles(scans)
    links = [_link(profiles, later, later - 1, steps)]
    poor = np.flatnonzero(links[0].quality < config.poor_quality)
    if not len(poor):
        return se2.chain(steps.poses)
    fan = _fan(config, scans.typical_range, (0.0, 0.225, 0.45), 8)
    for apart in (2, 3):
        # All pairs that span a poor step.
        target = np.unique(np.concatenate([poor - k for k in range(apart)]))
        target = target[(target >= 0) & (target + apart < len(scans))]
        one, other = scans.take(target + apart), scans.take(target)
        guesses = np.broadcast_to(fan, (len(target), *fan.shape))
        for schedule in (COARSE, FINE):
            found = match_pairs(one, other, guesses, schedule, metric=config.metric)
            guesses = found.poses[:, None]
        links.append(_link(profiles, target + apart, target, found))
    return _follow_tree(len(scans), _Links(*(np.concatenate(x) for x in zip(*links, strict=True))))


def _follow_tree(num_scans: int, links: _Links) -> Floats:
    """Poses from the first scan on, along the spanning tree of the best links."""
    source, target, poses, quality = links
    cost = 2.0 - np.clip(quality, -0.9, 1.0)
    graph = scipy.sparse.csr_matrix((cost, (source, target)), shape=(num_scans, num_scans))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    order, parents = scipy.sparse.csgraph.breadth_first_order(tree, 0, directed=False)
    step_of: dict[tuple[int, int], Floats] = {}
    for i, j, pose in zip(source.tolist(), target.tolist(), poses, strict=True):
        step_of[i, j], step_of[j, i] = pose, se2.inverse(pose)
    world = np.zeros((num_scans, 3))
    for scan in order[1:].tolist():
        world[scan] = se2.compose(world[parents[scan]], step_of[scan, int(parents[scan])])
    return world
