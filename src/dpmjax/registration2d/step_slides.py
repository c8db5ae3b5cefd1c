"""Steps that are slid along the weak direction of their walls: where else two scans fit about as well, or better.

Two scans of a corridor fit at every shift along it, and a local alignment stops at the first of them. So the scores of
a step are computed at shifts far to either side. Scores and prior together give the probability of each place: its
mode is where the step belongs, and its spread is the uncertainty of the step along the weak direction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.geometry import se2
from dpmjax.registration2d.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration2d.range_profiles import RangeProfiles
from dpmjax.registration2d.step_prior import StepPrior
from dpmjax.registration2d.step_scores import LEAST_VISIBLE, find_evidence

# Shifts to either side, and their spacing, typical ranges.
_REACH, _SPACING = 0.36, 0.012
# Places between two shifts, where the scores are interpolated; a prior may be sharper than the spacing.
_FINER = 8
# Difference of scores that divides the probability of a place by e.
_SCORE_SCALE = 0.02
# A step is torn where another place farther than this (typical ranges) is more probable by this number of nats.
_LEAST_SHIFT, _LEAST_GAIN = 0.03, 2.5
# A step is open where its standard deviation along the weak direction is above this, in typical ranges.
_OPEN_DEVIATION = 0.02


class Slides(NamedTuple):
    """Places of steps (k) along their weak directions.

    Attributes:
        directions: (k, 2) unit vectors in the frame of the target.
        shifts: (k,) shift to the mean of the places of an open step, and to the most probable place of a torn one, in
            the unit of the points; 0 for others.
        deviations: (k,) standard deviation of the shift about that place, in the unit of the points.
        is_torn: (k,) True where another place is clearly better than the given one.
        is_open: (k,) True where the scores alone leave places far apart.
        scores: (k,) score at the place that the shift leads to.
        reach: the largest shift that is tried to either side, in the unit of the points.
    """

    directions: Floats
    shifts: Floats
    deviations: Floats
    is_torn: Bool[np.ndarray, " k"]
    is_open: Bool[np.ndarray, " k"]
    scores: Floats
    reach: float

    def moved(self, steps: Floats) -> Floats:
        """Returns the steps (k, 3) at their most probable places."""
        return np.concatenate([steps[:, :2] + self.shifts[:, None] * self.directions, steps[:, 2:]], axis=1)

    def information(self) -> Floats:
        """Returns inverse variances (k,) along the weak directions: infinite for closed steps, 0 for flat scores."""
        flat = 3.0 / self.reach**2
        return np.where(self.is_open, np.maximum(np.maximum(self.deviations, 1e-9) ** -2.0 - flat, 0.0), np.inf)

    def axes(self, steps: Floats) -> Floats:
        """Returns the weak directions as tangents (k, 3) in the frames of the sources of these steps (k, 3)."""
        turned = np.einsum("kji,kj->ki", se2.rotation(steps[:, 2]), self.directions)
        return np.concatenate([turned, np.zeros((len(steps), 1))], axis=1)


def weak_directions(scans: PlanarScans) -> Float[np.ndarray, "n 2"]:
    """Returns unit vectors along which the walls of each scan tell least, in the frame of the scan."""
    normals = np.where(np.asarray(scans.is_on_line)[..., None], np.asarray(scans.normals, np.float64), 0.0)
    return np.asarray(np.linalg.eigh(np.einsum("nbi,nbj->nij", normals, normals))[1][..., 0])


def slide_steps(
    profiles: RangeProfiles, source: Indices, target: Indices, steps: Floats, prior: StepPrior | None = None
) -> Slides:
    """Slides steps along the weak directions of their targets.

    Args:
        profiles: n scans.
        source: (k,) rows of the scans that are slid.
        target: (k,) rows of the scans that they are compared with.
        steps: (k, 3) T_target_source.
        prior: of these steps; None: the scores alone.

    Returns:
        Slides.
    """
    unit, count = profiles.scans.typical_range, round(_REACH / _SPACING)
    if not len(steps):
        none = np.zeros(0, bool)
        return Slides(np.zeros((0, 2)), np.zeros(0), np.zeros(0), none, none, np.zeros(0), _REACH * unit)
    directions = weak_directions(profiles.scans)[target]
    shifts = np.asarray(_SPACING * unit * np.arange(-count, count + 1), np.float64)
    places = np.repeat(np.asarray(steps, np.float64)[:, None], len(shifts), axis=1)
    places[..., :2] += shifts[:, None] * directions[:, None]
    source, target = (np.repeat(rows, len(shifts)) for rows in (source, target))
    agreement, visible = find_evidence(profiles, source, target, places.reshape(-1, 3))
    # A shorter step sees more of the same walls, which is no evidence for it. Where all is visible, these are the
    # scores of pairs.
    scores = agreement / (np.maximum(visible, LEAST_VISIBLE) * (1.0 + LEAST_VISIBLE))
    scores = scores.reshape(len(steps), -1)
    shifts, scores, count = _interpolated(shifts), _interpolated(scores), _FINER * count
    nats = scores / _SCORE_SCALE
    is_open = _spread(nats, shifts)[1] > _OPEN_DEVIATION * unit
    if prior is not None:
        places = np.repeat(np.asarray(steps, np.float64)[:, None], len(shifts), axis=1)
        places[..., :2] += shifts[:, None] * directions[:, None]
        nats -= prior.costs(places)
    row, best = np.arange(len(steps)), nats.argmax(axis=1)
    is_torn = (nats[row, best] - nats[:, count] > _LEAST_GAIN) & (np.abs(shifts[best]) > _LEAST_SHIFT * unit)
    means, deviations = _spread(nats, shifts)
    # That of a normal distribution with the same middle; tails of the prior count less.
    deviations = deviations if prior is None else 2.0**0.5 * _spread(2.0 * nats, shifts)[1]
    shift = np.where(is_open, means, np.where(is_torn, shifts[best], 0.0))
    nearest = np.abs(shifts - shift[:, None]).argmin(axis=1)
    return Slides(directions, shift, deviations, is_torn, is_open, scores[row, nearest], _REACH * unit)


def _interpolated(values: Floats) -> Floats:
    """Returns values (..., s) with those between each two of them."""
    parts = np.arange(_FINER) / _FINER
    between = values[..., :-1, None] + parts * np.diff(values)[..., None]
    return np.concatenate([between.reshape(*values.shape[:-1], -1), values[..., -1:]], axis=-1)


def _spread(nats: Floats, shifts: Floats) -> tuple[Floats, Floats]:
    """Returns the means (k,) and the standard deviations of shifts (s,) about the most probable ones."""
    probability = np.exp(nats - nats.max(axis=1, keepdims=True))
    probability /= probability.sum(axis=1, keepdims=True)
    means, best = probability @ shifts, shifts[nats.argmax(axis=1)]
    return means, np.sqrt((probability * (shifts - best[:, None]) ** 2).sum(axis=1))
