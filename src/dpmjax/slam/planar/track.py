"""Incremental ICP: aligns each scan with the previous one, and chains the steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.scan.planar.align import COARSE, FINE, Metric, PairMatches, PairPrior, fan, match_pairs
from dpmjax.scan.planar.motion_prior import StepPrior, usual_motion
from dpmjax.scan.planar.record import Floats, PlanarScans
from dpmjax.slam.planar.sequence_search import search_sequence

# Residuals as shares of the typical range: of a coarse match, and along a direction that the scans leave unconstrained.
_COARSE_RESIDUAL = 0.015
_OPEN_RESIDUAL = 0.0075


# Spacing of the turns that are tried, degrees: the basin of convergence of one alignment is about as wide. The largest
# turn between two scans that is searched where small turns do not fit.
_TURN_STEP, _MAX_TURN = 15.0, 90.0
# A pair with a better fitness is not searched further; one with a lower fitness even then is searched at longer steps.
_GOOD_FITNESS, _POOR_FITNESS = 0.75, 0.4
# A step is unconstrained in some direction (open) if its weakest eigenvalue is below this share of the beams.
_MIN_EIGENVALUE = 0.01


class IncrementalResult(NamedTuple):
    """Result of `incremental_icp`.

    Attributes:
        poses: (n, 3) T_world_scan, the first one zero.
        steps: independent matches of the n - 1 steps T_scan_next.
    """

    poses: Floats
    steps: PairMatches


def incremental_icp(
    scans: PlanarScans, metric: Metric = "plane", *, odometry: Floats | None = None, prior: StepPrior | None = None
) -> IncrementalResult:
    """Registers each scan to the previous one, and chains the steps.

    Without odometry, unclear steps are searched, and the best sequence of hypotheses gives the poses
    (`sequence_search.py`). Scans that fit no scan around them (a swapped line of the log) are interpolated.

    Args:
        scans: n scans in time order.
        metric: distance to lines ("plane") or to points ("point").
        odometry: (n, 3) raw poses; their steps are initial values. None: the steps are searched.
        prior: prior of the steps; None: the odometry, if there is any, with the usual deviations.

    Returns:
        IncrementalResult.
    """
    unit = scans.typical_range
    source, target = scans.take(slice(1, None)), scans.take(slice(len(scans) - 1))
    if len(scans) == 1:
        return IncrementalResult(np.zeros((1, 3)), match_pairs(source, target, np.zeros((0, 1, 3)), FINE))
    if odometry is None:
        rough = _search_steps(source, target, metric)
        prior = usual_motion(rough, unit)
    else:
        prior = prior or StepPrior.of_poses(odometry, unit)
        turns = fan(np.radians(_TURN_STEP) * np.array([0.0, -0.5, 0.5, -1.5, 1.5]))
        guesses = se2.relative(odometry[:-1], odometry[1:])[:, None] + turns
        loose = prior.as_pair_prior(_COARSE_RESIDUAL * unit)
        rough = match_pairs(source, target, guesses, COARSE, loose, metric=metric)
    # The weight of the prior follows from the range noise; steps that the scans leave unconstrained have a larger one.
    num_beams = source.num_on_line
    is_open = rough.weakest_eigenvalue() < _MIN_EIGENVALUE * num_beams * COARSE.source_share(source)
    belief = prior.as_pair_prior(np.where(is_open, _OPEN_RESIDUAL * unit, 3.0 * scans.noise)[:, None])
    predicted = np.concatenate([prior.steps[:, :2], rough.poses[:, 2:]], axis=1)
    guesses = np.stack([rough.poses, np.where(is_open[:, None], predicted, rough.poses)], axis=1)
    steps = match_pairs(source, target, guesses, FINE, belief, metric=metric)
    poses = se2.chain(steps.poses) if odometry is not None else search_sequence(scans, steps)
    return IncrementalResult(poses, steps)


def scan_odometry(scans: PlanarScans) -> Floats:
    """Chains coarse alignments of each scan with the one before, from zero motion.

    These poses serve to select scans that lie apart, from a dense recording without odometry. Steps that are long or
    unconstrained in a direction are wrong. A step without a match gets the length of one typical range, because a zero
    step would look like a standing robot, and the scan would be left out.

    Args:
        scans: n scans in time order.

    Returns:
        (n, 3) T_world_scan, the first one zero.
    """
    matches = match_near(scans.take(slice(1, None)), scans.take(slice(len(scans) - 1)), "plane")
    is_lost = (matches.fitness < _POOR_FITNESS)[:, None]
    return se2.chain(np.where(is_lost, [scans.typical_range, 0.0, 0.0], matches.poses))


def match_near(source: PlanarScans, target: PlanarScans, metric: Metric) -> PairMatches:
    """Returns coarse matches from zero motion and small turns."""
    guesses = fan(np.radians(_TURN_STEP) * np.array([0.0, -0.5, 0.5]))
    return match_pairs(source, target, np.broadcast_to(guesses, (len(source), 3, 3)), COARSE, metric=metric)


def _search_steps(source: PlanarScans, target: PlanarScans, metric: Metric) -> PairMatches:
    """Returns coarse matches from small motions, then from larger ones where the fitness is poor."""
    unit, rough = source.typical_range, match_near(source, target, metric)
    prior = usual_motion(rough, unit).as_pair_prior(_COARSE_RESIDUAL * unit)
    # Around the predicted translations, then far from zero.
    turns = np.radians(np.arange(-_MAX_TURN, _MAX_TURN + 1.0, _TURN_STEP))
    near, far = fan(turns, (0.0, 0.15 * unit), 4), fan(turns[3:-3], (0.3 * unit, 0.525 * unit), 8)
    centre = np.asarray(prior.mean) * [1.0, 1.0, 0.0]
    for limit, guesses, middle in ((_GOOD_FITNESS, near, centre), (_POOR_FITNESS, far, 0.0 * centre)):
        rows = np.flatnonzero(rough.fitness < limit)
        belief = PairPrior(prior.mean[rows], prior.information[rows])
        around = middle[rows][:, None] + guesses
        wide = match_pairs(source.take(rows), target.take(rows), around, COARSE, belief, metric=metric)
        better = wide.fitness > rough.fitness[rows]
        for kept, found in zip(rough, wide, strict=True):
            kept[rows[better]] = found[better]
    return rough
