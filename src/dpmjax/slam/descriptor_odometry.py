"""Odometry by descriptors alone: the decoder's motion is the pose of a scan (DeepPointMap section 4).

Each scan is registered with the nearest keyframe. A scan that becomes a keyframe is registered again, now with the
merged descriptors of the keyframes around the nearest one. No surface is aligned.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import orthonormal
from dpmjax.scans.weak_directions import diagonal_information
from dpmjax.slam.config import DescriptorConfig
from dpmjax.slam.front_end import UNKNOWN_M, FrontEndState, RegisteredScan, ScanReport, empty_reason, with_keyframe
from dpmjax.slam.interfaces import Match, PreparedInput, SlamMethods
from dpmjax.slam.keyframe_map import SUBMAP_RADIUS_M, Keyframe, KeyframeMap, MapEdge, Submap, steps_from, submap_of
from dpmjax.slam.loops import DESCRIPTOR_INFORMATION
from dpmjax.types import Information

# Largest number of edges to a keyframe of a neighbourhood, and of keyframes in it (published configuration).
NUM_STEPS, NUM_NEIGHBOURS = 5, 16

# Number of scans in a row without an accepted registration, of which the best is accepted (published configuration).
NUM_DROPPED = 5

# Smallest distance of keyframes, and largest factor of the configured one (published configuration).
MIN_KEYFRAME_M, MAX_RATIO = 1.0, 2.0

# Weight of the factor before in its running mean (published configuration).
RATIO_MEMORY = 0.9

# State, map and report after a scan.
Placed = tuple[FrontEndState, KeyframeMap, ScanReport]


def place_by_descriptors(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: PreparedInput
) -> Placed:
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


def keyframe_spacing_m(ratio: float, config: DescriptorConfig) -> float:
    """Returns the least distance to all keyframes at which a scan becomes a keyframe."""
    return max(config.keyframe_m * ratio, MIN_KEYFRAME_M)


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
    is_keyframe = bool(apart_m.min() > keyframe_spacing_m(ratio, config))
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
