"""Loops: candidates as records, their acceptance by probability, odometry and pairwise consistency, and the solved map.

A single registration may be wrong at a place that looks like another place. It becomes an edge only together with
consistent registrations of other keyframes: odometry between them must close the cycle (Mangelson et al. 2018).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.scan.lidar.slide import diagonal_information, with_least_covariance
from dpmjax.slam.interfaces import Match
from dpmjax.slam.keyframe_map import KeyframeMap, MapEdge, as_pose_graph, measured_parts
from dpmjax.types import Information, Pose, Poses

# Standard deviations of a registration by descriptors alone: translation and rotation.
DESCRIPTOR_SIGMA_M, DESCRIPTOR_SIGMA_RAD = 0.2, 0.02

# Information of a registration by descriptors alone.
DESCRIPTOR_INFORMATION = diagonal_information(DESCRIPTOR_SIGMA_M, DESCRIPTOR_SIGMA_RAD)

# Lower bounds of the standard deviations of an aligned loop, translation and rotation: people and the motion of the
# lidar disturb scans.
FLOOR_M, FLOOR_RAD = 0.05, 0.005

# Standard deviation of odometry over one metre; it grows with the root of the path.
DRIFT_M = 0.05

# Standard deviation of the rotation of odometry over one metre.
DRIFT_RAD = 0.004

# Number of standard deviations within which a cycle closes.
CONSISTENT_SIGMAS = 3.0

# Share of the path by which a loop may contradict odometry in any case.
MIN_DRIFT_SHARE = 0.1

# Outcome of a loop candidate; every one but "accepted" is the reason why it is no edge.
LoopStatus = Literal[
    "not asked",
    "no overlap",
    "not registered",
    "improbable",
    "against odometry",
    "waits for support",
    "accepted",
    "taken back",
]


class Loop(NamedTuple):
    """A candidate of a loop.

    Attributes:
        source: row of the new keyframe.
        target: row of an older one.
        found_by: search that found it; "map" is a loop of the map that was extended.
        status: outcome.
        overlap: probability of overlap; 1 for a loop of the map that was extended. None if another candidate surely
            overlaps.
        probability: P(correct) of the registration; None without one.
        rmse: root mean square error of the registration, metres; None without one.
        T_target_source: motion of the registration; None without one.
        information: (6, 6) inverse covariance, as in `MapEdge`; None without a registration.
    """

    source: int
    target: int
    found_by: Literal["distance", "retrieval", "map"]
    status: LoopStatus = "not asked"
    overlap: float | None = None
    probability: float | None = None
    rmse: float | None = None
    T_target_source: Pose | None = None
    information: Information | None = None

    @property
    def edge(self) -> MapEdge:
        """The edge of a registered loop."""
        measured = np.asarray(self.T_target_source), np.asarray(self.information)
        return MapEdge(self.source, self.target, *measured, "loop")


class LoopState(NamedTuple):
    """All candidates so far.

    Attributes:
        loops: every candidate, in the order in which they were found.
        num_optimized: number of keyframes at the last optimisation.
    """

    loops: tuple[Loop, ...] = ()
    num_optimized: int = 0


def loops_of_map(slam_map: KeyframeMap) -> LoopState:
    """Lists the loops that an earlier run has accepted; the optimisation may remove them later.

    Args:
        slam_map: map of the earlier run.

    Returns:
        The loops.
    """
    known = [
        Loop(*edge[:2], "map", "accepted", 1.0, T_target_source=edge.T_target_source, information=edge.information)
        for edge in slam_map.edges_of("loop")
    ]
    # The edges of a thinned map join other keyframes than those that measured them.
    return LoopState(tuple(sorted(known, key=lambda loop: loop.source)), len(slam_map))


def num_accepted(loops: Iterable[Loop]) -> int:
    """Counts the accepted loops.

    Args:
        loops: all candidates.

    Returns:
        The number.
    """
    return sum(loop.status == "accepted" for loop in loops)


def path_since_loop_m(slam_map: KeyframeMap, loops: Sequence[Loop], row: int) -> float:
    """Returns the path from the last accepted loop to a keyframe; infinite without one in its segment."""
    last = next((slam_map.keyframes[loop.source] for loop in reversed(loops) if loop.status == "accepted"), None)
    keyframe = slam_map.keyframes[row]
    return np.inf if last is None or last.segment != keyframe.segment else keyframe.path_m - last.path_m


def has_new_loops(slam_map: KeyframeMap, loops: Iterable[Loop]) -> bool:
    """Returns True if loops were accepted since the last optimisation, so that they are not edges yet.

    Args:
        slam_map: the map.
        loops: all candidates.

    Returns:
        False if the edges hold all accepted loops.
    """
    return num_accepted(loops) > len(slam_map.edges_of("loop"))


def with_match(slam_map: KeyframeMap, loop: Loop, match: Match, min_probability: float) -> Loop:
    """Records the registration of a loop, and tests it against its probability and odometry.

    Args:
        slam_map: the map.
        loop: the candidate.
        match: its registration.
        min_probability: smallest accepted P(correct).

    Returns:
        The loop; it "waits for support", or its status is the reason of the rejection.
    """
    information = DESCRIPTOR_INFORMATION
    if match.information is not None:
        information = with_least_covariance(match.information, FLOOR_M, FLOOR_RAD)
    status = _status(slam_map, loop, match, min_probability)
    return Loop(*loop[:3], status, loop.overlap, match.probability, match.rmse, match.T_target_source, information)


def _status(slam_map: KeyframeMap, loop: Loop, match: Match, min_probability: float) -> LoopStatus:
    if match.probability < min_probability:
        return "improbable"
    source, target = slam_map.keyframes[loop.source], slam_map.keyframes[loop.target]
    if source.segment == target.segment:
        path_m = abs(source.path_m - target.path_m)
        T_world = slam_map.T_world_keyframe
        predicted = rigid.inverse(T_world[loop.target]) @ T_world[loop.source]
        sigma_m, sigma_rad = _drift(path_m)
        most_m = CONSISTENT_SIGMAS * sigma_m + MIN_DRIFT_SHARE * path_m
        most_rad = CONSISTENT_SIGMAS * sigma_rad + MIN_DRIFT_SHARE
        if not are_near(predicted, match.T_target_source, most_m, most_rad):
            return "against odometry"
    return "waits for support"


def accept_consistent(slam_map: KeyframeMap, loops: tuple[Loop, ...], number: int) -> tuple[Loop, ...]:
    """Accepts a loop and waiting loops if enough of them agree pairwise (greedy by probability).

    Args:
        slam_map: the map.
        loops: all candidates, in the order of their sources.
        number: index of the loop. Only a loop that waits for support changes.

    Returns:
        All candidates after.
    """
    if loops[number].status != "waits for support":
        return loops

    def agree(one: int, other: int) -> bool:
        return are_consistent(slam_map, loops[one], loops[other])

    near = list(_near_along(slam_map, loops, number))
    # Largest number of accepted loops that are compared with a new one.
    compared = [other for other in near if loops[other].status == "accepted"][:6]
    others = [other for other in near if other in compared or loops[other].status == "waits for support"]
    others = [other for other in others if agree(number, other)]
    members = [number]
    for other in sorted(others, key=lambda other: -(loops[other].probability or 0.0)):
        if all(agree(member, other) for member in members[1:]):
            members.append(other)
    # A single registration may be wrong with a high probability.
    if len(members) < 2:
        return loops
    return tuple(loop._replace(status="accepted") if row in members else loop for row, loop in enumerate(loops))


def are_consistent(slam_map: KeyframeMap, loop: Loop, other: Loop) -> bool:
    """Returns True if two loops of different keyframes and the odometry between their ends make a cycle that closes.

    Args:
        slam_map: the map.
        loop: a registered candidate.
        other: another one.

    Returns:
        False also if the loops are too far apart for a test.
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
    sigma_m, sigma_rad = _drift(sum(paths_m))
    # A rotation error of a registration moves the far end in proportion to the length of the odometry between them.
    sigma_m = float(np.hypot(sigma_m, DESCRIPTOR_SIGMA_RAD * max(paths_m)))
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
    # Largest distance along the path between the ends of registrations that support each other.
    return a.segment == b.segment and abs(a.path_m - b.path_m) <= 40.0


def _drift(path_m: float) -> tuple[float, float]:
    """Returns standard deviations of a cycle of two registrations and a path of odometry: metres, radians."""
    return (
        float(np.sqrt(2 * DESCRIPTOR_SIGMA_M**2 + DRIFT_M**2 * path_m)),
        float(np.sqrt(2 * DESCRIPTOR_SIGMA_RAD**2 + DRIFT_RAD**2 * path_m)),
    )


def optimize_map(slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Optimises all poses, and removes loops that contradict the remaining edges.

    If a loop joins two parts for the first time, one part first moves to the pose that the loop gives. A predicted
    motion is dropped if measured edges join its ends.

    Args:
        slam_map: the map.
        state: its loops.

    Returns:
        The map and the loops after.
    """
    measured, guesses = slam_map.edges_of("odometry"), slam_map.edges_of("guess")
    accepted = [number for number, loop in enumerate(state.loops) if loop.status == "accepted"]
    edges = [state.loops[number].edge for number in accepted]
    T_world_keyframe = move_parts(slam_map.T_world_keyframe, measured_parts(slam_map), edges)
    graph = as_pose_graph(replace(slam_map, T_world_keyframe=T_world_keyframe, edges=(*edges, *measured, *guesses)))
    # Number of contradicting loops that would remove an edge of odometry.
    trust = np.full(len(graph.edges.source), 1e9)
    trust[: len(edges)] = 1.0
    # Cost above which the optimisation reduces the weight of a loop edge.
    settings = PoseGraphConfig(outlier_chi2=25.0, is_chordal_start=False)
    solved = optimize_pose_graph(graph, settings, trust=trust)
    # Smallest weight of a loop edge that stays after the optimisation.
    loops, is_kept = list(state.loops), solved.weights[: len(edges)] >= 0.25
    for number in np.array(accepted, int)[~is_kept]:
        loops[number] = loops[number]._replace(status="taken back")
    kept = [edge for edge, stays in zip(edges, is_kept, strict=True) if stays]
    slam_map = replace(slam_map, T_world_keyframe=solved.graph.poses, edges=(*measured, *guesses, *kept))
    return slam_map, LoopState(tuple(loops), len(slam_map))


def move_parts(T_world_keyframe: Poses, parts: Int[np.ndarray, " k"], edges: Sequence[MapEdge]) -> Poses:
    """Moves whole parts so that one edge between two parts holds exactly, as a start near the solution.

    Args:
        T_world_keyframe: poses of the keyframes.
        parts: number of the part of each keyframe.
        edges: edges within parts and between parts.

    Returns:
        The poses after.
    """
    T_world, parts = T_world_keyframe.copy(), parts.copy()
    for edge in edges:
        into, moved = parts[edge.target], parts[edge.source]
        if into != moved:
            T_new_world = T_world[edge.target] @ edge.T_target_source @ rigid.inverse(T_world[edge.source])
            rows = parts == moved
            T_world[rows] = T_new_world @ T_world[rows]
            parts[rows] = into
    return T_world
