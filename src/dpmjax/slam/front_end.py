"""The front end: one scan after the other gets a pose, and some become keyframes (DeepPointMap section 4).

Geometry comes first, because it is more accurate than descriptors of 0.3 m voxels. Where it fails, the network gives
another start, and the scans themselves decide between the two. Where nothing agrees, the pose is a guess.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid
from dpmjax.scans.deskew import deskew
from dpmjax.slam.alignment import PosePrior
from dpmjax.slam.keyframes import (
    EdgeKind,
    Keyframe,
    KeyframeMap,
    MapEdge,
    Pose,
    Submap,
    add_keyframe,
    are_near,
    diagonal_information,
    orthonormal,
    submap_around,
    turn_rad,
    with_origin,
)
from dpmjax.slam.methods import SlamMethods
from dpmjax.slam.reports import ScanReport, ScanStatus
from dpmjax.types import AnyArray

UNKNOWN_M = 1000.0
"""Standard deviation of a place that nothing is known of."""


class FrontEndState(NamedTuple):
    """What the next scan needs of those before. The frame is that of the last keyframe.

    Attributes:
        num_scans: number of scans so far, those of a loaded map among them.
        local_map: recent scans; None before the first.
        T_keyframe_last: pose of the last scan.
        T_before_last: its motion since the scan before.
        scores: of recent scans that were believed.
        num_lost: number of scans since one was believed.
    """

    num_scans: int = 0
    local_map: Any | None = None
    T_keyframe_last: Pose = np.eye(4)
    T_before_last: Pose = np.eye(4)
    scores: tuple[float, ...] = ()
    num_lost: int = 0


class Located(NamedTuple):
    """The pose of a scan in the frame of the last keyframe, and why it is believed or not.

    Attributes:
        T_keyframe_scan: the pose.
        status: how it was found.
        reason: the numbers that decided.
        score: agreement with the local map.
        information: (6, 6) in the tangent of the scan.
        probability: P(correct) of the network; None where it was not asked.
        description: of the scan, by the matcher; None where it was not asked.
    """

    T_keyframe_scan: Pose
    status: ScanStatus
    reason: str
    score: float
    information: Float[np.ndarray, "6 6"]
    probability: float | None = None
    description: Any | None = None


class TimedScan(NamedTuple):
    """A raw scan with the time of each point, to be deskewed by the predicted motion.

    Attributes:
        points: (n, 3) metres, each in the frame of the lidar at its own moment.
        offsets: (n,) times since the scan's pose, as shares of the time between scans; see `scans.deskew`.
    """

    points: Float[AnyArray, "n 3"]
    offsets: Float[AnyArray, " n"]


AnyScan = Float[AnyArray, "_n 3"] | TimedScan


def step(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: AnyScan
) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    """Places a scan.

    Args:
        methods: matcher, geometry, settings.
        state: after the scan before.
        slam_map: the map so far.
        scan: points in metres, in the frame of the lidar, perhaps with times.

    Returns:
        The state and the map after, and how the scan was placed.
    """
    T_turn = state.T_before_last if isinstance(scan, TimedScan) else None
    points = corrected_points(scan, T_turn)
    measured = methods.geometry.measure(points)
    if measured is None:
        return _pass_over(state, slam_map)
    prepared = Scan(points, measured, T_turn)
    if state.local_map is None:
        reason = "a new part of the map begins here" if len(slam_map) else "the map begins here"
        located = Located(np.eye(4), "first", reason, 1.0, diagonal_information(UNKNOWN_M, np.pi))
        return _make_keyframe(methods, state, slam_map, prepared, located)
    located = _locate(methods, state, slam_map, prepared)
    # The next prediction uses this pose three times, so a rounding error would triple from scan to scan.
    located = located._replace(T_keyframe_scan=orthonormal(located.T_keyframe_scan))
    if located.status == "restarted" or _is_keyframe(methods, located, measured):
        return _make_keyframe(methods, state, slam_map, prepared, located)
    after = _advanced(methods, state, located, measured)
    return after, slam_map, _report(state, slam_map, located, is_keyframe=False)._replace(T_turn=T_turn)


def corrected_points(scan: AnyScan, T_turn: Pose | None) -> Float[np.ndarray, "n 3"]:
    """Returns the finite points of a scan, and undoes the motion of the lidar where the scan has times.

    Args:
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: motion from one scan to the next; None leaves the points as they are.

    Returns:
        The points.
    """
    points = np.asarray(scan.points if isinstance(scan, TimedScan) else scan)
    is_finite = np.isfinite(points).all(axis=1)
    if not isinstance(scan, TimedScan) or T_turn is None:
        return points[is_finite]
    return deskew(points[is_finite], np.asarray(scan.offsets)[is_finite], T_turn)


class Scan(NamedTuple):
    """A scan that is not empty.

    Attributes:
        points: metres, in the frame of the lidar.
        measured: what the geometry has measured of it.
        T_turn: motion that its points were corrected by; None for none.
    """

    points: Float[np.ndarray, "n 3"]
    measured: Any
    T_turn: Pose | None = None


def _pass_over(state: FrontEndState, slam_map: KeyframeMap) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    guess = diagonal_information(1.0, 1.0)
    located = Located(state.T_keyframe_last @ state.T_before_last, "empty", "too few points", 0.0, guess)
    after = state._replace(num_scans=state.num_scans + 1, T_keyframe_last=located.T_keyframe_scan)
    return after, slam_map, _report(state, slam_map, located, is_keyframe=False)


def _locate(methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: Scan) -> Located:
    config = methods.config.front_end
    usual = float(np.median(state.scores)) if state.scores else 1.0
    # Nothing is usual yet where a part of the map begins: sparse scans never score high.
    wanted = max(config.min_score, config.min_score_share * usual if state.scores else 0.0)
    prior = PosePrior(state.T_keyframe_last, state.T_before_last, usual)
    found = methods.geometry.align(state.local_map, scan.measured, prior)
    if found.score >= wanted:
        reason = f"score {found.score:.2f} of usually {usual:.2f}"
        return Located(found.T_map_scan, "tracked", reason, found.score, found.information)
    description = methods.matcher.describe(scan.points, scan.measured)
    source = Submap((description,), np.eye(4)[None])
    target = submap_around(slam_map, len(slam_map) - 1, config.num_submap, config.submap_radius_m)
    match = methods.matcher.register([(source, target)])[0]
    start = PosePrior(match.T_target_source, np.eye(4), usual, is_sure=True)
    other = methods.geometry.align(state.local_map, scan.measured, start)
    numbers = f"score {found.score:.2f} by geometry, {other.score:.2f} by the network with P {match.probability:.2f}"
    is_confirmed = (
        match.probability >= config.min_probability
        and other.score >= config.min_score
        and are_near(found.T_map_scan, other.T_map_scan, config.near_m, config.near_rad)
        and are_near(match.T_target_source, other.T_map_scan, config.near_m, config.near_rad)
    )
    if is_confirmed or (other.score >= wanted and other.score > found.score):
        agreed = other.score, other.information, match.probability
        return Located(other.T_map_scan, "network", numbers, *agreed, description)
    status: ScanStatus = "restarted" if state.num_lost + 1 >= config.num_lost else "predicted"
    guess = diagonal_information(config.guess_m, config.guess_rad)
    predicted = state.T_keyframe_last @ state.T_before_last
    # What geometry prefers is the better guess, unless a robot hardly moves like that.
    is_likely = are_near(predicted, found.T_map_scan, 3 * config.guess_m, 3 * config.guess_rad)
    T = found.T_map_scan if is_likely else predicted
    return Located(T, status, numbers, max(found.score, other.score), guess, match.probability, description)


def _is_keyframe(methods: SlamMethods, located: Located, measured: Any) -> bool:
    if located.status == "predicted":
        return False
    config, T = methods.config.front_end, located.T_keyframe_scan
    spacing_m = config.keyframe_share * methods.geometry.extent_m(measured)
    spacing_m = float(np.clip(spacing_m, config.min_keyframe_m, config.max_keyframe_m))
    return bool(np.linalg.norm(T[:3, 3]) > spacing_m) or turn_rad(T) > config.keyframe_rad


def _make_keyframe(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: Scan, located: Located
) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    matcher, geometry, T = methods.matcher, methods.geometry, located.T_keyframe_scan
    row = len(slam_map)
    is_guess = row > 0 and located.status in ("first", "restarted")
    description = located.description
    if description is None:
        description = matcher.describe(scan.points, scan.measured)
    T_odometry, T_world, path_m, segment, edge = T, T, 0.0, 0, None
    if row:
        last = slam_map.keyframes[-1]
        T_odometry, T_world = last.T_odometry_keyframe @ T, slam_map.T_world_keyframe[-1] @ T
        path_m, segment = last.path_m + float(np.linalg.norm(T[:3, 3])), last.segment + is_guess
        kind: EdgeKind = "guess" if is_guess else "odometry"
        edge = MapEdge(row, row - 1, T, located.information, kind)
    keyframe = Keyframe(state.num_scans, T_odometry, path_m, segment, geometry.extent_m(scan.measured), description)
    slam_map = with_origin(slam_map, methods.origin)
    slam_map = add_keyframe(slam_map, keyframe, T_world, matcher.vector(description), edge)
    after = _advanced(methods, state, located, scan.measured)
    if is_guess or row == 0:
        local_map = geometry.insert(None, scan.measured, np.eye(4), state.num_scans)
    else:
        local_map = geometry.move(after.local_map, rigid.inverse(T))
    after = after._replace(local_map=local_map, T_keyframe_last=np.eye(4))
    report = _report(state, slam_map, located._replace(T_keyframe_scan=np.eye(4)), is_keyframe=True)
    return after, slam_map, report._replace(T_turn=scan.T_turn)


def _advanced(methods: SlamMethods, state: FrontEndState, located: Located, measured: Any) -> FrontEndState:
    """Returns the state after a scan: only a believed one joins the local map and changes the predicted motion."""
    T = located.T_keyframe_scan
    after = state._replace(num_scans=state.num_scans + 1, T_keyframe_last=T)
    if located.status == "predicted":
        return after._replace(num_lost=state.num_lost + 1)
    if located.status in ("first", "restarted"):
        return after._replace(num_lost=0, scores=())
    return after._replace(
        local_map=methods.geometry.insert(state.local_map, measured, T, state.num_scans),
        T_before_last=rigid.inverse(state.T_keyframe_last) @ T,
        scores=(*state.scores, located.score)[-methods.config.front_end.usual_window :],
        num_lost=0,
    )


def _report(state: FrontEndState, slam_map: KeyframeMap, located: Located, *, is_keyframe: bool) -> ScanReport:
    keyframe, T = max(len(slam_map) - 1, 0), located.T_keyframe_scan
    numbers = located.score, located.probability
    return ScanReport(state.num_scans, located.status, located.reason, keyframe, T, is_keyframe, *numbers)
