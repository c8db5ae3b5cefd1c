"""Prior of the motion of a robot from scan to scan: the usual length of a step, and its forward share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dpmjax.geometry import se2
from dpmjax.registration2d.planar_scans import Floats, Indices

# Scales of the motion prior: deviations backward, forward and sideways in usual steps; radians.
_SHORT, _LONG, _SIDEWAYS, _TURN = 0.6, 1.5, 0.5, 0.8
# Turns (radians) of the arcs that a robot may drive in a step, and their lengths in usual steps.
_ARC_TURNS, _ARC_LENGTHS = np.radians(np.arange(-90.0, 91.0, 15.0)), (0.0, 0.5, 1.0, 1.5)


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
