"""Incremental ICP: every scan against the one before, then the steps chained. The usual warm start of DeepMapping."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.pair_alignment import Metric, StepPrior
from dpmjax.registration.pairs import COARSE, FINE, PairMatches, length_scale, match_pairs, no_prior, take_scans
from dpmjax.registration.visibility import compare_views
from dpmjax.types import ScanSet

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class IncrementalConfig:
    """Settings of the incremental registration.

    Attributes:
        metric: distance to lines ("plane") or to points.
        max_turn_deg: largest turn between two scans that is searched when the small ones do not fit.
        turn_step_deg: distance of the turns that are tried; the basin of one alignment is about as wide.
        good_fitness: a pair that is matched better than this is not searched further.
        poor_fitness: one that is matched worse even then is searched at longer steps.
        similar_turn: steps tell of each other's translation if their turns differ by less, in radians.
        poor_quality: steps whose fitness less twice the share of crossed points is below this are bridged.
        open_grip: a step is open if less than this share of the beams holds it in its softest direction.
        odometry_sigma: trust in a step of the odometry: translation in length scales, turn in radians.
    """

    metric: Metric = "plane"
    max_turn_deg: float = 90.0
    turn_step_deg: float = 15.0
    good_fitness: float = 0.75
    poor_fitness: float = 0.4
    similar_turn: float = 0.15
    poor_quality: float = 0.2
    open_grip: float = 0.01
    odometry_sigma: tuple[float, float] = (0.15, 0.1)


def _grip(matches: PairMatches) -> NDArray[np.floating]:
    """How firmly the scans hold each step in its softest direction: beams, as information."""
    return np.linalg.eigvalsh(matches.information[:, :2, :2])[:, 0]


def _step_prior(
    matches: PairMatches, residual: NDArray[np.float64], config: IncrementalConfig, scale: float
) -> StepPrior:
    """What the clear steps tell of the open ones: the median translation of those with a similar turn.

    In a corridor two scans fit at every shift along it; a robot that has made straight steps of one metre elsewhere
    will have made another one there.
    """
    grip = _grip(matches)
    is_clear = (grip >= np.median(grip)) & (matches.fitness >= np.median(matches.fitness))
    clear, turns = matches.poses[is_clear], matches.poses[:, 2]
    mean, information = np.zeros((len(turns), 3)), np.zeros((len(turns), 3))
    for row, turn in enumerate(turns):
        alike = clear[np.abs(se2.wrap_angle(clear[:, 2] - turn)) < config.similar_turn]
        alike = alike if len(alike) >= 5 else clear
        if len(alike) >= 5:
            mean[row, :2] = np.median(alike[:, :2], axis=0)
            spread = 1.4826 * np.median(np.abs(alike[:, :2] - mean[row, :2]), axis=0) + 0.1 * scale
            information[row, :2] = (residual[row] / spread) ** 2
    return StepPrior(mean, information)


def _search_wider(
    source: LineScans, target: LineScans, rough: PairMatches, prior: StepPrior, config: IncrementalConfig, scale: float
) -> None:
    """Tries more turns, then longer steps, where the match is poor; better ones replace it in place."""
    rings = [(config.good_fitness, (0.0, 1.0), 1.0), (config.poor_fitness, (2.0, 3.5), 0.5)]
    for limit, radii, turn_share in rings:
        rows = np.flatnonzero(rough.fitness < limit)
        if not len(rows):
            continue
        shifts = [(0.0, 0.0)] if radii[0] == 0.0 else []
        num_ways = 4 if radii[0] == 0.0 else 8
        ways = 2 * np.pi * np.arange(num_ways) / num_ways
        shifts += [(r * np.cos(w), r * np.sin(w)) for r in radii if r > 0.0 for w in ways]
        last = turn_share * config.max_turn_deg
        turns = np.radians(np.arange(-last, last + 1e-6, config.turn_step_deg))
        fan = np.array([(scale * x, scale * y, turn) for turn in turns for x, y in shifts])
        centre = np.asarray(prior.mean)[rows][:, None] * [1.0, 1.0, 0.0] if radii[0] == 0.0 else 0.0
        belief = StepPrior(prior.mean[rows], prior.information[rows])
        wide = match_pairs(
            take_scans(source, rows), take_scans(target, rows), centre + np.broadcast_to(fan, (len(rows), *fan.shape)),
            COARSE, belief, scale=scale, metric=config.metric,
        )  # fmt: skip
        better = wide.fitness > rough.fitness[rows]
        for kept, found in zip(rough, wide, strict=True):
            kept[rows[better]] = found[better]


def incremental_icp(
    lines: LineScans,
    config: IncrementalConfig | None = None,
    *,
    odometry: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], PairMatches]:
    """Registers each scan to the one before and chains the steps.

    Args:
        lines: n scans with their lines (`fit_lines`), in time order.
        config: settings.
        odometry: (n, 3) raw poses; its steps serve as guesses and as belief. Without it the step is searched.

    Returns:
        Poses (n, 3) T_world_scan, the first one zero, and the n - 1 matched steps T_scan_next.
    """
    config = config or IncrementalConfig()
    num_steps = len(lines.points) - 1
    scale = length_scale(lines)
    noise = float(lines.noise[0])
    source, target = take_scans(lines, np.arange(1, num_steps + 1)), take_scans(lines, np.arange(num_steps))
    coarse = np.full(num_steps, 0.1 * scale)
    turns = np.radians([0.0, -0.5, 0.5]) * config.turn_step_deg
    if odometry is not None:
        guess = se2.relative(odometry[:-1], odometry[1:])
        sigma = np.array([scale, scale, 1.0]) * np.array(config.odometry_sigma)[[0, 0, 1]]
        unit_information = np.broadcast_to((np.array([1.0, 1.0, 1.0 / scale]) / sigma) ** 2, guess.shape)
        prior = StepPrior(guess, unit_information * coarse[:, None] ** 2)
        fan = np.concatenate([turns, 3.0 * turns[1:]])
        guesses = guess[:, None] + np.stack([0 * fan, 0 * fan, fan], -1)
        rough = match_pairs(source, target, guesses, COARSE, prior, scale=scale, metric=config.metric)
    else:
        guesses = np.broadcast_to(np.stack([0 * turns, 0 * turns, turns], -1), (num_steps, 3, 3))
        rough = match_pairs(source, target, guesses, COARSE, no_prior(num_steps), scale=scale, metric=config.metric)
        _search_wider(source, target, rough, _step_prior(rough, coarse, config, scale), config, scale)
        prior = _step_prior(rough, coarse, config, scale)
    # Where the scans hold a step, the belief is weighed against their noise alone; an open one leans on it.
    num_beams = np.maximum(np.asarray(source.mask.sum(1)), 1)
    is_open = _grip(rough) < config.open_grip * num_beams / COARSE.source_stride
    residual = np.where(is_open, 0.05 * scale, 3.0 * noise)
    prior = StepPrior(prior.mean, np.asarray(prior.information) * ((residual / coarse) ** 2)[:, None])
    start = np.where(
        is_open[:, None], np.append(1.0, [1.0, 0.0]) * prior.mean + [0.0, 0.0, 1.0] * rough.poses, rough.poses
    )
    steps = match_pairs(
        source, target, np.stack([rough.poses, start], axis=1), FINE, prior, scale=scale, metric=config.metric
    )
    if odometry is not None:
        return se2.chain(steps.poses), steps
    return bridge_bad_scans(lines, steps, config, scale), steps


def _quality(lines: LineScans, source: Indices, target: Indices, matches: PairMatches, scale: float) -> Floats:
    """Fitness, less the share of points that the other scan has looked through."""
    tolerance = max(0.1 * scale, 3.0 * float(lines.noise[0]))
    one, other = take_scans(lines, source), take_scans(lines, target)
    views = compare_views(
        ScanSet(one.points, one.mask),
        ScanSet(other.points, other.mask),
        jnp.asarray(matches.poses, jnp.float32),
        jnp.asarray(tolerance, jnp.float32),
    )
    crossed = np.asarray(views.num_crossed, np.float64) / np.maximum(np.asarray(views.num_seen, np.float64), 20.0)
    return matches.fitness - 2.0 * crossed


def bridge_bad_scans(lines: LineScans, steps: PairMatches, config: IncrementalConfig, scale: float) -> Floats:
    """Poses through the best matches, around scans that fit to no neighbour (a passer-by, a swapped line of the log).

    Where a step is poor, the scans on either side of it are matched over it, two and three apart. The poses then follow
    the spanning tree of the most trustworthy matches instead of the plain chain, so that a bad scan is a leaf.

    Args:
        lines: n scans.
        steps: n - 1 matched steps.
        config: settings.
        scale: `length_scale` of the scans.

    Returns:
        (n, 3) poses, the first one zero.
    """
    num_scans = len(lines.points)
    later = np.arange(1, num_scans)
    edges = [(later, later - 1, steps.poses, _quality(lines, later, later - 1, steps, scale))]
    poor = np.flatnonzero(edges[0][3] < config.poor_quality)
    if not len(poor):
        return se2.chain(steps.poses)
    fan = _wide_fan(config, scale)
    for apart in (2, 3):
        # All pairs that span a poor step.
        target = np.unique(np.concatenate([poor - k for k in range(apart)]))
        target = target[(target >= 0) & (target + apart < num_scans)]
        source, count = target + apart, len(target)
        one, other = take_scans(lines, source), take_scans(lines, target)
        guesses = np.broadcast_to(fan, (count, *fan.shape))
        for schedule in (COARSE, FINE):
            found = match_pairs(one, other, guesses, schedule, no_prior(count), scale=scale, metric=config.metric)
            guesses = found.poses[:, None]
        edges.append((source, target, found.poses, _quality(lines, source, target, found, scale)))
    source, target, poses, quality = (np.concatenate(x) for x in zip(*edges, strict=True))
    return _follow_tree(num_scans, source, target, poses, quality)


def _wide_fan(config: IncrementalConfig, scale: float) -> Floats:
    """Guesses for scans two or three steps apart, (h, 3)."""
    turns = np.radians(np.arange(-config.max_turn_deg, config.max_turn_deg + 1e-6, config.turn_step_deg))
    ways = np.arange(8) * np.pi / 4
    shifts = [(0.0, 0.0), *((r * np.cos(w), r * np.sin(w)) for r in (1.5, 3.0) for w in ways)]
    return np.array([(scale * x, scale * y, turn) for turn in turns for x, y in shifts])


def _follow_tree(num_scans: int, source: Indices, target: Indices, poses: Floats, quality: Floats) -> Floats:
    """Poses from the first scan on along the spanning tree of the best edges."""
    cost = 2.0 - np.clip(quality, -0.9, 1.0)
    graph = scipy.sparse.csr_matrix((cost, (source, target)), shape=(num_scans, num_scans))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    order, parents = scipy.sparse.csgraph.breadth_first_order(tree, 0, directed=False)
    edge_of = {(int(i), int(j)): row for row, (i, j) in enumerate(zip(source, target, strict=True))}
    world = np.zeros((num_scans, 3))
    for scan in order[1:]:
        parent = parents[scan]
        row = edge_of.get((int(scan), int(parent)))
        step = poses[row] if row is not None else se2.inverse(poses[edge_of[(int(parent), int(scan))]])
        world[scan] = se2.compose(world[parent], step)
    return world
