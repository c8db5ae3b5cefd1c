"""Result of the registration of two scans of any sensor, and the probability that it is right."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import expit

# Least and largest score, lead and standard deviation that count: beyond, they say no more.
MAX_SCORE, MAX_LEAD, SIGMA = 0.6, 0.5, (0.002, 0.1)


class PairEvidence(NamedTuple):
    """Evidence for a motion.

    Attributes:
        score: agreement of the visible parts of both scans, 1 at most.
        lead: difference of the score to that of the best motion to another place.
        visible: share of the points of both scans in view of their partner.
        sigma: standard deviation along the weak direction, in typical ranges.
    """

    score: float
    lead: float
    visible: float
    sigma: float

    def features(self) -> Float[np.ndarray, "4"]:
        """Returns the features of the regression."""
        score, lead = np.clip(self.score, -0.2, MAX_SCORE), np.sqrt(np.clip(self.lead, 0.0, MAX_LEAD))
        return np.array([score, lead, self.visible, np.log(np.clip(self.sigma, *SIGMA))])


class PairModel(NamedTuple):
    """Regression of one sensor, fitted by `python -m experiments.pair_probability`.

    Attributes:
        weights: of the features.
        bias: constant; of equally many right and wrong motions.
    """

    weights: tuple[float, float, float, float]
    bias: float

    def probability(self, evidence: PairEvidence) -> float:
        """Computes the probability that a motion is right.

        Args:
            evidence: of the motion.

        Returns:
            In [0, 1].
        """
        return float(expit(evidence.features() @ np.array(self.weights) + self.bias))


class ScanRegistration(NamedTuple):
    """The motion between two planar scans (d = 2), depth images or lidar scans (d = 3), and how sure it is.

    Attributes:
        T_target_source: (d+1, d+1) motion that maps points of the source to the target.
        confidence: probability that the motion is right; see the function that made it for the limits.
        evidence: score of the motion, its lead over the best motion to another place, and more.
        weak_direction: unit vector in the target frame along which the translation is least certain.
        weak_sigma: standard deviation of the translation along it, unit of the points. It does not cover other places
            that look alike.
        information: (k, k) inverse covariance in the tangent of the source, translation first.
    """

    T_target_source: Float[np.ndarray, "d1 d1"]
    confidence: float
    evidence: PairEvidence
    weak_direction: Float[np.ndarray, " d"]
    weak_sigma: float
    information: Float[np.ndarray, "k k"]

    @property
    def lead(self) -> float:
        """Difference of the score to that of the best motion to another place."""
        return self.evidence.lead
