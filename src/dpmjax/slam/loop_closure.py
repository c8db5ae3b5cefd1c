"""Loop closure: candidates are registered map to map and verified; consistent ones correct the map."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from dpmjax.scans.plane_information import with_least_covariance
from dpmjax.slam.config import LoopClosureConfig
from dpmjax.slam.interfaces import Match, SlamMethods
from dpmjax.slam.keyframes import KeyframeMap, Submap, diagonal_information, submap_around
from dpmjax.slam.loop_candidates import LoopCandidate, find_loop_candidates, nearest_pairs
from dpmjax.slam.loop_consistency import accept_consistent, loop_status
from dpmjax.slam.map_optimization import optimize_map
from dpmjax.slam.reports import Loop, LoopState, LoopStatus

SURE_OVERLAP = 0.9
"""Overlap probability from which on no further candidate is looked at."""

FLOOR_M = 0.05
"""Lower bound of the standard deviation of an aligned loop: scans hold walkers and motion."""

FLOOR_RAD = 0.005
"""Lower bound of the standard deviation of the rotation of an aligned loop."""

REST_SHARE = 0.3
"""Path after an accepted loop on which no other is looked for, in extents."""

EVERY_KEYFRAMES = 8
"""Smallest number of keyframes between two optimisations."""

EVERY_SHARE = 0.05
"""Share of all keyframes between two optimisations: the cost of a scan does not grow with the map."""

MAX_AGAIN = 4
"""Number of registrations after an optimisation."""


def close_loops(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Looks for loops of the newest keyframe, and optimises where consistent ones were found.

    Args:
        methods: matcher and settings.
        slam_map: with the new keyframe.
        state: candidates so far.

    Returns:
        The map and the candidates after.
    """
    config = methods.config.loops
    row = len(slam_map) - 1
    if not config.is_on or row < 1 or is_resting(slam_map, state.loops, row):
        return slam_map, state
    loops = examine_candidates(methods, slam_map, state.loops, row, find_loop_candidates(slam_map, row, config))
    is_stale = state.is_stale or num_accepted(loops) > num_accepted(state.loops)
    state = LoopState(loops, state.num_optimized, is_stale)
    wait = max(EVERY_KEYFRAMES, int(EVERY_SHARE * len(slam_map)))
    if is_stale and len(slam_map) - state.num_optimized >= wait:
        slam_map, state = optimize_map(slam_map, state, config)
        return slam_map, search_again(methods, slam_map, state)
    return slam_map, state


def search_again(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> LoopState:
    """Registers keyframes with earlier ones that are near only since the optimisation.

    Args:
        methods: matcher and settings.
        slam_map: after the optimisation.
        state: its loops.

    Returns:
        The candidates after, in the order of their sources.
    """
    config, loops = methods.config.loops, state.loops
    compared = {(loop.source, loop.target) for loop in loops if loop.overlap is not None}
    keyframes = slam_map.keyframes
    joined_m = np.array([keyframes[loop.source].path_m for loop in loops if loop.status == "accepted"])
    new = [
        (row, target)
        for _, row, target in nearest_pairs(slam_map)
        if (row, target) not in compared
        and not (np.abs(joined_m - keyframes[row].path_m) < keyframes[row].extent_m).any()
    ]
    for row, target in new[:MAX_AGAIN]:
        first = bisect_right(loops, row, key=lambda loop: loop.source)
        candidate = LoopCandidate(target, "distance")
        (loop,) = _register_candidates(methods, slam_map, row, [candidate])
        loops = (*loops[:first], loop, *loops[first:])
        if loop.status == "waits for support":
            loops = accept_consistent(slam_map, loops, first, config)
    return state._replace(loops=loops, is_stale=num_accepted(loops) > num_accepted(state.loops))


def is_resting(slam_map: KeyframeMap, loops: Sequence[Loop], row: int) -> bool:
    """Returns True shortly after an accepted loop: another one would add little.

    Args:
        slam_map: the map.
        loops: so far.
        row: of a keyframe.

    Returns:
        True where the last accepted loop is near along the path.
    """
    for loop in reversed(loops):
        if loop.status == "accepted":
            keyframe, last = slam_map.keyframes[row], slam_map.keyframes[loop.source]
            rest_m = REST_SHARE * keyframe.extent_m
            return keyframe.segment == last.segment and keyframe.path_m - last.path_m < rest_m
    return False


def examine_candidates(
    methods: SlamMethods, slam_map: KeyframeMap, loops: tuple[Loop, ...], row: int, candidates: list[LoopCandidate]
) -> tuple[Loop, ...]:
    """Registers candidates of a keyframe, and accepts loops that are consistent.

    Args:
        methods: matcher and settings.
        slam_map: the map.
        loops: so far; in the order of the keyframes of each chain.
        row: of the keyframe.
        candidates: older keyframes that may show the same place.

    Returns:
        All loops after.
    """
    config, num_before = methods.config.loops, len(loops)
    loops = (*loops, *_register_candidates(methods, slam_map, row, candidates))
    for number in range(num_before, len(loops)):
        if loops[number].status == "waits for support":
            loops = accept_consistent(slam_map, loops, number, config)
    return loops


def num_accepted(loops: Iterable[Loop]) -> int:
    """Counts the accepted loops.

    Args:
        loops: all candidates.

    Returns:
        The number.
    """
    return sum(loop.status == "accepted" for loop in loops)


def _register_candidates(
    methods: SlamMethods, slam_map: KeyframeMap, row: int, candidates: list[LoopCandidate]
) -> list[Loop]:
    """Registers the candidates that most probably overlap, one by one, until one is accepted."""
    config, front = methods.config.loops, methods.config.front_end
    loops = [
        Loop(row, candidate.row, candidate.found_by, _unregistered(overlap, config), overlap)
        for candidate, overlap in zip(candidates, _overlaps(methods, slam_map, row, candidates), strict=True)
    ]
    overlapping = [number for number, loop in enumerate(loops) if loop.status == "not registered"]
    overlapping.sort(key=lambda number: -(loops[number].overlap or 0.0))

    def submap(center: int) -> Submap:
        return submap_around(slam_map, center, front.num_submap)

    for number in overlapping[: config.num_registered]:
        (match,) = methods.matcher.register([(submap(row), submap(loops[number].target))])
        loops[number] = loops[number]._replace(
            status=loop_status(slam_map, loops[number], match, config),
            probability=match.probability,
            rmse=match.rmse,
            T_target_source=match.T_target_source,
            information=_edge_information(match, config),
        )
        if loops[number].status == "waits for support":
            break
    return loops


def _overlaps(
    methods: SlamMethods, slam_map: KeyframeMap, row: int, candidates: list[LoopCandidate]
) -> list[float | None]:
    """Predicts the overlap of some candidates at a time, until one surely overlaps; None for the remaining ones."""
    config = methods.config.loops
    if config.min_overlap == 0:
        return [1.0] * len(candidates)
    scans = [slam_map.keyframes[candidate.row].compact for candidate in candidates]
    found: list[float | None] = []
    for start in range(0, len(candidates), config.num_asked):
        some = scans[start : start + config.num_asked]
        found += methods.matcher.overlaps(slam_map.keyframes[row].compact, some).tolist()
        if max(filter(None, found), default=0.0) >= SURE_OVERLAP:
            break
    return found + [None] * (len(candidates) - len(found))


def _unregistered(overlap: float | None, config: LoopClosureConfig) -> LoopStatus:
    if overlap is None:
        return "not asked"
    return "no overlap" if overlap < config.min_overlap else "not registered"


def _edge_information(match: Match, config: LoopClosureConfig) -> Float[np.ndarray, "6 6"]:
    """Returns the information by the planes, with an upper bound; for descriptors alone, that of the configuration."""
    if match.information is None:
        return diagonal_information(config.sigma_m, config.sigma_rad)
    return with_least_covariance(match.information, FLOOR_M, FLOOR_RAD)
