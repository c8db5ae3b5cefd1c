"""Acceptance of the registrations of loop candidates: by their own numbers, by odometry, and by one another.

A single registration may be wrong in a place that looks like another. It becomes an edge only together with others, of
other keyframes, that agree with it over the odometry between them (pairwise consistency, Mangelson et al. 2018).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.slam.config import LoopClosureConfig
from dpmjax.slam.interfaces import Match
from dpmjax.slam.keyframes import KeyframeMap, are_near
from dpmjax.slam.reports import Loop, LoopStatus

MAX_CONTRADICTED_SHARE = 0.1
"""Largest share of points in free space."""

MIN_MATCHED_SHARE = 0.35
"""Smallest share of points that meet planes, where the scans verify a registration."""

DRIFT_M = 0.05
"""Standard deviation of odometry over one metre; it grows with the root of the path."""

PENDING_PATH_M = 40.0
"""Largest distance along the path between the ends of registrations that support each other."""

DRIFT_RAD = 0.004
"""Standard deviation of the rotation of odometry over one metre."""

CONSISTENT_SIGMAS = 3.0
"""Number of standard deviations within which a cycle closes."""

MIN_DRIFT_SHARE = 0.1
"""Share of the path by which a loop may contradict odometry in any case."""

MAX_WITNESSES = 6
"""So many accepted loops are asked whether they agree with a new one."""


def loop_status(slam_map: KeyframeMap, loop: Loop, match: Match, config: LoopClosureConfig) -> LoopStatus:
    """Tests a registration of a loop against its probability, the agreement of the scans, and odometry.

    Args:
        slam_map: the map.
        loop: the candidate.
        match: its registration.
        config: thresholds.

    Returns:
        "waits for support", or the reason of the rejection.
    """
    if match.probability < config.min_probability:
        return "improbable"
    if not scans_agree(match):
        return "scans disagree"
    source, target = slam_map.keyframes[loop.source], slam_map.keyframes[loop.target]
    if source.segment == target.segment:
        path_m = abs(source.path_m - target.path_m)
        T_world = slam_map.T_world_keyframe
        predicted = rigid.inverse(T_world[loop.target]) @ T_world[loop.source]
        sigma_m, sigma_rad = _drift(path_m, config)
        most_m = CONSISTENT_SIGMAS * sigma_m + MIN_DRIFT_SHARE * path_m
        most_rad = CONSISTENT_SIGMAS * sigma_rad + MIN_DRIFT_SHARE
        if not are_near(predicted, match.T_target_source, most_m, most_rad):
            return "against odometry"
    return "waits for support"


def scans_agree(match: Match) -> bool:
    """Returns True if enough points of the scans meet planes under a registration, and few lie in free space.

    Args:
        match: the registration.

    Returns:
        True also where the matcher has no scans.
    """
    shares = match.verification
    return shares is None or (
        shares.matched_share >= MIN_MATCHED_SHARE and shares.contradicted_share <= MAX_CONTRADICTED_SHARE
    )


def accept_consistent(
    slam_map: KeyframeMap, loops: tuple[Loop, ...], number: int, config: LoopClosureConfig
) -> tuple[Loop, ...]:
    """Accepts a loop, and those that waited for it, if enough of them agree pairwise (greedy by probability).

    Args:
        slam_map: the map.
        loops: all candidates, in the order of their sources.
        number: of the loop, which is registered.
        config: uncertainties and the number that is enough.

    Returns:
        All candidates after.
    """
    others, num_witnesses = [], 0
    for other in _near_along(slam_map, loops, number):
        is_witness = loops[other].status == "accepted"
        if not (is_witness or loops[other].status == "waits for support"):
            continue
        if num_witnesses < MAX_WITNESSES or not is_witness:
            others.append(other)
            num_witnesses += is_witness
    others = [other for other in others if are_consistent(slam_map, loops[number], loops[other], config)]
    members = [number]
    for other in sorted(others, key=lambda other: -(loops[other].probability or 0.0)):
        if all(are_consistent(slam_map, loops[member], loops[other], config) for member in members[1:]):
            members.append(other)
    if len(members) < config.min_support:
        return loops
    after = list(loops)
    for member in members:
        after[member] = loops[member]._replace(status="accepted")
    return tuple(after)


def are_consistent(slam_map: KeyframeMap, loop: Loop, other: Loop, config: LoopClosureConfig) -> bool:
    """Returns True if two loops of different keyframes and the odometry between their ends make a cycle that closes.

    Args:
        slam_map: the map.
        loop: a registered candidate.
        other: another one.
        config: uncertainties.

    Returns:
        False also where the loops are too far from each other to tell.
    """
    if loop.source == other.source or loop.T_target_source is None or other.T_target_source is None:
        return False
    rows = list(zip(loop[:2], other[:2], strict=True))
    if not all(_is_near_along(slam_map, a, b) for a, b in rows):
        return False
    ends = [(slam_map.keyframes[a], slam_map.keyframes[b]) for a, b in rows]
    paths_m = [abs(a.path_m - b.path_m) for a, b in ends]
    T_source_other, T_target_other = (rigid.inverse(a.T_odometry_keyframe) @ b.T_odometry_keyframe for a, b in ends)
    one_way, other_way = loop.T_target_source @ T_source_other, T_target_other @ other.T_target_source
    sigma_m, sigma_rad = _drift(sum(paths_m), config)
    # A rotation error of a registration moves the far end in proportion to the length of the odometry between them.
    sigma_m = float(np.hypot(sigma_m, config.sigma_rad * max(paths_m)))
    return are_near(one_way, other_way, CONSISTENT_SIGMAS * sigma_m, CONSISTENT_SIGMAS * sigma_rad)


def _near_along(slam_map: KeyframeMap, loops: Sequence[Loop], number: int) -> Iterator[int]:
    """Yields all further loops whose sources are near along the path: those before, latest first, then those after."""
    for others in (range(number - 1, -1, -1), range(number + 1, len(loops))):
        for other in others:
            if not _is_near_along(slam_map, loops[number].source, loops[other].source):
                break
            yield other


def _is_near_along(slam_map: KeyframeMap, row: int, other: int) -> bool:
    """Returns True if two keyframes are near each other along one unbroken path."""
    a, b = slam_map.keyframes[row], slam_map.keyframes[other]
    return a.segment == b.segment and abs(a.path_m - b.path_m) <= PENDING_PATH_M


def _drift(path_m: float, config: LoopClosureConfig) -> tuple[float, float]:
    """Returns standard deviations of a cycle of two registrations and a path of odometry: metres, radians."""
    return (
        float(np.sqrt(2 * config.sigma_m**2 + DRIFT_M**2 * path_m)),
        float(np.sqrt(2 * config.sigma_rad**2 + DRIFT_RAD**2 * path_m)),
    )
