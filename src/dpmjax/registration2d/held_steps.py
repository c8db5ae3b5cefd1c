"""Edges between neighbours in time: from the beams where these fix a step, from slides and priors where they do not."""

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

# Accuracy of a fitted beam, typical ranges; and of a step that nothing else is known of: typical ranges, radians.
BEAM_DEVIATION, _STEP_DEVIATION = 0.03, (0.045, 0.15)
# Least standard deviation of a held step, typical ranges and radians.
_LEAST_DEVIATION = 0.005


def pose_steps(poses: Floats, typical_range: float) -> Edges:
    """Returns edges between neighbours in time of these poses (n, 3), all loose."""
    relative, later = se2.relative(poses[:-1], poses[1:]), np.arange(1, len(poses))
    information = np.diag((np.array(_STEP_DEVIATION)[[0, 0, 1]] * [typical_range, typical_range, 1.0]) ** -2.0)
    return Edges(later, later - 1, relative, np.broadcast_to(information, (len(later), 3, 3)))


def prior_steps(prior: StepPrior) -> Edges:
    """Returns edges between neighbours in time of a prior (n - 1 steps)."""
    later, variances = np.arange(1, len(prior.steps) + 1), prior.deviations**2
    return Edges(later, later - 1, prior.steps, np.eye(3) / variances[:, None])


def matched_steps(matches: PairMatches, slides: Slides, typical_range: float) -> Edges:
    """Returns edges between neighbours in time from their matches.

    Args:
        matches: of the n - 1 steps.
        slides: of the same steps.
        typical_range: of the scans.

    Returns:
        Edges; along an open direction the variance of the slide, else no less information than loose edges have.
    """
    loose = pose_steps(se2.chain(matches.poses), typical_range)
    fixed = matches.information / (BEAM_DEVIATION * typical_range) ** 2
    across = open_projections(slides, matches.poses)
    return loose._replace(
        information=across @ (fixed + loose.information) @ across
        + slide_information(slides, matches.poses, typical_range)
    )


def open_projections(slides: Slides, steps: Floats) -> Floats:
    """Returns projections (k, 3, 3) of tangents in the source frames that drop the direction of each open step."""
    axes = np.where(slides.is_open[:, None], slides.axes(steps), 0.0)
    return np.asarray(np.eye(3) - axes[:, :, None] * axes[:, None, :])


def slide_information(slides: Slides, steps: Floats, typical_range: float) -> Floats:
    """Returns the information (k, 3, 3) of the slides along open directions, in the source frames of the steps."""
    axes = np.where(slides.is_open[:, None], slides.axes(steps), 0.0)
    variances = np.maximum(slides.deviations, _LEAST_DEVIATION * typical_range) ** 2
    return np.asarray(axes[:, :, None] * axes[:, None, :] / variances[:, None, None])


def held_steps(slides: Slides, poses: Floats, typical_range: float) -> Edges:
    """Returns edges of the open and the torn steps of poses (n, 3), at their most probable places.

    Args:
        slides: of the n - 1 steps of the poses.
        poses: (n, 3) T_world_scan.
        typical_range: of the scans.

    Returns:
        Edges; an open step is held along its weak direction alone.
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
    """Moves each step to the most probable place along the weak direction of its walls, and aligns it there.

    Args:
        scans: n scans in time order.
        matches: the n - 1 steps.
        prior: of the steps.

    Returns:
        The matches, and the slides about them.
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
