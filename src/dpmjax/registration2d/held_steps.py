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
from dpmjax.registration2d.step_slides import Slides, slide_steps

# Accuracy of a fitted beam, typical ranges; and of a step without other information: typical ranges, radians.
BEAM_DEVIATION, _STEP_DEVIATION = 0.03, (0.045, 0.15)
# Least standard deviation of a constrained step, typical ranges and radians.
_LEAST_DEVIATION = 0.005


def pose_steps(poses: Floats, typical_range: float) -> Edges:
    """Returns edges between neighbours in time of these poses (n, 3), with little information."""
    relative, later = se2.relative(poses[:-1], poses[1:]), np.arange(1, len(poses))
    information = np.diag((np.array(_STEP_DEVIATION)[[0, 0, 1]] * [typical_range, typical_range, 1.0]) ** -2.0)
    return Edges(later, later - 1, relative, np.broadcast_to(information, (len(later), 3, 3)))


def prior_steps(prior: StepPrior) -> Edges:
    """Returns edges between neighbours in time from a prior of n - 1 steps."""
    later, variances = np.arange(1, len(prior.steps) + 1), prior.deviations**2
    return Edges(later, later - 1, prior.steps, np.eye(3) / variances[:, None])


def matched_steps(matches: PairMatches, slides: Slides, typical_range: float) -> Edges:
    """Returns edges between neighbours in time from their matches.

    Args:
        matches: of the n - 1 steps.
        slides: of the same steps.
        typical_range: of the scans.

    Returns:
        Edges. Along an unconstrained direction the variance is that of the shift. Elsewhere the information is at
        least that of `pose_steps`.
    """
    loose = pose_steps(se2.chain(matches.poses), typical_range)
    fixed = matches.information / (BEAM_DEVIATION * typical_range) ** 2
    across = open_projections(slides, matches.poses)
    return loose._replace(
        information=across @ (fixed + loose.information) @ across
        + slide_information(slides, matches.poses, typical_range)
    )


def open_projections(slides: Slides, steps: Floats) -> Floats:
    """Returns projections (k, 3, 3) of tangents in the source frames that remove unconstrained directions."""
    axes = np.where(slides.is_open[:, None], slides.axes(steps), 0.0)
    return np.asarray(np.eye(3) - axes[:, :, None] * axes[:, None, :])


def slide_information(slides: Slides, steps: Floats, typical_range: float) -> Floats:
    """Returns the information (k, 3, 3) of the shifts along unconstrained directions, in the source frames."""
    axes = np.where(slides.is_open[:, None], slides.axes(steps), 0.0)
    variances = np.maximum(slides.deviations, _LEAST_DEVIATION * typical_range) ** 2
    return np.asarray(axes[:, :, None] * axes[:, None, :] / variances[:, None, None])


def held_steps(slides: Slides, poses: Floats, typical_range: float) -> Edges:
    """Returns pose-graph edges for ambiguous relative poses (open or torn in `Slides`), at their most probable shifts.

    Args:
        slides: of the n - 1 steps of the poses.
        poses: (n, 3) T_world_scan.
        typical_range: of the scans.

    Returns:
        Edges; a step that is open and not torn has information along its weak direction alone.
    """
    steps = pose_steps(poses, typical_range)
    firm = np.array([typical_range, typical_range, 1.0]) * _LEAST_DEVIATION
    information = slide_information(slides, steps.measurements, typical_range)
    across = open_projections(slides, steps.measurements)
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
    profiles, later = make_profiles(scans), np.arange(1, len(scans))
    slides = slide_steps(profiles, later, later - 1, matches.poses, prior)
    rows = np.flatnonzero(slides.is_torn | slides.is_open)
    if not len(rows):
        return matches, slides
    moved = slides.moved(matches.poses)[rows]
    spread = np.maximum(slides.deviations[rows], _LEAST_DEVIATION * scans.typical_range)
    information = (3.0 * scans.noise / spread[:, None] * [1.0, 1.0, 0.0]) ** 2
    source, target = scans.take(rows + 1), scans.take(rows)
    found = match_pairs(source, target, moved[:, None], FINE, PosePrior(moved, information))
    settled = PairMatches(*(x.copy() for x in matches))
    for kept, new in zip(settled, found, strict=True):
        kept[rows] = new
    return settled, slide_steps(profiles, later, later - 1, settled.poses, prior)
