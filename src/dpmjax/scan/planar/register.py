"""Registration of two planar scans without a first guess, and the probability that the motion is right.

All turns and shifts are searched (`propose.py`), the best distinct motions are aligned finely, and the one with the
best score of the views is kept. Its probability follows from its lead over the best other motion and from its freedom
to slide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dpmjax.checks import runs_on_host
from dpmjax.geometry import se2
from dpmjax.scan.pair_evidence import PairEvidence, PairModel, ScanRegistration
from dpmjax.scan.planar.align import FINE, match_pairs
from dpmjax.scan.planar.compare import LEAST_VISIBLE, find_evidence
from dpmjax.scan.planar.propose import CorrelativeConfig, poses_apart, search_pairs
from dpmjax.scan.planar.record import PlanarScans, planar_scans
from dpmjax.scan.planar.slide import BEAM_DEVIATION, slide_steps

# Number of distinct motions that are aligned. A corridor has more, but two of them that fit equally well suffice.
_SEARCH = CorrelativeConfig(num_candidates=8)
# The number of beams is rounded up to a multiple of this, so that few programs compile.
_BEAMS = 64
_LEAST_BEAMS = 8
# Fitted to 1,200 pairs of simulated walks.
PLANAR = PairModel(weights=(3.04, 8.03, 3.34, -0.489), bias=-8.79)


@runs_on_host("call icp there")
def register_planar(source: ArrayLike, target: ArrayLike) -> ScanRegistration:
    """Registers two planar scans without a first guess.

    Args:
        source: (n, 2) beam end points in the frame of the sensor, any unit; all-zero or non-finite beams are left out.
        target: (m, 2) the same in the same unit.

    Returns:
        The motion, its lead over the best motion to another place, and the probability that it is right within a
        twentieth of the typical range and 3 degrees.

    Raises:
        ValueError: wrong shapes, or a scan with fewer than eight valid beams.
    """
    scans = _stacked(source, target)
    first, second = np.zeros(1, np.int64), np.ones(1, np.int64)
    guesses = search_pairs(scans, first, second, _SEARCH).poses
    rows = np.zeros(len(guesses), np.int64)
    matches = match_pairs(scans.take(rows), scans.take(rows + 1), guesses[:, None], FINE)
    agreement, visible = find_evidence(scans, rows, rows + 1, matches.poses)
    scores = agreement / (visible + LEAST_VISIBLE)
    best, *others = poses_apart(matches.poses, scores, scans.typical_range, 2)
    lead = float(scores[best] - (scores[others[0]] if others else 0.0))
    pose = matches.poses[best]
    slides = slide_steps(scans, pose[None], pairs=(first, second))
    information = matches.information[best] / (BEAM_DEVIATION * scans.typical_range) ** 2
    sigma = float(slides.deviations[0])
    evidence = PairEvidence(float(scores[best]), lead, float(visible[best]), sigma / scans.typical_range)
    return ScanRegistration(
        T_target_source=se2.to_matrix(pose),
        confidence=PLANAR.probability(evidence),
        evidence=evidence,
        weak_direction=slides.directions[0],
        weak_sigma=sigma,
        information=information,
    )


def _stacked(source: ArrayLike, target: ArrayLike) -> PlanarScans:
    """Prepares two scans of any number of beams as one pair."""
    clouds = []
    for name, points in (("source", source), ("target", target)):
        values = np.asarray(points, np.float32)
        if values.ndim != 2 or values.shape[1] != 2:
            raise ValueError(f"{name}: expected a planar scan (n, 2), got {values.shape}")
        values = values[np.isfinite(values).all(axis=1) & values.any(axis=1)]
        if len(values) < _LEAST_BEAMS:
            raise ValueError(f"{name}: expected {_LEAST_BEAMS} valid beams or more, got {len(values)}")
        clouds.append(values)
    capacity = -(-max(map(len, clouds)) // _BEAMS) * _BEAMS
    both, mask = np.zeros((2, capacity, 2), np.float32), np.zeros((2, capacity), bool)
    for row, values in enumerate(clouds):
        both[row, : len(values)], mask[row, : len(values)] = values, True
    return planar_scans(both, mask, is_ordered=False)
