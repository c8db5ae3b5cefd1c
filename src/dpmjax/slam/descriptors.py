"""SLAM by descriptors alone, as published: odometry, keyframes and loops (DeepPointMap section 4).

Each scan is registered with the nearest keyframe, and the decoder's motion is its pose. A scan that becomes a keyframe
is registered again, now with the merged descriptors of the keyframes around the nearest one. No surface is aligned. Of
the candidates of a loop, the overlap head chooses one, which is registered map to map and verified. Each accepted loop
becomes an edge, and the map is optimised. The numbers are those of the published configuration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near, orthonormal, turn_rad
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.scan.lidar.slide import diagonal_information
from dpmjax.slam.config import DescriptorConfig
from dpmjax.slam.interfaces import Match, PreparedInput, SlamMethods
from dpmjax.slam.keyframe_map import (
    SUBMAP_RADIUS_M,
    Keyframe,
    KeyframeMap,
    MapEdge,
    Submap,
    as_pose_graph,
    measured_parts,
    steps_from,
    submap_of,
)
from dpmjax.slam.loops import DESCRIPTOR_INFORMATION, Loop, LoopState, LoopStatus, move_parts, path_since_loop_m
from dpmjax.slam.track import UNKNOWN_M, FrontEndState, RegisteredScan, ScanReport, empty_reason, with_keyframe
from dpmjax.types import Information

# Largest number of edges to a keyframe of a neighbourhood, and of keyframes in it.
NUM_STEPS, NUM_NEIGHBOURS = 5, 16

# Number of scans in a row without an accepted registration, of which the best is accepted.
NUM_DROPPED = 5

# Smallest distance of keyframes, and largest factor of the configured one.
MIN_KEYFRAME_M, MAX_RATIO = 1.0, 2.0

# Weight of the factor before in its running mean.
RATIO_MEMORY = 0.9

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

# State, map and report after a scan.
Placed = tuple[FrontEndState, KeyframeMap, ScanReport]


def place_scan(methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: PreparedInput) -> Placed:
    """Registers a scan with the nearest keyframe, and makes it a keyframe if it is far from all keyframes.

    A registration beyond the limits is dropped, and the scan gets the pose of the last motion. After five scans in
    a row without an accepted registration, the registration of the smallest error is accepted.

    Args:
        methods: matcher and settings.
        state: after the scan before.
        slam_map: the map so far.
        scan: the scan, encoded unless it is empty.

    Returns:
        The state and the map after the scan, and its report.
    """
    row, thinned, compact = max(len(slam_map) - 1, 0), scan.thinned, scan.compact
    predicted = state.T_keyframe_last @ np.linalg.matrix_power(state.T_before_last, len(state.dropped) + 1)
    report = ScanReport(state.num_scans, "empty", empty_reason(scan), row, predicted, num_points=scan.num_points)
    state = state._replace(num_scans=state.num_scans + 1)
    if thinned is None or compact is None:
        return state._replace(dropped=(*state.dropped, None)), slam_map, report
    report = report._replace(T_turn=scan.T_turn)
    if state.keyframe_ratio is None:
        first = Keyframe(report.scan, np.eye(4), 0.0, 0, thinned.extent_m, compact)
        return _begin_part(methods, state, slam_map, first, report)
    target = nearest_keyframe(slam_map, state)
    match = methods.matcher.match(Submap((compact,), np.eye(4)[None]), submap_of(slam_map, [target]))
    registered = RegisteredScan(report.scan, thinned.extent_m, compact, target, match)
    report = report._replace(reason=_reason(match), score=match.probability)
    if is_accepted(match, methods.config.descriptors):
        return _accept(methods, state, slam_map, registered, report._replace(status="tracked"))
    state, report = state._replace(dropped=(*state.dropped, registered)), report._replace(status="predicted")
    best = best_of(state.dropped)
    if len(state.dropped) < NUM_DROPPED or best is None:
        return state, slam_map, report
    return _recover(methods, state, slam_map, best, report)


def is_accepted(match: Match, config: DescriptorConfig) -> bool:
    """Returns True for a registration within the limits of confidence and error."""
    return match.probability >= config.min_confidence and match.rmse <= config.max_rmse_m


def next_ratio(ratio: float, rmse: float, max_rmse_m: float) -> float:
    """Updates the factor of the distance of keyframes (published configuration; the paper gives no formula).

    Args:
        ratio: the factor before.
        rmse: error of an accepted registration, metres.
        max_rmse_m: at this error or a larger one, the factor falls to 0.

    Returns:
        The factor after, in [0, 2]. Small errors let it grow.
    """
    quality = (1 - min(rmse / max_rmse_m, 1.0)) ** 2
    return float(np.clip(RATIO_MEMORY * ratio + (1 - RATIO_MEMORY) * MAX_RATIO * quality, 0.0, MAX_RATIO))


def best_of(dropped: tuple[RegisteredScan | None, ...]) -> RegisteredScan | None:
    """Returns the scan of the smallest error among the last five; None if no scan has a motion."""
    found = [one for one in dropped[-NUM_DROPPED:] if one is not None and np.isfinite(one.match.rmse)]
    return min(found, key=lambda one: one.match.rmse, default=None)


def neighbours_of(slam_map: KeyframeMap, row: int, radius_m: float = np.inf) -> Int[np.ndarray, " n"]:
    """Finds the keyframes around one by a search along the measured edges.

    Args:
        slam_map: the map.
        row: row of the keyframe.
        radius_m: keyframes farther away are left out.

    Returns:
        Rows of up to 16 keyframes within five edges: fewest edges first, then nearest first; `row` is the first.
    """
    steps, apart_m = steps_from(slam_map, row, NUM_STEPS), slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3])
    rows = np.lexsort((apart_m, steps))[: min(NUM_NEIGHBOURS, int(np.isfinite(steps).sum()))]
    return rows[apart_m[rows] <= radius_m]


def nearest_keyframe(slam_map: KeyframeMap, state: FrontEndState) -> int:
    """Returns the row of the keyframe nearest to the last known pose, among the neighbours of the last keyframe."""
    near = neighbours_of(slam_map, len(slam_map) - 1)
    T_world_last = slam_map.T_world_keyframe[-1] @ state.T_keyframe_last
    return int(near[np.argmin(slam_map.distances_to(T_world_last[:3, 3])[near])])


def information_of(match: Match) -> Information:
    """Returns the information of a registration, or the usual one of descriptors if it has none."""
    return DESCRIPTOR_INFORMATION if match.information is None else match.information


def _reason(match: Match) -> str:
    return f"confidence {match.probability:.2f}, error {match.rmse:.2f} m"


def _begin_part(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, keyframe: Keyframe, report: ScanReport
) -> Placed:
    """Makes the first scan of a map, or of a new part of a loaded one, a keyframe."""
    row, edge = len(slam_map), None
    if row:
        edge = MapEdge(row, row - 1, np.eye(4), diagonal_information(UNKNOWN_M, np.pi), "guess")
    slam_map = with_keyframe(methods, slam_map, keyframe, edge)
    reason = "a new part of the map begins here" if row else "the map begins here"
    report = report._replace(status="first", reason=reason, keyframe=row, is_keyframe=True, score=1.0)
    state = state._replace(keyframe_ratio=1.0, dropped=(), T_keyframe_last=np.eye(4))
    return state, slam_map, report._replace(T_keyframe_scan=np.eye(4))


def _accept(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, found: RegisteredScan, report: ScanReport
) -> Placed:
    """Accepts the registration of a scan, and makes it a keyframe if it is far from all keyframes."""
    config, ratio, match = methods.config.descriptors, state.keyframe_ratio or 0.0, found.match
    T_world_scan = slam_map.T_world_keyframe[found.target] @ match.T_target_source
    apart_m = slam_map.distances_to(T_world_scan[:3, 3])[neighbours_of(slam_map, len(slam_map) - 1)]
    T_world_last, row, target = slam_map.T_world_keyframe[-1], len(slam_map), found.target
    is_keyframe = bool(apart_m.min() > max(config.keyframe_m * ratio, MIN_KEYFRAME_M))
    if is_keyframe:
        match = _register_with_map(methods, slam_map, found)
        edge = MapEdge(row, target, match.T_target_source, information_of(match), "odometry")
        keyframe = Keyframe(found.scan, np.eye(4), 0.0, 0, found.extent_m, found.compact)
        slam_map = with_keyframe(methods, slam_map, keyframe, edge)
        T_world_scan = slam_map.T_world_keyframe[row]
        report = report._replace(reason=f"{report.reason}; with the map: {_reason(match)}")
    T_keyframe_scan = orthonormal(rigid.inverse(T_world_last) @ T_world_scan)
    # After dropped scans, the motion of one scan is not known.
    T_before_last = state.T_before_last if state.dropped else rigid.inverse(state.T_keyframe_last) @ T_keyframe_scan
    state = state._replace(
        T_before_last=T_before_last,
        T_keyframe_last=np.eye(4) if is_keyframe else T_keyframe_scan,
        dropped=(),
        keyframe_ratio=next_ratio(ratio, found.match.rmse, config.max_rmse_m),
    )
    keyframe_row, T = (row, np.eye(4)) if is_keyframe else (target, match.T_target_source)
    return state, slam_map, report._replace(keyframe=keyframe_row, T_keyframe_scan=T, is_keyframe=is_keyframe)


def _register_with_map(methods: SlamMethods, slam_map: KeyframeMap, found: RegisteredScan) -> Match:
    """Registers a scan with the merged keyframes around its target, unless its error grows beyond the limit there."""
    rows = neighbours_of(slam_map, found.target, SUBMAP_RADIUS_M).tolist()
    if len(rows) == 1:
        return found.match
    match = methods.matcher.match(Submap((found.compact,), np.eye(4)[None]), submap_of(slam_map, rows))
    limit_m = max(methods.config.descriptors.max_rmse_m, found.match.rmse)
    return match if match.rmse <= limit_m else found.match


def _recover(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, best: RegisteredScan, report: ScanReport
) -> Placed:
    """Accepts the best of the dropped scans; from its pose on, the last motion goes on to the present scan."""
    num_since = report.scan - best.scan
    reason = f"scan {best.scan} of the dropped ones is accepted: {_reason(best.match)}"
    state, slam_map, report = _accept(methods, state, slam_map, best, report._replace(reason=reason))
    if num_since == 0:
        return state, slam_map, report._replace(status="network")
    T = state.T_keyframe_last @ np.linalg.matrix_power(state.T_before_last, num_since)
    report = report._replace(keyframe=len(slam_map) - 1, T_keyframe_scan=T)
    return state._replace(T_keyframe_last=T), slam_map, report


def close_loops(methods: SlamMethods, slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
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
    slam_map, loops = join_keyframe(methods, slam_map, state.loops, row, np.arange(len(slam_map)) < row)
    return slam_map, LoopState(loops, len(slam_map))


def join_keyframe(
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
    is_away = (np.linalg.norm(T_row_other[:, :3, 3], axis=1) >= NEAR_M) & (
        path_since_loop_m(slam_map, loops, row) >= NEAR_M
    )
    is_far_along = (steps > NUM_NEAR_STEPS) | (is_turned & is_away)
    is_known = (apart_m <= RADIUS_M) & (steps > MIN_STEPS) & is_far_along
    return np.flatnonzero(is_allowed & (is_other | is_known))


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
