"""Loop closure: detection, registration map to map, and verification (DeepPointMap section 4).

Candidates are older keyframes that are near the new one by the estimated poses, or similar to it by retrieval. Loops
that agree with others become edges, and the map is optimised.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.scan.apart import apart
from dpmjax.slam.interfaces import SlamMethods
from dpmjax.slam.keyframe_map import KeyframeMap, submap_around
from dpmjax.slam.loops import (
    Loop,
    LoopState,
    LoopStatus,
    accept_consistent,
    has_new_loops,
    optimize_map,
    path_since_loop_m,
    with_match,
)

# Upper bound of the radius (DeepPointMap: 100 m).
MAX_RADIUS_M = 100.0

# Smallest distance of a candidate along the path, in extents.
MIN_PATH_SHARE = 4.0

# Radius of the candidates by distance, in extents.
RADIUS_SHARE = 1.5

# Share of the path since a candidate that is added to the radius.
DRIFT_SHARE = 0.03

# Smallest similarity of a candidate by retrieval, and largest number of them: more find more loops, slower.
MIN_COSINE, NUM_SIMILAR = 0.8, 6

# Smallest overlap probability of a registered candidate, and largest number of keyframes of one of its submaps.
MIN_OVERLAP, NUM_SUBMAP = 0.3, 4

# Share of all keyframes between two optimisations, so that the cost of a scan does not grow with the map.
EVERY_SHARE = 0.05

# Number of candidates whose overlap is predicted at a time, alternately by distance and by retrieval: one that surely
# overlaps ends the search after fewer of them.
NUM_ASKED = 4

# Largest number of registrations of a keyframe; each takes as long as some scans.
NUM_REGISTERED = 2

# Largest number of further registrations after an optimisation.
MAX_AGAIN = 4


def close_loops(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Looks for loops of the newest keyframe, and optimises the map if there are consistent ones.

    Args:
        methods: matcher and settings.
        slam_map: map with the new keyframe.
        state: candidates so far.

    Returns:
        The map and the candidates after.
    """
    row = len(slam_map) - 1
    if not methods.config.loops.is_on or row < 1 or is_resting(slam_map, state.loops, row):
        return slam_map, state
    candidates = find_loop_candidates(slam_map, row)
    state = state._replace(loops=examine_candidates(methods, slam_map, state.loops, candidates))
    # Smallest number of keyframes between two optimisations.
    wait = max(8, int(EVERY_SHARE * len(slam_map)))
    if len(slam_map) - state.num_optimized >= wait and has_new_loops(slam_map, state.loops):
        slam_map, state = optimize_map(slam_map, state)
        return slam_map, search_again(methods, slam_map, state)
    return slam_map, state


def join_keyframe(
    methods: SlamMethods, slam_map: KeyframeMap, loops: tuple[Loop, ...], row: int, is_allowed: Bool[np.ndarray, " k"]
) -> tuple[KeyframeMap, tuple[Loop, ...]]:
    """Looks for loops from a keyframe to keyframes of other maps, by retrieval.

    Args:
        methods: matcher and settings.
        slam_map: several maps in one record.
        loops: loops so far.
        row: row of the keyframe.
        is_allowed: False for keyframes that are no candidates.

    Returns:
        The map, unchanged, and the loops after.
    """
    if is_resting(slam_map, loops, row):
        return slam_map, loops
    candidates = similar_keyframes(slam_map, row, is_allowed)
    return slam_map, examine_candidates(methods, slam_map, loops, candidates)


def search_again(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> LoopState:
    """Registers keyframes with earlier ones that are near after the optimisation.

    Args:
        methods: matcher and settings.
        slam_map: map after the optimisation.
        state: its loops.

    Returns:
        The candidates after, in the order of their sources.
    """
    loops, keyframes = state.loops, slam_map.keyframes
    compared = {loop[:2] for loop in loops if loop.overlap is not None}
    joined_m = np.array([keyframes[loop.source].path_m for loop in loops if loop.status == "accepted"])
    new = [
        Loop(row, target, "distance")
        for _, row, target in nearest_pairs(slam_map)
        if (row, target) not in compared
        and not (np.abs(joined_m - keyframes[row].path_m) < keyframes[row].extent_m).any()
    ]
    for candidate in new[:MAX_AGAIN]:
        first = bisect_right(loops, candidate.source, key=lambda loop: loop.source)
        loops = (*loops[:first], *_register_candidates(methods, slam_map, [candidate]), *loops[first:])
        loops = accept_consistent(slam_map, loops, first)
    return state._replace(loops=loops)


def is_resting(slam_map: KeyframeMap, loops: Sequence[Loop], row: int) -> bool:
    """Returns True shortly after an accepted loop: another one would add little.

    Args:
        slam_map: the map.
        loops: loops so far.
        row: row of a keyframe.

    Returns:
        True if the last accepted loop is near along the path.
    """
    return path_since_loop_m(slam_map, loops, row) < 0.3 * slam_map.keyframes[row].extent_m


def examine_candidates(
    methods: SlamMethods, slam_map: KeyframeMap, loops: tuple[Loop, ...], candidates: list[Loop]
) -> tuple[Loop, ...]:
    """Registers candidates of a keyframe, and accepts loops that are consistent.

    Args:
        methods: matcher and settings.
        slam_map: the map.
        loops: loops so far; in the order of the keyframes of each chain.
        candidates: pairs of this keyframe and an older one, which may show the same place.

    Returns:
        All loops after.
    """
    num_before = len(loops)
    loops = (*loops, *_register_candidates(methods, slam_map, candidates))
    for number in range(num_before, len(loops)):
        loops = accept_consistent(slam_map, loops, number)
    return loops


def _register_candidates(methods: SlamMethods, slam_map: KeyframeMap, candidates: list[Loop]) -> list[Loop]:
    """Registers the candidates that most probably overlap, one by one, until one is accepted."""
    loops = _with_overlaps(methods, slam_map, candidates)
    overlapping = [number for number, loop in enumerate(loops) if loop.status == "not registered"]
    overlapping.sort(key=lambda number: -(loops[number].overlap or 0.0))
    for number in overlapping[:NUM_REGISTERED]:
        loop = loops[number]
        source, target = (submap_around(slam_map, row, NUM_SUBMAP) for row in loop[:2])
        (match,) = methods.matcher.register([(source, target)])
        loops[number] = with_match(slam_map, loop, match, methods.config.loops.min_probability)
        if loops[number].status == "waits for support":
            break
    return loops


def _with_overlaps(methods: SlamMethods, slam_map: KeyframeMap, candidates: list[Loop]) -> list[Loop]:
    """Predicts the overlap, some candidates at a time, until one surely overlaps; the remaining ones do not change."""
    loops = list(candidates)
    for start in range(0, len(candidates), NUM_ASKED):
        some = candidates[start : start + NUM_ASKED]
        scans = [slam_map.keyframes[loop.target].compact for loop in some]
        overlaps = methods.matcher.overlaps(slam_map.keyframes[some[0].source].compact, scans).tolist()
        for number, overlap in enumerate(overlaps, start):
            status: LoopStatus = "no overlap" if overlap < MIN_OVERLAP else "not registered"
            loops[number] = loops[number]._replace(status=status, overlap=overlap)
        # Overlap probability above which no further candidate is examined.
        if max(overlaps) >= 0.9:
            break
    return loops


def find_loop_candidates(slam_map: KeyframeMap, row: int) -> list[Loop]:
    """Finds older keyframes that may show the place of a keyframe.

    Candidates by distance lie within a radius. It grows with the length of the path between the two, because odometry
    drifts. Candidates by retrieval come from the whole map, even after drift or a lost track. Of several neighbours
    only the best is a candidate.

    Args:
        slam_map: the map.
        row: row of the new keyframe.

    Returns:
        Candidates by distance (nearest first) and by retrieval (most similar first), in turn; each row once.
    """
    extent_m, since_m = slam_map.keyframes[row].extent_m, _path_since_m(*_paths(slam_map), row)
    is_old = _is_old(since_m, row, extent_m)
    apart_m = slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3])
    is_near = is_old & (apart_m <= np.minimum(RADIUS_SHARE * extent_m + DRIFT_SHARE * since_m, MAX_RADIUS_M))
    near = np.argsort(np.where(is_near, apart_m, np.inf), kind="stable")[: int(is_near.sum())]
    # Largest number of candidates by distance: more find loops after a longer drift, at the cost of their overlap.
    near = _spread(near, slam_map, extent_m / 2, 6)
    by_distance = [Loop(row, int(other), "distance") for other in near]
    by_retrieval = [loop for loop in similar_keyframes(slam_map, row, is_old) if loop.target not in near]
    in_turn = itertools.chain.from_iterable(itertools.zip_longest(by_distance, by_retrieval))
    return [candidate for candidate in in_turn if candidate is not None]


def nearest_pairs(slam_map: KeyframeMap) -> list[tuple[float, int, int]]:
    """Finds the nearest older keyframe for a loop of each keyframe, by the estimated poses alone.

    Args:
        slam_map: the map.

    Returns:
        Distance in metres and both rows, the newer one first, nearest pairs first. Pairs farther apart than the extent
        of the newer scan are left out.
    """
    pairs, paths = [], _paths(slam_map)
    for row, keyframe in enumerate(slam_map.keyframes):
        is_old = _is_old(_path_since_m(*paths, row), row, keyframe.extent_m)
        apart_m = np.where(is_old, slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3]), np.inf)
        target = int(np.argmin(apart_m))
        if apart_m[target] < keyframe.extent_m:
            pairs.append((float(apart_m[target]), row, target))
    return sorted(pairs)


def similar_keyframes(slam_map: KeyframeMap, row: int, is_allowed: Bool[np.ndarray, " k"]) -> list[Loop]:
    """Finds keyframes that may show the place of a keyframe, by retrieval alone, without positions.

    Args:
        slam_map: the map; or several maps in one record.
        row: row of the keyframe.
        is_allowed: False for keyframes that are no candidates.

    Returns:
        Candidates, most similar first.
    """
    rows, cosines = most_similar(slam_map.vectors, slam_map.vectors[row], 5 * NUM_SIMILAR, is_allowed=is_allowed)
    spacing_m = slam_map.keyframes[row].extent_m / 2
    similar = _spread(rows[cosines >= MIN_COSINE], slam_map, spacing_m, NUM_SIMILAR)
    return [Loop(row, int(other), "retrieval") for other in similar]


def most_similar(
    vectors: Float[np.ndarray, "k d"],
    query: Float[np.ndarray, " d"],
    count: int,
    *,
    is_allowed: Bool[np.ndarray, " k"] | None = None,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Finds the vectors with the largest cosine, by one matrix product.

    The mean of many vectors is common to all places, so it is subtracted first.

    Args:
        vectors: unit vectors.
        query: vector of any norm.
        count: largest number of vectors.
        is_allowed: False for vectors that are no candidates.

    Returns:
        Rows, most similar first, and their cosines.
    """
    if len(vectors) == 0 or count == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    # The mean of fewer vectors is too noisy to subtract.
    mean = vectors.mean(axis=0) if len(vectors) >= 20 else np.zeros_like(query)
    centred = query - mean
    # |v - m|^2 = 1 - 2 v.m + m.m for unit vectors: no centred copy of the whole map.
    lengths = np.sqrt(np.maximum(1 - 2 * (vectors @ mean) + mean @ mean, 1e-12)) * max(np.linalg.norm(centred), 1e-6)
    cosines = (vectors @ centred - mean @ centred) / lengths
    if is_allowed is not None:
        cosines = np.where(is_allowed, cosines, -np.inf)
    count = min(count, len(cosines))
    rows = np.argsort(-cosines, kind="stable")[:count]
    rows = rows[np.isfinite(cosines[rows])]
    return rows, cosines[rows].astype(np.float32)


def _paths(slam_map: KeyframeMap) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Returns the lengths of the paths to all keyframes, and their segments."""
    return slam_map.column("path_m"), slam_map.column("segment")


def _path_since_m(path_m: Float[np.ndarray, " k"], segments: Int[np.ndarray, " k"], row: int) -> np.ndarray:
    """Returns the path length from each keyframe to that of `row`; infinite if the track was lost between them."""
    return np.where(segments == segments[row], path_m[row] - path_m, np.inf)


def _is_old(since_m: Float[np.ndarray, " k"], row: int, extent_m: float) -> Bool[np.ndarray, " k"]:
    """Returns True for keyframes early enough on the path for a loop to that of `row`."""
    return (np.arange(len(since_m)) < row) & (since_m > MIN_PATH_SHARE * extent_m)


def _spread(rows: Int[np.ndarray, " n"], slam_map: KeyframeMap, spacing_m: float, count: int) -> Int[np.ndarray, " m"]:
    """Returns the first rows without those within `spacing_m` of an earlier row of the same segment."""
    positions = slam_map.T_world_keyframe[rows, :3, 3]
    segments = np.array([slam_map.keyframes[row].segment for row in rows])

    def is_near(one: int) -> Bool[np.ndarray, " n"]:
        return (np.linalg.norm(positions - positions[one], axis=1) <= spacing_m) & (segments == segments[one])

    return rows[apart(np.arange(len(rows), 0.0, -1.0), is_near, count)]
