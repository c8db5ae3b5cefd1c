"""Posterior of the shifts of steps along their weak directions, and pose-graph edges from it.

The weak direction is the direction in which the walls give the least information about the translation. Two scans of a
corridor fit at every shift along it, and a local alignment stops at the first of these shifts. So the scores of a step
(a relative pose) are computed at shifts far to either side. Scores and prior together give the posterior of the shift.
The mode of this posterior is the most probable relative pose, and its spread is the uncertainty along the weak
direction. An edge of the pose graph has the posterior along the weak direction, and the alignment in all other
directions.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import Edges, take_rows
from dpmjax.scan.planar.align import FINE, PairMatches, PairPrior, match_pairs
from dpmjax.scan.planar.compare import LEAST_VISIBLE, find_evidence, pair_scores
from dpmjax.scan.planar.motion_prior import StepPrior, usual_steps
from dpmjax.scan.planar.record import Floats, Pairs, PlanarScans

# Score above which a step is clear at final poses.
_CLEAR_SCORE = 0.45
# Accuracy of a fitted beam, typical ranges; and of a step without other information: typical ranges, radians.
BEAM_DEVIATION, _STEP_DEVIATION = 0.03, (0.045, 0.15)
# Shifts to either side, and their spacing, typical ranges.
_REACH, _SPACING = 0.36, 0.012
# Every `_STRIDE`-th shift is scored first. If the middle one leads by this number of nats, the scores between are
# interpolated.
_STRIDE, _CLEAR_GAIN = 3, 8.0
# Number of interpolated scores for each shift, because a prior may be sharper than the spacing.
_FINER = 8
# Difference of scores that divides the probability of a shift by e.
_SCORE_SCALE = 0.02
# A step is torn where a shift longer than this (typical ranges) is more probable by this number of nats.
_LEAST_SHIFT, _LEAST_GAIN = 0.03, 2.5
# A step is open where its standard deviation along the weak direction, by the scores alone, is above this, in typical
# ranges.
_OPEN_DEVIATION = 0.02
# Least cosine between the weak direction and the normal of a surface that faces it. Pairs of scans farther apart in
# time, of a lower score, or with less parallel weak directions, say nothing about a step between them.
_FACING, _MOST_APART, _LEAST_SCORE, _PARALLEL = 0.5, 12, 0.1, 0.97
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


class Slides(NamedTuple):
    """Posterior of the shifts of k steps along their weak directions.

    A step is open if the scores do not constrain its shift. It is torn if it has moved away from the mode.

    Attributes:
        directions: (k, 2) unit vectors in the frame of the target.
        shifts: (k,) shift in the unit of the points: posterior mean of an open step, mode of a torn step, else 0.
        deviations: (k,) standard deviation about the posterior mode, in the unit of the points.
        is_torn: (k,) True if the mode lies far from the given step and is clearly more probable.
        is_open: (k,) True if the scores alone do not constrain the shift.
        scores: (k,) score after the shift.
        typical_range: typical range of the scans.
    """

    directions: Floats
    shifts: Floats
    deviations: Floats
    is_torn: Bool[np.ndarray, " k"]
    is_open: Bool[np.ndarray, " k"]
    scores: Floats
    typical_range: float

    def moved(self, steps: Floats) -> Floats:
        """Returns the steps (k, 3) after their shifts."""
        return np.concatenate([steps[:, :2] + self.shifts[:, None] * self.directions, steps[:, 2:]], axis=1)

    def information(self) -> Floats:
        """Returns inverse variances (k,) along the weak directions, infinite for steps that are not open."""
        return np.where(self.is_open, self.above_flat(), np.inf)

    def above_flat(self) -> Floats:
        """Returns inverse variances (k,), less that of a uniform posterior over the reach: flat scores give 0."""
        flat = 3.0 / (_REACH * self.typical_range) ** 2
        return np.maximum(np.maximum(self.deviations, 1e-9) ** -2.0 - flat, 0.0)

    def constrained_deviations(self) -> Floats:
        """Returns the standard deviations (k,), at least that of a constrained step."""
        return np.maximum(self.deviations, _LEAST_DEVIATION * self.typical_range)

    def open_directions(self, steps: Floats) -> Floats:
        """Returns projections (k, 3, 3) of tangents, in the source frames of these steps, onto open directions."""
        turned = np.einsum("kji,kj->ki", se2.rotation(steps[:, 2]), self.directions)
        axes = np.where(self.is_open[:, None], np.column_stack([turned, np.zeros(len(steps))]), 0.0)
        return np.asarray(axes[:, :, None] * axes[:, None, :])

    def open_information(self, steps: Floats) -> Floats:
        """Returns the information (k, 3, 3) of the shifts along open directions, in the source frames."""
        return self.open_directions(steps) / self.constrained_deviations()[:, None, None] ** 2


def weak_directions(scans: PlanarScans) -> Float[np.ndarray, "n 2"]:
    """Returns, for each scan, the unit direction of least translation information, in the frame of the scan."""
    normals = scans.normals.astype(np.float64)
    return np.asarray(np.linalg.eigh(np.einsum("nbi,nbj->nij", normals, normals))[1][..., 0])


def slide_steps(
    scans: PlanarScans, steps: Floats, prior: StepPrior | None = None, *, pairs: Pairs | None = None
) -> Slides:
    """Computes the posterior of shifts of steps along the weak directions of their targets.

    Args:
        scans: n scans.
        steps: (k, 3) T_target_source.
        prior: of these steps; None: the scores alone.
        pairs: (k,) rows of the sources, which are shifted, and (k,) rows of the targets. None: the steps are the n - 1
            steps T_scan_next between neighbours in time.

    Returns:
        Slides.
    """
    unit, count = scans.typical_range, round(_REACH / _SPACING)
    source, target = pairs or (np.arange(1, len(scans)), np.arange(len(scans) - 1))
    directions = weak_directions(scans)[target]
    shifts = np.asarray(_SPACING * unit * np.arange(-count, count + 1), np.float64)
    places = _shifted(steps, directions, shifts)
    costs = np.zeros(places.shape[:2]) if prior is None else prior.costs(places)
    scores = _slide_scores(scans, (source, target), places, costs)
    shifts, scores, count = _interpolated(shifts), _interpolated(scores), _FINER * count
    nats = scores / _SCORE_SCALE
    is_open = _spread(nats, shifts)[1] > _OPEN_DEVIATION * unit
    if prior is not None:
        nats -= prior.costs(_shifted(steps, directions, shifts))
    row, best = np.arange(len(steps)), nats.argmax(axis=1)
    is_torn = (nats[row, best] - nats[:, count] > _LEAST_GAIN) & (np.abs(shifts[best]) > _LEAST_SHIFT * unit)
    means, deviations = _spread(nats, shifts)
    # Standard deviation of a normal distribution with the same curvature near the mode; reduces the tails of the prior.
    deviations = deviations if prior is None else 2.0**0.5 * _spread(2.0 * nats, shifts)[1]
    shift = np.where(is_open, means, np.where(is_torn, shifts[best], 0.0))
    nearest = np.abs(shifts - shift[:, None]).argmin(axis=1)
    return Slides(directions, shift, deviations, is_torn, is_open, scores[row, nearest], unit)


def _slide_scores(scans: PlanarScans, pairs: Pairs, places: Floats, costs: Floats) -> Floats:
    """Computes scores (k, s) of pairs at shifted poses; interpolates where few of these show that no shift fits.

    Args:
        scans: n scans.
        pairs: sources and targets.
        places: (k, s, 3) poses; the one in the middle has no shift.
        costs: (k, s) of the prior, nats.

    Returns:
        (k, s) scores.
    """
    column, middle, rows = np.arange(places.shape[1]), places.shape[1] // 2, np.arange(len(places))
    is_first, scores = (column - middle) % _STRIDE == 0, np.zeros(places.shape[:2])
    for is_scored in (is_first, ~is_first):
        agreement, visible = find_evidence(scans, pairs[0][rows], pairs[1][rows], places[rows][:, is_scored])
        # The number of visible beams must not favour short steps. Where all beams are visible, these scores equal
        # `pair_scores`.
        scores[np.ix_(rows, np.flatnonzero(is_scored))] = agreement / (
            np.maximum(visible, LEAST_VISIBLE) * (1.0 + LEAST_VISIBLE)
        )
        if is_scored is is_first:
            nats = np.stack([scores, scores - _SCORE_SCALE * costs]) / _SCORE_SCALE
            others = np.where(is_first & (column != middle), nats, -np.inf).max(axis=2)
            rows = np.flatnonzero((others > nats[..., middle] - _CLEAR_GAIN).any(axis=0))
    for row in np.setdiff1d(np.arange(len(scores)), rows):
        scores[row] = np.interp(column, column[is_first], scores[row, is_first])
    return scores


def _interpolated(values: Floats) -> Floats:
    """Interpolates values (..., s) linearly between each two neighbours."""
    parts = np.arange(_FINER) / _FINER
    between = values[..., :-1, None] + parts * np.diff(values)[..., None]
    between = between.reshape(*values.shape[:-1], _FINER * (values.shape[-1] - 1))
    return np.concatenate([between, values[..., -1:]], axis=-1)


def _spread(nats: Floats, shifts: Floats) -> tuple[Floats, Floats]:
    """Returns the means (k,) of shifts (s,) and their standard deviations (k,) about the most probable ones."""
    probability = np.exp(nats - nats.max(axis=1, keepdims=True))
    probability /= probability.sum(axis=1, keepdims=True)
    means, best = probability @ shifts, shifts[nats.argmax(axis=1)]
    return means, np.sqrt((probability * (shifts - best[:, None]) ** 2).sum(axis=1))


def slide_parts(scans: PlanarScans, poses: Floats, prior: StepPrior | None = None) -> Slides:
    """Computes the posterior of shifts of all scans after each step against those before it, by pairs across the step.

    In a passage most beams hit its sides, which fit at every shift, and a little better at short ones. So only hits on
    surfaces across the weak direction are compared. A single pair has few of them.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.
        prior: of the n - 1 steps; None: the scores alone. It decides on torn steps only.

    Returns:
        Slides of the n - 1 steps, with mean shifts; `deviations` are those about zero, by the scores alone.
    """
    unit, count, steps = scans.typical_range, round(_REACH / _SPACING), np.arange(len(scans) - 1)
    shifts = np.asarray(_SPACING * unit * np.arange(-count, count + 1), np.float64)
    target, apart = (x.ravel() for x in np.meshgrid(steps, np.arange(1, _MOST_APART + 1)))
    target, source = target[target + apart < len(scans)], (target + apart)[target + apart < len(scans)]
    relative = np.asarray(se2.relative(poses[target], poses[source]), np.float64)
    fits = pair_scores(scans, source, target, relative) > _LEAST_SCORE
    source, target, weak = source[fits], target[fits], weak_directions(scans)
    facing = replace(scans, hits=np.abs(np.einsum("nbi,ni->nb", scans.normals, weak)) > _FACING)
    agreement, _ = find_evidence(facing, source, target, _shifted(relative[fits], weak[target], shifts))
    directions, nats = np.einsum("nij,nj->ni", se2.rotation(poses[:, 2]), weak), np.zeros((len(steps), len(shifts)))
    for step in steps:
        cosines = directions[target] @ directions[step]
        across = np.flatnonzero((target <= step) & (source > step) & (np.abs(cosines) > _PARALLEL))
        if len(across):
            # Pairs share scans: together they count as one pair of each scan.
            weight = len(np.unique(np.concatenate([source[across], target[across]]))) / 2
            turned = np.where(cosines[across, None] > 0, agreement[across], agreement[across, ::-1])
            nats[step] = weight * turned.mean(axis=0) / (_SCORE_SCALE * (1.0 + LEAST_VISIBLE))
    means, deviations = _spread(_interpolated(nats), _interpolated(shifts))
    if prior is not None:
        nats -= prior.costs(_shifted(np.asarray(se2.relative(poses[:-1], poses[1:])), weak[:-1], shifts))
    best = nats.argmax(axis=1)
    is_torn = (nats[steps, best] - nats[:, count] > _LEAST_GAIN) & (np.abs(shifts[best]) > _LEAST_SHIFT * unit)
    deviations = np.hypot(means, deviations)
    return Slides(weak[:-1], means, deviations, is_torn, deviations > _OPEN_DEVIATION * unit, nats[steps, best], unit)


def _shifted(steps: Floats, directions: Floats, shifts: Floats) -> Floats:
    """Returns the steps (k, s, 3) after shifts (s,) along directions (k, 2)."""
    places = np.repeat(np.asarray(steps, np.float64)[:, None], len(shifts), axis=1)
    places[..., :2] += shifts[:, None] * directions[:, None]
    return places


def slid_steps(scans: PlanarScans, poses: Floats) -> Slides:
    """Computes the shifts of steps against the usual motion at these poses, for scans without odometry.

    A refinement may shrink the steps in a corridor to zero, because the scans fit at every shift.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.

    Returns:
        Slides of the n - 1 steps; a torn step has slid.
    """
    later, steps = np.arange(1, len(poses)), np.asarray(se2.relative(poses[:-1], poses[1:]), np.float64)
    free = slide_steps(scans, steps)
    is_clear = (pair_scores(scans, later, later - 1, steps) > _CLEAR_SCORE) & ~free.is_open & ~free.is_torn
    return slide_steps(scans, steps, usual_steps(steps, is_clear, scans.typical_range))


def matched_steps(matches: PairMatches, slides: Slides) -> Edges:
    """Returns edges between neighbours in time from their matches.

    Args:
        matches: of the n - 1 steps.
        slides: of the same steps.

    Returns:
        Edges. Along an unconstrained direction the variance is that of the shift. In all other directions the
        information is at least that of `pose_steps`.
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
        Edges. An open step that is not torn has information along its weak direction alone.
    """
    steps = pose_steps(poses, slides.typical_range)
    firm = np.array([slides.typical_range, slides.typical_range, 1.0]) * _LEAST_DEVIATION
    information = slides.open_information(steps.measurements)
    across = np.eye(3) - slides.open_directions(steps.measurements)
    information += np.where(slides.is_torn[:, None, None], across @ np.diag(firm**-2.0) @ across, 0.0)
    rows = np.flatnonzero(slides.is_torn | slides.is_open)
    held = steps._replace(measurements=slides.moved(steps.measurements), information=information)
    return take_rows(held, rows)


def settle_steps(scans: PlanarScans, matches: PairMatches, prior: StepPrior) -> tuple[PairMatches, Slides]:
    """Shifts ambiguous steps along their weak direction to the posterior mode, and re-aligns their scans.

    Args:
        scans: n scans in time order.
        matches: of the n - 1 steps.
        prior: of the steps.

    Returns:
        The matches after the shift and alignment, and the Slides of these.
    """
    slides = slide_steps(scans, matches.poses, prior)
    rows = np.flatnonzero(slides.is_torn | slides.is_open)
    if not len(rows):
        return matches, slides
    moved = slides.moved(matches.poses)[rows]
    information = (3.0 * scans.noise / slides.constrained_deviations()[rows, None] * [1.0, 1.0, 0.0]) ** 2
    source, target = scans.take(rows + 1), scans.take(rows)
    found = match_pairs(source, target, moved[:, None], FINE, PairPrior(moved, information))
    settled = PairMatches(*(x.copy() for x in matches))
    for kept, new in zip(settled, found, strict=True):
        kept[rows] = new
    return settled, slide_steps(scans, settled.poses, prior)
