"""Which of several trajectories is the best, without knowing the truth?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpmjax.registration import length_scale, surface_misfit
from dpmjax.registration.line_fitting import LineScans
from dpmjax.registration.map_code_length import map_code_length

# Maps whose code lengths differ by less than this part are equally good as maps (how walls lie in the cells is worth
# some percent); then their surfaces decide.
_SAME_MAP = 0.1


class Score(NamedTuple):
    """What is held against a trajectory.

    Attributes:
        code_length: nats a beam for the map (`map_code_length`): whether the map is right as a whole.
        misfit: share of beams off their surface in scans nearby (`surface_misfit`): how sharp it is.
    """

    code_length: float
    misfit: float


def choose_trajectory(lines: LineScans, candidates: Mapping[str, NDArray[np.float64]]) -> tuple[str, dict[str, Score]]:
    """The best trajectory: among those whose maps are about as short to describe as the shortest, the sharpest.

    Args:
        lines: n scans with lines.
        candidates: (n, 3) poses by name.

    Returns:
        The name of the best, and the scores of all.

    Raises:
        ValueError: there is no candidate.
    """
    if not candidates:
        raise ValueError("candidates: expected at least one trajectory")
    scale = length_scale(lines)
    points, mask = np.asarray(lines.points), np.asarray(lines.mask)
    scores = {
        name: Score(map_code_length(points, mask, poses, scale=scale), surface_misfit(lines, poses))
        for name, poses in candidates.items()
    }
    shortest = min(score.code_length for score in scores.values())
    as_short = [name for name, score in scores.items() if score.code_length <= (1.0 + _SAME_MAP) * shortest]
    return min(as_short, key=lambda name: scores[name].misfit), scores
