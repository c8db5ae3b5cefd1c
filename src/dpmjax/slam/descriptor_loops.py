"""Loop closure by descriptors alone: overlap head, registration map to map, and verification (DeepPointMap section 4).

The numbers are those of the published configuration. Each accepted loop becomes an edge, and the map is optimised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near, turn_rad
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.descriptor_odometry import information_of, is_accepted, neighbours_of
from dpmjax.slam.interfaces import Match, SlamMethods
from dpmjax.slam.keyframe_map import (
    SUBMAP_RADIUS_M,
    KeyframeMap,
    as_pose_graph,
    measured_parts,
    steps_from,
    submap_of,
)
from dpmjax.slam.loops import Loop, LoopState, LoopStatus
from dpmjax.slam.map_optimization import move_parts

# Largest horizontal distance of a candidate by the estimated poses.
RADIUS_M = 100.0

# A candidate is more edges away than the first number. Up to the second one, it must differ by a turn and a distance,
# and this distance must lie between two loops, so that a straight drive closes none with itself.
MIN_STEPS, NUM_NEAR_STEPS = 2, 30
NEAR_RAD, NEAR_M = math.radians(30.0), 10.0

# Standard deviations of odometry in one step, and their number within which a loop agrees with it.
STEP_SIGMA_M, STEP_SIGMA_RAD, NUM_SIGMAS = 0.4, math.radians(0.5), 3.0

# Numbers of edges from which on the translation and the rotation are not compared.
NUM_TRANSLATION_STEPS, NUM_ROTATION_STEPS = 100, 5000


def close_loops_by_descriptors(
    methods: SlamMethods, slam_map: KeyframeMap, state: LoopState
) -> tuple[KeyframeMap, LoopState]:
    """Looks for a loop of the newest keyframe, and optimises the map if there is one.

    Args:
        methods: matcher and settings.
        slam_map: map with the new keyframe.
        state: loops so far.

    Returns:
        The map and the loops after. Only the candidate of the highest overlap is noted.
    """
    if not methods.config.loops.is_on:
        return slam_map, state
    row = len(slam_map) - 1
    slam_map, loops = join_keyframe_by_descriptors(methods, slam_map, state.loops, row, np.arange(len(slam_map)) < row)
    return slam_map, LoopState(loops, len(slam_map))


def join_keyframe_by_descriptors(
    methods: SlamMethods, slam_map: KeyframeMap, loops: tuple[Loop, ...], row: int, is_allowed: Bool[np.ndarray, " k"]
) -> tuple[KeyframeMap, tuple[Loop, ...]]:
    """Looks for a loop from a keyframe to allowed ones, and optimises the map if a loop is accepted.

    Args:
        methods: matcher and settings.
        slam_map: the map; or several maps in one record.
        loops: loops so far.
        row: row of the keyframe.
        is_allowed: False for keyframes that are no candidates.

    Returns:
        The map and the loops after.
    """
    steps = steps_from(slam_map, row)
    targets = find_loop_targets(slam_map, loops, row, steps, is_allowed)
    if not len(targets):
        return slam_map, loops
    compact = [slam_map.keyframes[target].compact for target in targets]
    overlaps = methods.matcher.overlaps(slam_map.keyframes[row].compact, compact)
    best = int(np.argmax(overlaps))
    loop = Loop(row, int(targets[best]), "distance", "no overlap", float(overlaps[best]))
    if overlaps[best] > methods.config.descriptors.min_overlap:
        source_rows, target_rows = disjoint_neighbours(slam_map, row, loop.target)
        match = methods.matcher.match(submap_of(slam_map, source_rows), submap_of(slam_map, target_rows))
        status = verify_match(methods, slam_map, loop, match, float(steps[loop.target]))
        measured = match.probability, match.rmse, match.T_target_source
        loop = Loop(*loop[:3], status, loop.overlap, *measured, information_of(match))
    if loop.status == "accepted":
        slam_map = optimize_with_loop(slam_map, loop)
    return slam_map, (*loops, loop)


def find_loop_targets(
    slam_map: KeyframeMap,
    loops: Sequence[Loop],
    row: int,
    steps: np.ndarray,
    is_allowed: Bool[np.ndarray, " k"],
) -> Int[np.ndarray, " c"]:
    """Finds keyframes that may show the place of a keyframe.

    Args:
        slam_map: the map.
        loops: loops so far.
        row: row of the keyframe.
        steps: (k,) number of edges from it to each keyframe.
        is_allowed: False for keyframes that are no candidates.

    Returns:
        Rows of keyframes within 100 m, and of all keyframes that no edges join to `row`, whose distance is unknown.
    """
    T_world, part = slam_map.T_world_keyframe, measured_parts(slam_map)
    T_row_other = rigid.inverse(T_world[row]) @ T_world
    apart_m = np.linalg.norm(T_world[:, :2, 3] - T_world[row, :2, 3], axis=1)
    is_other = part != part[row]
    is_turned = np.array([turn_rad(T) >= NEAR_RAD for T in T_row_other])
    is_away = (np.linalg.norm(T_row_other[:, :3, 3], axis=1) >= NEAR_M) & _is_rested(slam_map, loops, row)
    is_far_along = (steps > NUM_NEAR_STEPS) | (is_turned & is_away)
    is_known = (apart_m <= RADIUS_M) & (steps > MIN_STEPS) & is_far_along
    return np.flatnonzero(is_allowed & (is_other | is_known))


def _is_rested(slam_map: KeyframeMap, loops: Sequence[Loop], row: int) -> bool:
    """Returns True if the last accepted loop of the same drive is far enough back along the path."""
    last = next((slam_map.keyframes[loop.source] for loop in reversed(loops) if loop.status == "accepted"), None)
    keyframe = slam_map.keyframes[row]
    return last is None or last.segment != keyframe.segment or keyframe.path_m - last.path_m >= NEAR_M


def disjoint_neighbours(slam_map: KeyframeMap, row: int, target: int) -> tuple[list[int], list[int]]:
    """Finds the keyframes around both ends of a loop. A keyframe that is around both belongs to the nearer end.

    Args:
        slam_map: the map.
        row: row of the first end.
        target: row of the second end.

    Returns:
        The rows around each end; the end itself is the first row.
    """
    ends = row, target
    near = [neighbours_of(slam_map, end, SUBMAP_RADIUS_M).tolist() for end in ends]
    to_row, to_target = (slam_map.distances_to(slam_map.T_world_keyframe[end, :3, 3]) for end in ends)
    shared = set(near[0]) & set(near[1])
    of_row = {other for other in shared if to_row[other] <= to_target[other]}
    return [o for o in near[0] if o not in shared - of_row], [o for o in near[1] if o not in of_row]


def verify_match(methods: SlamMethods, slam_map: KeyframeMap, loop: Loop, match: Match, num_steps: float) -> LoopStatus:
    """Tests the registration of a loop by its own numbers, and against the graph.

    Args:
        methods: limits of the registration.
        slam_map: the map.
        loop: the candidate.
        match: its registration.
        num_steps: number of edges between both ends; infinite without any.

    Returns:
        "accepted", or the reason of the rejection.
    """
    if not is_accepted(match, methods.config.descriptors):
        return "improbable"
    T_world = slam_map.T_world_keyframe
    predicted = rigid.inverse(T_world[loop.target]) @ T_world[loop.source]
    most_m, most_rad = (NUM_SIGMAS * sigma * math.sqrt(num_steps) for sigma in (STEP_SIGMA_M, STEP_SIGMA_RAD))
    most_m = most_m if num_steps < NUM_TRANSLATION_STEPS else math.inf
    most_rad = most_rad if num_steps < NUM_ROTATION_STEPS else math.inf
    return "accepted" if are_near(predicted, match.T_target_source, most_m, most_rad) else "against odometry"


def optimize_with_loop(slam_map: KeyframeMap, loop: Loop) -> KeyframeMap:
    """Adds the edge of a loop, and finds the poses that agree best with all edges. No edge is rejected.

    If the loop joins two parts for the first time, one part first moves to the pose that the loop gives.

    Args:
        slam_map: the map.
        loop: an accepted loop.

    Returns:
        The map after; the first keyframe stays.
    """
    T_world_keyframe = move_parts(slam_map.T_world_keyframe, measured_parts(slam_map), [loop.edge])
    slam_map = replace(slam_map, T_world_keyframe=T_world_keyframe, edges=(*slam_map.edges, loop.edge))
    solved = optimize_pose_graph(as_pose_graph(slam_map), PoseGraphConfig(is_chordal_start=False))
    return replace(slam_map, T_world_keyframe=solved.graph.poses)
