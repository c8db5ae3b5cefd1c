"""Support of a step between two scans: by their beams, and by the usual motion of the sequence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.geometry import se2
from dpmjax.pose_graph.graph import label_parts
from dpmjax.registration2d.planar_scans import Floats, Indices, PlanarScans
from dpmjax.registration2d.range_profiles import RangeProfiles, compare_pairs, make_profiles
from dpmjax.registration2d.recordings import fill_between

# Number of matched beams that outweigh a contradicting one; share of visible beams that noise makes contradictory.
_CONTRADICTION_WEIGHT, _NOISY_SHARE = 2.5, 0.02
# Regularisation of the score where few beams are visible, as a share of all beams.
LEAST_VISIBLE = 0.3
# A step with a lower score is weak.
WEAK_SCORE = 0.25
# Scales of the motion prior: deviations backward, forward and sideways in usual steps; radians.
_SHORT, _LONG, _SIDEWAYS, _TURN = 0.6, 1.5, 0.5, 0.8
# Turns (radians) of the arcs that a robot may drive in a step, and their lengths in usual steps.
_ARC_TURNS, _ARC_LENGTHS = np.radians(np.arange(-90.0, 91.0, 15.0)), (0.0, 0.5, 1.0, 1.5)
# Score above which two scans fit each other, and the largest number of steps between them. Largest size of an outlier
# group.
_FITTING_SCORE, _FITTING_SPAN, _SMALL_GROUP = 0.0, 3, 3
# Range noise, in typical ranges, above which no two scans are equal.
_LEAST_NOISE = 1.5e-4


def find_evidence(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> tuple[Floats, Floats]:
    """Compares pairs of scans at T_target_source (p, 3).

    Args:
        profiles: n scans.
        source: (p,) rows.
        target: (p,) rows.
        poses: (p, 3) T_target_source.

    Returns:
        Agreement (p,), which is matched less weighted contradicting beams, and beams (p,) that end in the visible
        region of their partner scan; shares of all beams of both scans.
    """
    views = compare_pairs(profiles, source, target, poses, stride=4)
    contradicted = np.maximum(views.contradicted - _NOISY_SHARE * views.visible, 0.0)
    num_beams = np.asarray(profiles.scans.mask.sum(1), np.float64)
    beams = np.maximum(num_beams[source] + num_beams[target], 1.0)
    agreement = np.asarray(views.matched - _CONTRADICTION_WEIGHT * contradicted, np.float64)
    return agreement / beams, np.asarray(views.visible, np.float64) / beams


def pair_scores(profiles: RangeProfiles, source: Indices, target: Indices, poses: Floats) -> Floats:
    """Computes the scores (p,) of pairs at T_target_source, at most 1: the agreement of the visible beams."""
    agreement, visible = find_evidence(profiles, source, target, poses)
    return agreement / (visible + LEAST_VISIBLE)


def weak_steps(profiles: RangeProfiles, poses: Floats, rows: Indices) -> NDArray[np.bool_]:
    """Returns True for each of the k - 1 steps whose scan-match score is below `WEAK_SCORE`."""
    before, after = rows[:-1], rows[1:]
    return pair_scores(profiles, after, before, se2.relative(poses[before], poses[after])) < WEAK_SCORE


class MotionPrior(NamedTuple):
    """The usual motion from one scan to the next.

    Attributes:
        length: of a step, in the unit of the points.
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


def fitting_scans(scans: PlanarScans, poses: Floats) -> NDArray[np.bool_]:
    """Returns False for outliers, which match only a small group of neighbours in time or repeat the scan before.

    Args:
        scans: n scans in time order.
        poses: (n, 3) T_world_scan.

    Returns:
        (n,) True for scans that are no outliers. Outliers are scans of another time, repeated scans, and scans taken
        through a covered lens.
    """
    num_scans, profiles = len(scans), make_profiles(scans)
    spans = range(1, min(_FITTING_SPAN + 1, num_scans))
    source = np.concatenate([np.arange(k, num_scans) for k in spans]).astype(np.int64)
    target = np.concatenate([np.arange(num_scans - k) for k in spans]).astype(np.int64)
    score = pair_scores(profiles, source, target, se2.relative(poses[target], poses[source]))
    fits = score > _FITTING_SCORE
    group = label_parts(num_scans, source[fits], target[fits])
    size = np.bincount(group)[group]
    is_new = np.isin(np.arange(num_scans), distinct_rows(scans))
    return np.asarray((size > min(_SMALL_GROUP, num_scans // 4)) & is_new)


def distinct_rows(scans: PlanarScans) -> Indices:
    """Returns rows of the scans that differ from the scan before; all rows for scans without noise."""
    is_new = np.asarray((np.abs(np.diff(np.asarray(scans.points), axis=0)) > 0).any(axis=(1, 2)))
    is_new = is_new | (scans.noise < _LEAST_NOISE * scans.typical_range)
    return np.flatnonzero(np.append(True, is_new))


def interpolate(num_scans: int, rows: Indices, poses: Floats) -> Floats:
    """Interpolates poses of all scans from those (k, 3) of `rows` (k,); both ends of the sequence are constant."""
    at_start, at_end = rows[:1] * 0, rows[-1:] * 0 + num_scans - 1
    chosen, first = np.unique(np.concatenate([rows, at_start, at_end]), return_index=True)
    known = np.concatenate([poses, poses[:1], poses[-1:]])[first]
    return fill_between(chosen, known, np.zeros((num_scans, 3)))
