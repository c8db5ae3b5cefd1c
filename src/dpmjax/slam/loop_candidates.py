"""Candidates of loops: older keyframes near the new one by the estimated poses, or similar to it by retrieval."""

from __future__ import annotations

import itertools
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.slam.config import LoopClosureConfig
from dpmjax.slam.keyframes import KeyframeMap, distances_to
from dpmjax.slam.retrieval import most_similar

MAX_RADIUS_M = 100.0
"""Upper bound of the radius (DeepPointMap: 100 m)."""

MIN_PATH_SHARE = 4.0
"""Smallest distance of a candidate along the path, in extents."""

RADIUS_SHARE = 1.5
"""Radius of the candidates by distance, in extents."""

DRIFT_SHARE = 0.03
"""Share of the path since a candidate that is added to the radius."""


class LoopCandidate(NamedTuple):
    """An older keyframe that may show the same place.

    Attributes:
        row: of the keyframe.
        found_by: how.
    """

    row: int
    found_by: Literal["distance", "retrieval"]


class _Path(NamedTuple):
    # Of all keyframes.
    path_m: Float[np.ndarray, " k"]
    segments: Int[np.ndarray, " k"]
    extents_m: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, slam_map: KeyframeMap) -> _Path:
        columns = [(frame.path_m, frame.segment, frame.extent_m) for frame in slam_map.keyframes]
        return cls(*(np.array(column) for column in zip(*columns, strict=True)))

    def since_m(self, row: int) -> Float[np.ndarray, " k"]:
        """Returns the path from each keyframe to one; infinite where the track was lost between them."""
        return np.where(self.segments == self.segments[row], self.path_m[row] - self.path_m, np.inf)

    def is_old(self, row: int) -> Bool[np.ndarray, " k"]:
        """Returns True for keyframes that a loop may join to one."""
        is_before = np.arange(len(self.path_m)) < row
        return is_before & (self.since_m(row) > MIN_PATH_SHARE * self.extents_m[row])


def find_loop_candidates(slam_map: KeyframeMap, row: int, config: LoopClosureConfig) -> list[LoopCandidate]:
    """Finds older keyframes that may show the place of a keyframe.

    By distance: within a radius that grows with the path since, for odometry drifts. By retrieval: over the whole map,
    so that neither drift nor a lost track matters. Of several neighbours only the best is taken.

    Args:
        slam_map: the map.
        row: of the new keyframe.
        config: radii and numbers.

    Returns:
        Candidates by distance, nearest first, and those by retrieval, most similar first, in turn; each row once.
    """
    keyframe, path = slam_map.keyframes[row], _Path.of(slam_map)
    is_old, since_m = path.is_old(row), path.since_m(row)
    apart_m = distances_to(slam_map, slam_map.T_world_keyframe[row, :3, 3])
    radius_m = RADIUS_SHARE * keyframe.extent_m + DRIFT_SHARE * since_m
    is_near = is_old & (apart_m <= np.minimum(radius_m, MAX_RADIUS_M))
    near = np.argsort(np.where(is_near, apart_m, np.inf), kind="stable")[: int(is_near.sum())]
    near = _spread(near, slam_map, keyframe.extent_m / 2, config.num_near)
    similar = _similar(slam_map, row, is_old, config)
    by_distance = [LoopCandidate(int(other), "distance") for other in near]
    by_retrieval = [LoopCandidate(int(other), "retrieval") for other in similar if other not in near]
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(by_distance, by_retrieval))
    return [candidate for candidate in in_turn if candidate is not None]


def nearest_pairs(slam_map: KeyframeMap) -> list[tuple[float, int, int]]:
    """Finds, for each keyframe, the nearest older one that a loop may join to it, by the estimated poses alone.

    Args:
        slam_map: the map.

    Returns:
        Distance in metres and both rows, newer first, where it is within the extent of the newer scan; nearest first.
    """
    pairs, path = [], _Path.of(slam_map)
    positions = slam_map.T_world_keyframe[:, :3, 3]
    for row, keyframe in enumerate(slam_map.keyframes):
        is_old = path.is_old(row)[:row]
        apart_m = np.where(is_old, np.linalg.norm(positions[:row] - positions[row], axis=1), np.inf)
        target = int(np.argmin(apart_m)) if row else 0
        if row and apart_m[target] < keyframe.extent_m:
            pairs.append((float(apart_m[target]), row, target))
    return sorted(pairs)


def find_meetings(
    slam_map: KeyframeMap, row: int, is_other: Bool[np.ndarray, " k"], config: LoopClosureConfig
) -> list[LoopCandidate]:
    """Finds keyframes of other maps that may show the place of a keyframe, by retrieval alone: no position is known.

    Args:
        slam_map: several maps in one record.
        row: of the keyframe.
        is_other: True for keyframes of other maps.
        config: numbers.

    Returns:
        Candidates, most similar first.
    """
    return [LoopCandidate(int(other), "retrieval") for other in _similar(slam_map, row, is_other, config)]


def _similar(
    slam_map: KeyframeMap, row: int, is_allowed: Bool[np.ndarray, " k"], config: LoopClosureConfig
) -> Int[np.ndarray, " m"]:
    found = most_similar(slam_map.vectors, slam_map.vectors[row], 5 * config.num_similar, is_allowed=is_allowed)
    rows, cosines = found
    spacing_m = slam_map.keyframes[row].extent_m / 2
    return _spread(rows[cosines >= config.min_cosine], slam_map, spacing_m, config.num_similar)


def _spread(rows: Int[np.ndarray, " n"], slam_map: KeyframeMap, spacing_m: float, count: int) -> Int[np.ndarray, " m"]:
    """Returns the first rows that are not within `spacing_m` of one taken before, of the same segment."""
    positions = slam_map.T_world_keyframe[rows, :3, 3]
    segments = np.array([slam_map.keyframes[row].segment for row in rows])
    is_free: Bool[np.ndarray, " n"] = np.ones(len(rows), bool)
    taken: list[int] = []
    for number in range(len(rows)):
        if is_free[number] and len(taken) < count:
            taken.append(number)
            distance: Float[np.ndarray, " n"] = np.linalg.norm(positions - positions[number], axis=1)
            is_free &= (distance > spacing_m) | (segments != segments[number])
    return rows[taken]
