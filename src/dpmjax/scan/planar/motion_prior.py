"""Priors of the motion from scan to scan: of odometry, of given poses, and of the usual motion of a robot."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import se2
from dpmjax.scan.planar.align import PairMatches, PairPrior
from dpmjax.scan.planar.record import Booleans, Floats, Indices

# Standard deviations of a step of poses of unknown accuracy: typical ranges, radians.
_USUAL_DEVIATION = (0.0225, 0.15)
# Clear steps predict the translation of another step if the turns differ by less than this, in radians. Least number of
# such steps; with fewer, all clear steps predict. Least deviation of such a prediction, typical ranges.
_SIMILAR_TURN, _LEAST_CLEAR, _LEAST_SPREAD = 0.15, 5, 0.015
# Shorter steps are not counted in the usual motion of a robot that moves, typical ranges. Least deviation of an unknown
# step as a share of the usual length, because the robot may stop or hurry there.
_LEAST_MOVE, _UNKNOWN_SHARE = 0.02, 0.5
# Degrees of freedom of Student's t for steps, heavy-tailed because wheels slip and logs have gaps.
_FREEDOM = 3.0
# Scales of the motion prior: deviations backward, forward and sideways in usual steps; radians.
_SHORT, _LONG, _SIDEWAYS, _TURN = 0.6, 1.5, 0.5, 0.8
# Turns (radians) of the arcs that a robot may drive in a step, and their lengths in usual steps.
_ARC_TURNS, _ARC_LENGTHS = np.radians(np.arange(-90.0, 91.0, 15.0)), (0.0, 0.5, 1.0, 1.5)


class StepPrior(NamedTuple):
    """Expected steps from each scan to the next, with their standard deviations.

    Attributes:
        steps: (k, 3) T_scan_next.
        deviations: (k, 3) of x and y in the unit of the points, and of the heading in radians; infinite: unknown.
    """

    steps: Floats
    deviations: Floats

    @classmethod
    def of_poses(cls, poses: Floats, typical_range: float) -> StepPrior:
        """Makes a prior of poses (n, 3) of unknown accuracy."""
        steps = np.asarray(se2.relative(poses[:-1], poses[1:]), np.float64)
        deviation = np.array(_USUAL_DEVIATION)[[0, 0, 1]] * [typical_range, typical_range, 1.0]
        return cls(steps, np.broadcast_to(deviation, steps.shape))

    def costs(self, steps: Float[np.ndarray, "k *m 3"]) -> Floats:
        """Computes heavy-tailed costs (k, *m) of steps in nats; 0 for the expected steps."""
        shape = (len(self.steps),) + (1,) * (steps.ndim - 2) + (3,)
        off = steps - self.steps.reshape(shape)
        off[..., 2] = se2.wrap_angle(off[..., 2])
        chi2 = ((off / self.deviations.reshape(shape)) ** 2).sum(-1)
        # The negative log-likelihood under Student's t.
        return np.asarray(0.5 * (_FREEDOM + 3.0) * np.log1p(chi2 / _FREEDOM), np.float64)

    def loosened(self, typical_range: float) -> StepPrior:
        """Returns the prior with at least the usual deviations.

        Calibrated deviations are those of most steps. The normal prior of an alignment needs larger ones, because some
        steps slip, and in fast turns odometry and scans have different times.
        """
        usual = StepPrior.of_poses(se2.chain(self.steps), typical_range).deviations
        return self._replace(deviations=np.maximum(self.deviations, usual))

    def without(self, is_unknown: Booleans, typical_range: float) -> StepPrior:
        """Returns the prior with the usual motion of the other steps, and its spread, at the unknown ones."""
        is_known = ~is_unknown & (np.hypot(self.steps[:, 0], self.steps[:, 1]) > _LEAST_MOVE * typical_range)
        straight = np.where(is_unknown[:, None], 0.0, self.steps)
        usual = usual_steps(straight, is_known, typical_range)
        deviations = np.where(np.isfinite(usual.deviations), usual.deviations, [typical_range, typical_range, np.pi])
        length = np.median(np.hypot(*self.steps[is_known, :2].T)) if is_known.any() else 0.0
        deviations[:, :2] = np.maximum(deviations[:, :2], _UNKNOWN_SHARE * length)
        deviations[:, 2] = _USUAL_DEVIATION[1]
        return StepPrior(
            np.where(is_unknown[:, None], usual.steps, self.steps),
            np.where(is_unknown[:, None], np.maximum(deviations, self.deviations), self.deviations),
        )

    def as_pair_prior(self, residual: float | Floats) -> PairPrior:
        """Returns the prior of alignments; `residual` is the standard deviation of a beam, in the unit of points."""
        return PairPrior(self.steps, (residual / self.deviations) ** 2)

    def through(self, rows: Indices) -> StepPrior:
        """Returns the prior of the steps between these rows (m,) of the n scans, in order."""
        poses = se2.chain(self.steps)
        steps = se2.relative(poses[rows[:-1]], poses[rows[1:]])
        # A difference of cumulated sums would be NaN where deviations are infinite.
        variances = [(self.deviations[start:end] ** 2).sum(axis=0) for start, end in itertools.pairwise(rows)]
        return StepPrior(np.asarray(steps, np.float64), np.sqrt(np.reshape(variances, (-1, 3))))


def usual_motion(matches: PairMatches, typical_range: float) -> StepPrior:
    """Predicts each step by the median translation of clear steps with a similar turn.

    In a corridor two scans fit at every shift along it. The prediction assumes the same motion there as outside of it.

    Args:
        matches: matches of the steps. Steps with information and fitness of at least the median are clear.
        typical_range: typical range of the scans.

    Returns:
        StepPrior of the translations; without five clear steps all deviations are infinite.
    """
    eigenvalue = matches.weakest_eigenvalue()
    is_clear = (eigenvalue >= np.median(eigenvalue)) & (matches.fitness >= np.median(matches.fitness))
    return usual_steps(matches.poses, is_clear, typical_range)


def usual_steps(steps: Floats, is_clear: Booleans, typical_range: float) -> StepPrior:
    """Predicts the translation of each step by the clear steps of a similar turn."""
    clear, turns = steps[is_clear], steps[:, 2]
    predicted, deviations = np.zeros((len(turns), 3)), np.full((len(turns), 3), np.inf)
    for row, turn in enumerate(turns):
        alike = clear[np.abs(se2.wrap_angle(clear[:, 2] - turn)) < _SIMILAR_TURN]
        alike = alike if len(alike) >= _LEAST_CLEAR else clear
        if len(alike) >= _LEAST_CLEAR:
            predicted[row, :2] = np.median(alike[:, :2], axis=0)
            spread = 1.4826 * np.median(np.abs(alike[:, :2] - predicted[row, :2]), axis=0)
            deviations[row, :2] = spread + _LEAST_SPREAD * typical_range
    return StepPrior(predicted, deviations)


class MotionPrior(NamedTuple):
    """The usual motion from one scan to the next.

    Attributes:
        length: length of a step, in the unit of the points.
        forward: share of the length that is straight ahead, -1 to 1.
    """

    length: float
    forward: float

    @classmethod
    def of(cls, steps: Floats, typical_range: float) -> MotionPrior:
        """Estimates the prior from clear steps (k, 3); without any it expects no motion."""
        if not len(steps):
            return cls(0.05 * typical_range, 0.0)
        length = max(float(np.median(np.hypot(steps[:, 0], steps[:, 1]))), 0.05 * typical_range)
        return cls(length, float(np.median(steps[:, 0])) / length)

    def expected(self, gap: int) -> Floats:
        """Returns the usual motion (3,) over `gap` scans, without a turn."""
        return np.array([self.forward * self.length * gap, 0.0, 0.0])

    def arcs(self) -> Floats:
        """Returns the steps (h, 3) along arcs of the usual lengths, for all turns up to a right angle."""
        turn, length = (x.ravel() for x in np.meshgrid(_ARC_TURNS, np.array(_ARC_LENGTHS) * self.length))
        # The chord of an arc is turned by half the turn; np.sinc(x) is sin(pi x) / (pi x).
        chord = length * np.sinc(turn / (2 * np.pi)) * (1.0 if self.forward >= 0 else -1.0)
        return np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)

    def surprise(self, steps: Floats, gap: Indices) -> Floats:
        """Computes the heavy-tailed cost (m,) of motions (m, 3) over `gap` scans each."""
        share, turn = steps[:, :2] / self.length, np.abs(se2.wrap_angle(steps[:, 2]))
        # The expected forward motion decreases with the turn, because a robot may turn on the spot.
        ahead = share[:, 0] / gap - self.forward * np.cos(np.minimum(turn, 0.5 * np.pi))
        excess = np.where(ahead < 0, ahead / _SHORT, ahead / _LONG) ** 2
        excess += (share[:, 1] / gap / _SIDEWAYS) ** 2 + (turn / (_TURN * gap**0.5)) ** 2
        return np.asarray(np.log1p(excess), np.float64)
