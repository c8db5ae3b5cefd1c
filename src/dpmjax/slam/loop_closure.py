"""Loop closure: candidates are registered map to map and verified; consistent ones correct the map, and can be undone.

A single registration may be wrong in a place that looks like another. It becomes an edge only together with others, of
other keyframes, that agree with it over the odometry between them (pairwise consistency, Mangelson et al. 2018).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.config import LoopClosureConfig
from dpmjax.slam.keyframes import (
    KeyframeMap,
    MapEdge,
    as_pose_graph,
    connected_parts,
    diagonal_information,
    submap_around,
    turn_rad,
    with_edges,
    with_poses,
)
from dpmjax.slam.loop_candidates import LoopCandidate, find_candidates
from dpmjax.slam.matcher import Match
from dpmjax.slam.methods import SlamMethods
from dpmjax.slam.reports import Loop, LoopStatus

CERTAIN = 1e9
"""So many loops would have to contradict an edge of odometry before it is let go."""


class LoopState(NamedTuple):
    """All candidates so far.

    Attributes:
        loops: every candidate, in the order in which they were found.
        num_optimized: number of keyframes at the last optimisation.
        is_stale: whether loops were accepted since.
    """

    loops: tuple[Loop, ...] = ()
    num_optimized: int = 0
    is_stale: bool = False


def loops_of_map(slam_map: KeyframeMap) -> LoopState:
    """Lists the loops that an earlier run has accepted, so that they can still be taken back.

    Args:
        slam_map: of the earlier run.

    Returns:
        The loops.
    """
    edges = [edge for edge in slam_map.edges if edge.kind == "loop"]
    loops = (Loop(e.source, e.target, "map", "accepted", 1.0, T_target_source=e.T_target_source) for e in edges)
    return LoopState(tuple(loops), len(slam_map), False)


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
    if not config.is_on or row < 1 or _is_resting(slam_map, state, config):
        return slam_map, state
    found = _register_candidates(methods, slam_map, row, find_candidates(slam_map, row, config))
    loops = (*state.loops, *found)
    for number in range(len(state.loops), len(loops)):
        if loops[number].status == "waits for support":
            loops = _accept_consistent(slam_map, loops, number, config)
    num_before = sum(loop.status == "accepted" for loop in state.loops)
    accepted = [loop for loop in loops if loop.status == "accepted"]
    is_stale = state.is_stale or len(accepted) > num_before
    state = LoopState(loops, state.num_optimized, is_stale)
    wait = max(config.every_keyframes, int(config.every_share * len(slam_map)))
    if is_stale and len(slam_map) - state.num_optimized >= wait:
        return optimize_map(slam_map, state, config)
    return slam_map, state


def optimize_map(slam_map: KeyframeMap, state: LoopState, config: LoopClosureConfig) -> tuple[KeyframeMap, LoopState]:
    """Optimises all poses, and takes back loops that contradict the rest.

    A predicted motion gives way where measured ones join its ends.

    Args:
        slam_map: the map.
        state: its loops.
        config: robust kernel.

    Returns:
        The map and the loops after.
    """
    measured = [edge for edge in slam_map.edges if edge.kind == "odometry"]
    information = diagonal_information(config.sigma_m, config.sigma_rad)
    accepted = [number for number, loop in enumerate(state.loops) if loop.status == "accepted"]
    edges = [_loop_edge(state.loops[number], information) for number in accepted]
    part = connected_parts(len(slam_map), [*measured, *edges])
    guesses = [edge for edge in slam_map.edges if edge.kind == "guess"]
    held = [edge for edge in guesses if part[edge.source] != part[edge.target]]
    graph = as_pose_graph(with_edges(slam_map, [*edges, *measured, *held]))
    trust = np.full(len(graph.edges.source), CERTAIN)
    trust[: len(edges)] = 1.0
    settings = PoseGraphConfig(outlier_chi2=config.edge_outlier_chi2, is_chordal_start=False)
    solved = optimize_pose_graph(graph, settings, trust=trust)
    loops = list(state.loops)
    kept = []
    for number, edge, weight in zip(accepted, edges, solved.weights[: len(edges)], strict=True):
        if weight < config.taken_back_weight:
            loops[number] = loops[number]._replace(status="taken back")
        else:
            kept.append(edge)
    slam_map = with_poses(with_edges(slam_map, [*measured, *guesses, *kept]), solved.graph.poses)
    return slam_map, LoopState(tuple(loops), len(slam_map), False)


def _is_resting(slam_map: KeyframeMap, state: LoopState, config: LoopClosureConfig) -> bool:
    """Whether a loop was accepted just before: another one would tell little."""
    for loop in reversed(state.loops):
        if loop.status == "accepted":
            keyframe, last = slam_map.keyframes[-1], slam_map.keyframes[loop.source]
            rest_m = config.rest_share * keyframe.extent_m
            return keyframe.segment == last.segment and keyframe.path_m - last.path_m < rest_m
    return False


def _register_candidates(
    methods: SlamMethods, slam_map: KeyframeMap, row: int, candidates: list[LoopCandidate]
) -> list[Loop]:
    if not candidates:
        return []
    config, front = methods.config.loops, methods.config.front_end
    targets = [slam_map.keyframes[candidate.row].description for candidate in candidates]
    overlaps = np.ones(len(candidates))
    if config.min_overlap > 0:
        overlaps = methods.matcher.overlaps(slam_map.keyframes[row].description, targets)
    order = [int(number) for number in np.argsort(-overlaps, kind="stable") if overlaps[number] >= config.min_overlap]
    chosen = order[: config.num_registered]
    submaps = [
        submap_around(slam_map, other, front.num_submap, front.submap_radius_m)
        for other in (row, *(candidates[number].row for number in chosen))
    ]
    matches = methods.matcher.register([(submaps[0], target) for target in submaps[1:]]) if chosen else []
    loops = []
    for number, candidate in enumerate(candidates):
        overlap = float(overlaps[number])
        status: LoopStatus = "no overlap" if overlap < config.min_overlap else "not registered"
        loop = Loop(row, candidate.row, candidate.found_by, status, overlap)
        if number in chosen:
            match = matches[chosen.index(number)]
            loop = loop._replace(
                status=_judged(slam_map, loop, match, config),
                probability=match.probability,
                rmse_m=match.rmse_m,
                T_target_source=match.T_target_source,
            )
        loops.append(loop)
    return loops


def _judged(slam_map: KeyframeMap, loop: Loop, match: Match, config: LoopClosureConfig) -> LoopStatus:
    if match.probability < config.min_probability:
        return "improbable"
    shares = match.verification
    if shares is not None and (
        shares.matched_share < config.min_matched_share or shares.contradicted_share > config.max_contradicted_share
    ):
        return "scans disagree"
    source, target = slam_map.keyframes[loop.source], slam_map.keyframes[loop.target]
    if source.segment == target.segment:
        path_m = abs(source.path_m - target.path_m)
        T_world = slam_map.T_world_keyframe
        predicted = rigid.inverse(T_world[loop.target]) @ T_world[loop.source]
        apart = rigid.inverse(predicted) @ match.T_target_source
        sigma_m, sigma_rad = _drift(path_m, config)
        most_m = config.consistent_sigmas * sigma_m + config.min_drift_share * path_m
        most_rad = config.consistent_sigmas * sigma_rad + config.min_drift_share
        if np.linalg.norm(apart[:3, 3]) > most_m or turn_rad(apart) > most_rad:
            return "against odometry"
    return "waits for support"


def _accept_consistent(
    slam_map: KeyframeMap, loops: tuple[Loop, ...], number: int, config: LoopClosureConfig
) -> tuple[Loop, ...]:
    """Accepts a loop, and those that waited for it, if enough of them agree pairwise (greedy by probability)."""
    others = []
    for other in range(len(loops) - 1, -1, -1):
        if not _is_near_along(slam_map, loops[number].source, loops[other].source, config):
            break
        if loops[other].status in ("waits for support", "accepted") and other != number:
            others.append(other)
    others = [other for other in others if are_consistent(slam_map, loops[number], loops[other], config)]
    members = [number]
    for other in sorted(others, key=lambda other: -(loops[other].probability or 0.0)):
        if all(are_consistent(slam_map, loops[member], loops[other], config) for member in members):
            members.append(other)
    if len(members) < config.min_support:
        return loops
    return tuple(loop._replace(status="accepted") if index in members else loop for index, loop in enumerate(loops))


def are_consistent(slam_map: KeyframeMap, loop: Loop, other: Loop, config: LoopClosureConfig) -> bool:
    """Whether two loops of different keyframes and the odometry between their ends make a cycle that closes.

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
    if not all(_is_near_along(slam_map, a, b, config) for a, b in rows):
        return False
    ends = [(slam_map.keyframes[a], slam_map.keyframes[b]) for a, b in rows]
    paths_m = [abs(a.path_m - b.path_m) for a, b in ends]
    T_source_other, T_target_other = (rigid.inverse(a.T_odometry_keyframe) @ b.T_odometry_keyframe for a, b in ends)
    around = rigid.inverse(loop.T_target_source @ T_source_other) @ T_target_other @ other.T_target_source
    sigma_m, sigma_rad = _drift(sum(paths_m), config)
    # A turn of either registration moves the other end by the length of the odometry between them.
    sigma_m = float(np.hypot(sigma_m, config.sigma_rad * max(paths_m)))
    is_near = np.linalg.norm(around[:3, 3]) <= config.consistent_sigmas * sigma_m
    return bool(is_near) and turn_rad(around) <= config.consistent_sigmas * sigma_rad


def _is_near_along(slam_map: KeyframeMap, row: int, other: int, config: LoopClosureConfig) -> bool:
    """Whether two keyframes are near each other along one unbroken path."""
    a, b = slam_map.keyframes[row], slam_map.keyframes[other]
    return a.segment == b.segment and abs(a.path_m - b.path_m) <= config.pending_path_m


def _drift(path_m: float, config: LoopClosureConfig) -> tuple[float, float]:
    """Returns standard deviations of a cycle of two registrations and a path of odometry: metres, radians."""
    return (
        float(np.sqrt(2 * config.sigma_m**2 + config.drift_m**2 * path_m)),
        float(np.sqrt(2 * config.sigma_rad**2 + config.drift_rad**2 * path_m)),
    )


def _loop_edge(loop: Loop, information: np.ndarray) -> MapEdge:
    if loop.T_target_source is None:
        raise ValueError("loop: expected a registered one, got a candidate")
    return MapEdge(loop.source, loop.target, loop.T_target_source, information, "loop")
