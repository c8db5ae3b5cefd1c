"""Loop closure: detection, registration map to map, and verification (DeepPointMap section 4).

Loops that agree with others become edges, and the map is optimised.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from dpmjax.scans.weak_directions import with_least_covariance
from dpmjax.slam.interfaces import Match, SlamMethods
from dpmjax.slam.keyframe_map import KeyframeMap, submap_around
from dpmjax.slam.loop_candidates import find_loop_candidates, nearest_pairs
from dpmjax.slam.loops import (
    DESCRIPTOR_INFORMATION,
    Loop,
    LoopState,
    LoopStatus,
    accept_consistent,
    loop_status,
    num_accepted,
)
from dpmjax.slam.map_optimization import optimize_map

# Overlap probability above which no further candidate is examined.
SURE_OVERLAP = 0.9

# Lower bound of the standard deviation of an aligned loop: people and the motion of the lidar disturb scans.
FLOOR_M = 0.05

# Lower bound of the standard deviation of the rotation of an aligned loop.
FLOOR_RAD = 0.005

# Length of path after an accepted loop without a search for another one, in extents.
REST_SHARE = 0.3

# Smallest number of keyframes between two optimisations.
EVERY_KEYFRAMES = 8

# Share of all keyframes between two optimisations, so that the cost of a scan does not grow with the map.
EVERY_SHARE = 0.05

# Largest number of further registrations after an optimisation.
MAX_AGAIN = 4


def close_loops(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Looks for loops of the newest keyframe, and optimises where consistent ones were found.

    Args:
        methods: matcher and settings.
        slam_map: map with the new keyframe.
        state: candidates so far.

    Returns:
        The map and the candidates after.
    """
    config, row = methods.config.loops, len(slam_map) - 1
    if not config.is_on or row < 1 or is_resting(slam_map, state.loops, row):
        return slam_map, state
    loops = examine_candidates(methods, slam_map, state.loops, find_loop_candidates(slam_map, row, config))
    is_stale = state.is_stale or num_accepted(loops) > num_accepted(state.loops)
    state = LoopState(loops, state.num_optimized, is_stale)
    wait = max(EVERY_KEYFRAMES, int(EVERY_SHARE * len(slam_map)))
    if is_stale and len(slam_map) - state.num_optimized >= wait:
        slam_map, state = optimize_map(slam_map, state)
        return slam_map, search_again(methods, slam_map, state)
    return slam_map, state


def search_again(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> LoopState:
    """Registers keyframes with earlier ones that the optimisation has brought near.

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
        loops = accept_consistent(slam_map, loops, first, methods.config.loops)
    return state._replace(loops=loops, is_stale=num_accepted(loops) > num_accepted(state.loops))


def is_resting(slam_map: KeyframeMap, loops: Sequence[Loop], row: int) -> bool:
    """Returns True shortly after an accepted loop: another one would add little.

    Args:
        slam_map: the map.
        loops: loops so far.
        row: row of a keyframe.

    Returns:
        True where the last accepted loop is near along the path.
    """
    last = next((slam_map.keyframes[loop.source] for loop in reversed(loops) if loop.status == "accepted"), None)
    if last is None:
        return False
    keyframe = slam_map.keyframes[row]
    return keyframe.segment == last.segment and keyframe.path_m - last.path_m < REST_SHARE * keyframe.extent_m


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
        loops = accept_consistent(slam_map, loops, number, methods.config.loops)
    return loops


def _register_candidates(methods: SlamMethods, slam_map: KeyframeMap, candidates: list[Loop]) -> list[Loop]:
    """Registers the candidates that most probably overlap, one by one, until one is accepted."""
    config, num_submap = methods.config.loops, methods.config.front_end.num_submap
    loops = _with_overlaps(methods, slam_map, candidates)
    overlapping = [number for number, loop in enumerate(loops) if loop.status == "not registered"]
    overlapping.sort(key=lambda number: -(loops[number].overlap or 0.0))
    for number in overlapping[: config.num_registered]:
        loop = loops[number]
        source, target = (submap_around(slam_map, row, num_submap) for row in loop[:2])
        (match,) = methods.matcher.register([(source, target)])
        loops[number] = loop._replace(
            status=loop_status(slam_map, loop, match, config),
            probability=match.probability,
            rmse=match.rmse,
            T_target_source=match.T_target_source,
            information=_edge_information(match),
        )
        if loops[number].status == "waits for support":
            break
    return loops


def _with_overlaps(methods: SlamMethods, slam_map: KeyframeMap, candidates: list[Loop]) -> list[Loop]:
    """Predicts the overlap, some candidates at a time, until one surely overlaps; the remaining ones do not change."""
    config, loops = methods.config.loops, list(candidates)
    for start in range(0, len(candidates), config.num_asked):
        some = candidates[start : start + config.num_asked]
        overlaps = [1.0] * len(some)
        if config.min_overlap > 0:
            scans = [slam_map.keyframes[loop.target].compact for loop in some]
            overlaps = methods.matcher.overlaps(slam_map.keyframes[some[0].source].compact, scans).tolist()
        for number, overlap in enumerate(overlaps, start):
            status: LoopStatus = "no overlap" if overlap < config.min_overlap else "not registered"
            loops[number] = loops[number]._replace(status=status, overlap=overlap)
        if config.min_overlap > 0 and max(overlaps) >= SURE_OVERLAP:
            break
    return loops


def _edge_information(match: Match) -> Float[np.ndarray, "6 6"]:
    """Returns the information by the planes, with an upper bound; without planes, that of descriptors."""
    if match.information is None:
        return DESCRIPTOR_INFORMATION
    return with_least_covariance(match.information, FLOOR_M, FLOOR_RAD)
