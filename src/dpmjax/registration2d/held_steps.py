"""Pose-graph edges between neighbours in time.

The scans give the relative pose where they constrain it. Along unconstrained directions (open steps, see `Slides`) the
posterior of the shift gives it.
"""

from __future__ import annotations

import jax
import numpy as np

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges
from dpmjax.registration2d.pair_alignment import FINE, PairMatches, PosePrior, match_pairs
from dpmjax.registration2d.planar_scans import Floats, PlanarScans
from dpmjax.registration2d.range_profiles import make_profiles
from dpmjax.registration2d.step_prior import StepPrior
from dpmjax.registration2d.step_slides import LEAST_DEVIATION, Slides, slide_steps

# Accuracy of a fitted beam, typical ranges; and of a step without other information: typical ranges, radians.
BEAM_DEVIATION, _STEP_DEVIATION = 0.03, (0.045, 0.15)


def pose_steps(poses: Floats, typical_range: float) -> Edges:
    """Returns edges between neighbours in time of these poses (n, 3), with little information."""
    relative, later = se2.relative(poses[:-1], poses[1:]), np.arange(1, len(poses))
    information = np.diag((np.array(_STEP_DEVIATION)[[0, 0, 1]] * [typical_range, typical_range, 1.0]) ** -2.0)
    return Edges(later, later - 1, relative, np.broadcast_to(information, (len(later), 3, 3)))


def prior_steps(prior: StepPrior) -> Edges:
    """Returns edges between neighbours in time from a prior of n - 1 steps."""
    later, variances = np.arange(1, len(prior.steps) + 1), prior.deviations**2
    return Edges(later, later - 1, prior.steps, np.eye(3) / variances[:, None])


def matched_steps(matches: PairMatches, slides: Slides) -> Edges:
    """Returns edges between neighbours in time from their matches.

    Args:
        matches: of the n - 1 steps.
        slides: of the same steps.

    Returns:
        Edges. Along an unconstrained direction the variance is that of the shift. Elsewhere the information is at
        least that of `pose_steps`.
    """
    loose = pose_steps(se2.chain(matches.poses), slides.typical_range)
    fixed = matches.information / (BEAM_DEVIATION * slides.typical_range) ** 2
    across = np.eye(3) - slides.open_directions(matches.poses)
    information = across @ (fixed + loose.information) @ across + slides.open_information(matches.poses)
    return loose._replace(information=information)


def held_steps(slides: Slides, poses: Floats) -> Edges:
    """Returns pose-graph edges for ambiguous relative poses (open or torn in `Slides`), at their most probable shifts.

    Args:
        slides: of the n - 1 steps of the poses.
        poses: (n, 3) T_world_scan.

    Returns:
        Edges; a step that is open and not torn has information along its weak direction alone.
    """
    steps = pose_steps(poses, slides.typical_range)
    firm = np.array([slides.typical_range, slides.typical_range, 1.0]) * LEAST_DEVIATION
    information = slides.open_information(steps.measurements)
    across = np.eye(3) - slides.open_directions(steps.measurements)
    information += np.where(slides.is_torn[:, None, None], across @ np.diag(firm**-2.0) @ across, 0.0)
    rows = np.flatnonzero(slides.is_torn | slides.is_open)
    held = steps._replace(measurements=slides.moved(steps.measurements), information=information)
    return jax.tree.map(lambda x: x[rows], held)


def settle_steps(scans: PlanarScans, matches: PairMatches, prior: StepPrior) -> tuple[PairMatches, Slides]:
    """Shifts ambiguous relative poses along their weak direction to the posterior mode, and re-aligns these scans.

    Args:
        scans: n scans in time order.
        matches: of the n - 1 steps.
        prior: of the steps.

    Returns:
        The matches after the shift and alignment, and the Slides of these.
    """
    profiles = make_profiles(scans)
    slides = slide_steps(profiles, matches.poses, prior)
    rows = np.flatnonzero(slides.is_torn | slides.is_open)
    if not len(rows):
        return matches, slides
    moved = slides.moved(matches.poses)[rows]
    information = (3.0 * scans.noise / slides.constrained_deviations()[rows, None] * [1.0, 1.0, 0.0]) ** 2
    source, target = scans.take(rows + 1), scans.take(rows)
    found = match_pairs(source, target, moved[:, None], FINE, PosePrior(moved, information))
    settled = PairMatches(*(x.copy() for x in matches))
    for kept, new in zip(settled, found, strict=True):
        kept[rows] = new
    return settled, slide_steps(profiles, settled.poses, prior)
