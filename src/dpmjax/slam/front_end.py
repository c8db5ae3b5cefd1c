"""The front end: each scan in turn gets a pose, and some become keyframes (DeepPointMap section 4).

A first guess comes from the motion of before or from the decoder. The alignment with the local map makes it exact, and
the share of elements that meet planes decides whether the pose is accepted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.prepared_scans import CompactScan
from dpmjax.geometry import rigid
from dpmjax.scans.deskew import deskew
from dpmjax.slam.interfaces import Alignment, SlamMethods, ThinnedScan, best_of
from dpmjax.slam.keyframes import (
    EdgeKind,
    Keyframe,
    KeyframeMap,
    MapEdge,
    Pose,
    add_keyframe,
    are_near,
    diagonal_information,
    orthonormal,
    turn_rad,
    with_origin,
)
from dpmjax.slam.local_map import (
    LocalMap,
    PlacedElements,
    joined_surface,
    local_map_of,
    nearest_keyframe,
    placed_scan,
    with_scan,
)
from dpmjax.slam.reports import ScanReport, ScanStatus
from dpmjax.types import AnyArray

KEYFRAME_RAD = 0.6
"""Turn between keyframes at a smaller distance."""

MIN_SCORE = 0.2
"""Smallest accepted score."""

MIN_SCORE_SHARE = 0.4
"""Smallest accepted share of the usual score."""

NUM_HYPOTHESES = 3
"""Number of motions that the decoder proposes."""

GOOD_SHARE = 0.85
"""Share of the usual score from which on no other start is tried."""

NEAR_M = 2.0
"""Poses farther apart are of other places."""

NEAR_RAD = 0.087
"""Largest turn between the decoder's motion and the pose that it confirms."""

MIN_MARGIN = 0.1
"""Difference of the scores from which on the decoder's motion replaces another one."""

USUAL_WINDOW = 20
"""Number of scans whose median is the usual score."""

GUESS_M = 1.0
"""Standard deviation of a predicted translation."""

GUESS_RAD = 0.2
"""Standard deviation of a predicted rotation."""

UNKNOWN_M = 1000.0
"""Standard deviation of a place that nothing is known of."""


class FrontEndState(NamedTuple):
    """State of odometry after a scan. The frame is that of the last keyframe.

    Attributes:
        num_scans: number of scans so far, those of a loaded map among them.
        is_begun: True from the first keyframe of this run on.
        recent: the last scans that were accepted some distance apart, oldest first.
        local_map: nearest keyframes and recent scans; None where it has to be made from the map.
        T_keyframe_last: pose of the last scan.
        T_before_last: motion of the last scan since the scan before.
        scores: of recent scans that were accepted.
        num_lost: number of scans since one was accepted.
    """

    num_scans: int = 0
    is_begun: bool = False
    recent: tuple[PlacedElements, ...] = ()
    local_map: LocalMap | None = None
    T_keyframe_last: Pose = np.eye(4)
    T_before_last: Pose = np.eye(4)
    scores: tuple[float, ...] = ()
    num_lost: int = 0


class Located(NamedTuple):
    """The pose of a scan in the frame of the last keyframe, and why it is accepted or not.

    Attributes:
        T_keyframe_scan: the pose.
        status: how it was found.
        reason: the numbers that decided.
        score: agreement with the local map.
        information: (6, 6) in the tangent of the scan.
        probability: P(correct) of the network's motion; None without one.
        compact: the encoded scan; None where it was not encoded.
        T_turn: predicted motion that the scan was deskewed by; None for none.
    """

    T_keyframe_scan: Pose
    status: ScanStatus
    reason: str
    score: float
    information: Float[np.ndarray, "6 6"]
    probability: float | None = None
    compact: CompactScan | None = None
    T_turn: Pose | None = None


class TimedScan(NamedTuple):
    """A raw scan with the time of each point, to be deskewed by the predicted motion.

    Attributes:
        points: (n, 3) metres, each in the frame of the lidar at its own moment.
        offsets: (n,) times since the scan's pose, as shares of the time between scans; see `scans.deskew`.
    """

    points: Float[AnyArray, "n 3"]
    offsets: Float[AnyArray, " n"]


AnyScan = Float[AnyArray, "_n 3"] | TimedScan


def place_scan(
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
    thinned = methods.geometry.thin(corrected_points(scan, T_turn))
    if thinned is None:
        return _pass_over(state, slam_map)
    if not state.is_begun:
        reason = "a new part of the map begins here" if len(slam_map) else "the map begins here"
        located = Located(np.eye(4), "first", reason, 1.0, diagonal_information(UNKNOWN_M, np.pi))
        return _make_keyframe(methods, state, slam_map, thinned, located._replace(T_turn=T_turn))
    local_map = state.local_map or local_map_of(slam_map, state.recent, methods.config.odometry)
    state = state._replace(local_map=local_map)
    located = _locate(methods, state, local_map, thinned)
    # The next prediction uses this pose three times, so a rounding error would triple from scan to scan.
    located = located._replace(T_keyframe_scan=orthonormal(located.T_keyframe_scan), T_turn=T_turn)
    if located.status == "restarted" or _is_keyframe(methods, located, thinned):
        return _make_keyframe(methods, state, slam_map, thinned, located)
    after = _advanced(methods, state, located)
    if located.status != "predicted":
        placed = placed_scan(thinned.measured.surface, located.T_keyframe_scan)
        # Around a lidar that stands still, people move: the map of before fits less and less.
        is_changed = bool(state.scores) and located.score < GOOD_SHARE * _usual_score(state)
        recent = with_scan(state.recent, placed, thinned.extent_m, methods.config.odometry, is_changed=is_changed)
        if recent is not state.recent:
            surface = joined_surface((*local_map.keyframes, *recent))
            after = after._replace(recent=recent, local_map=local_map._replace(surface=surface))
    return after, slam_map, _report(state, slam_map, located, is_keyframe=False)


def corrected_points(scan: AnyScan, T_turn: Pose | None) -> Float[np.ndarray, "n 3"]:
    """Returns the finite points of a scan, and undoes the motion of the lidar where the scan has times.

    Args:
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: motion from one scan to the next; None leaves the points unchanged.

    Returns:
        The points.
    """
    points = np.asarray(scan.points if isinstance(scan, TimedScan) else scan)
    is_finite = np.isfinite(points).all(axis=1)
    if not isinstance(scan, TimedScan) or T_turn is None:
        return points[is_finite]
    return deskew(points[is_finite], np.asarray(scan.offsets)[is_finite], T_turn)


def _pass_over(state: FrontEndState, slam_map: KeyframeMap) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    guess = diagonal_information(1.0, 1.0)
    located = Located(state.T_keyframe_last @ state.T_before_last, "empty", "too few points", 0.0, guess)
    after = state._replace(num_scans=state.num_scans + 1, T_keyframe_last=located.T_keyframe_scan)
    return after, slam_map, _report(state, slam_map, located, is_keyframe=False)


class _Attempt(NamedTuple):
    # The best pose from the prediction and other motions; the best pose from the decoder's motions, and these.
    tracked: Alignment | None
    matched: Alignment | None = None
    T_map_scan: Pose | None = None
    probability: float | None = None
    compact: CompactScan | None = None


def _locate(methods: SlamMethods, state: FrontEndState, local_map: LocalMap, scan: ThinnedScan) -> Located:
    config, predicted = methods.config.front_end, state.T_keyframe_last @ state.T_before_last
    usual = _usual_score(state)
    # Nothing is usual yet where a part of the map begins: sparse scans never score high.
    wanted = max(MIN_SCORE, MIN_SCORE_SHARE * usual if state.scores else 0.0)
    tried = _attempt(methods, state, local_map, scan, usual)
    # Nothing supports the prediction before any motion is known.
    best = _better(tried, MIN_MARGIN if state.scores else 0.0)
    is_matched = best is tried.matched
    numbers = f"score {best.score:.2f} of usually {usual:.2f}"
    if tried.probability is not None:
        numbers += f", P {tried.probability:.2f} by the network"
    network = tried.probability, tried.compact
    is_far = not are_near(predicted, best.T_map_scan, NEAR_M, np.inf)
    if is_far and state.scores and (tried.probability or 0.0) < config.min_probability:
        # A motion that neither the motion of before nor the decoder supports needs the usual score.
        wanted = GOOD_SHARE * usual
    if best.score >= wanted or _is_confirmed(methods, tried, best):
        status: ScanStatus = "network" if is_matched else "tracked"
        return Located(best.T_map_scan, status, numbers, best.score, best.information, *network)
    status = "restarted" if state.num_lost + 1 >= config.num_lost else "predicted"
    guess = diagonal_information(GUESS_M, GUESS_RAD)
    # The best alignment is the better guess, unless a robot hardly moves like that.
    is_likely = are_near(predicted, best.T_map_scan, 3 * GUESS_M, 3 * GUESS_RAD)
    return Located(best.T_map_scan if is_likely else predicted, status, numbers, best.score, guess, *network)


def _usual_score(state: FrontEndState) -> float:
    return float(np.median(state.scores)) if state.scores else 1.0


def _attempt(
    methods: SlamMethods, state: FrontEndState, local_map: LocalMap, scan: ThinnedScan, usual: float
) -> _Attempt:
    """Aligns from the prediction and from the decoder's motions, in the order that the configuration names."""
    geometry, config = methods.geometry, methods.config.odometry
    predicted = state.T_keyframe_last @ state.T_before_last
    # The second scan of a drive has no motion to go on with.
    has_motion = len(state.scores) > 0
    tracked = None
    if config.proposer == "prediction" and has_motion:
        tracked = geometry.align(local_map, scan, predicted)
        if tracked.score >= GOOD_SHARE * usual:
            return _Attempt(tracked)
    compact = methods.matcher.encode(scan)
    row = nearest_keyframe(local_map, predicted[:3, 3])
    proposal = methods.matcher.propose(compact, local_map.compact[row], NUM_HYPOTHESES)
    starts = orthonormal(local_map.keyframes[row].T_map_scan @ proposal.T_target_source)
    matched = geometry.search(local_map, scan, starts)
    if tracked is None and (config.proposer == "prediction" or matched.score < GOOD_SHARE * usual):
        tracked = geometry.align(local_map, scan, predicted)
    if tracked is not None and matched.score < GOOD_SHARE * usual:
        others = state.T_keyframe_last @ geometry.other_motions(state.T_before_last, scan.extent_m)
        tracked = best_of([tracked, geometry.search(local_map, scan, orthonormal(others))])
    return _Attempt(tracked, matched, starts[0], proposal.probability, compact)


def _better(tried: _Attempt, min_margin: float) -> Alignment:
    """Returns the better pose; another place must fit better by a margin than the one that the prediction supports."""
    tracked, matched = tried.tracked, tried.matched
    if tracked is None or matched is None:
        return best_of([found for found in (tracked, matched) if found is not None])
    is_same = are_near(tracked.T_map_scan, matched.T_map_scan, NEAR_M, np.inf)
    return matched if matched.score > tracked.score + (0.0 if is_same else min_margin) else tracked


def _is_confirmed(methods: SlamMethods, tried: _Attempt, best: Alignment) -> bool:
    """Returns True where the decoder alone and the alignment from other starts end at the same pose."""
    config = methods.config.front_end
    if tried.tracked is None or tried.T_map_scan is None or (tried.probability or 0.0) < config.min_probability:
        return False
    ends = (tried.tracked.T_map_scan, tried.T_map_scan)
    are_equal = all(are_near(T, best.T_map_scan, NEAR_M, NEAR_RAD) for T in ends)
    return are_equal and best.score >= MIN_SCORE


def _is_keyframe(methods: SlamMethods, located: Located, scan: ThinnedScan) -> bool:
    if located.status == "predicted":
        return False
    config, T = methods.config.front_end, located.T_keyframe_scan
    spacing_m = config.keyframe_share * scan.extent_m
    spacing_m = float(np.clip(spacing_m, config.min_keyframe_m, config.max_keyframe_m))
    return bool(np.linalg.norm(T[:3, 3]) > spacing_m) or turn_rad(T) > KEYFRAME_RAD


def _make_keyframe(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: ThinnedScan, located: Located
) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    T, row = located.T_keyframe_scan, len(slam_map)
    is_guess = row > 0 and located.status in ("first", "restarted")
    compact = methods.matcher.encode(scan) if located.compact is None else located.compact
    T_odometry, T_world, path_m, segment, edge = T, T, 0.0, 0, None
    if row:
        last = slam_map.keyframes[-1]
        T_odometry, T_world = last.T_odometry_keyframe @ T, slam_map.T_world_keyframe[-1] @ T
        path_m, segment = last.path_m + float(np.linalg.norm(T[:3, 3])), last.segment + is_guess
        kind: EdgeKind = "guess" if is_guess else "odometry"
        edge = MapEdge(row, row - 1, T, located.information, kind)
    keyframe = Keyframe(state.num_scans, T_odometry, path_m, segment, scan.extent_m, compact)
    slam_map = with_origin(slam_map, methods.origin)
    slam_map = add_keyframe(slam_map, keyframe, T_world, methods.matcher.vector(compact), edge)
    # In the frame of the new keyframe; the scans of another segment have no place in it.
    moved = (
        [] if is_guess else [entry._replace(T_map_scan=rigid.inverse(T) @ entry.T_map_scan) for entry in state.recent]
    )
    placed = placed_scan(scan.measured.surface, np.eye(4))
    after = _advanced(methods, state, located)._replace(
        is_begun=True,
        recent=with_scan(tuple(moved), placed, scan.extent_m, methods.config.odometry),
        local_map=None,
        T_keyframe_last=np.eye(4),
    )
    return after, slam_map, _report(state, slam_map, located._replace(T_keyframe_scan=np.eye(4)), is_keyframe=True)


def _advanced(methods: SlamMethods, state: FrontEndState, located: Located) -> FrontEndState:
    """Returns the state after a scan: only an accepted one changes the predicted motion."""
    T = located.T_keyframe_scan
    after = state._replace(num_scans=state.num_scans + 1, T_keyframe_last=T)
    if located.status == "predicted":
        return after._replace(num_lost=state.num_lost + 1)
    if located.status in ("first", "restarted"):
        return after._replace(num_lost=0, scores=())
    return after._replace(
        T_before_last=rigid.inverse(state.T_keyframe_last) @ T,
        scores=(*state.scores, located.score)[-USUAL_WINDOW:],
        num_lost=0,
    )


def _report(state: FrontEndState, slam_map: KeyframeMap, located: Located, *, is_keyframe: bool) -> ScanReport:
    keyframe, T = max(len(slam_map) - 1, 0), located.T_keyframe_scan
    return ScanReport(
        state.num_scans,
        located.status,
        located.reason,
        keyframe,
        T,
        is_keyframe,
        score=located.score,
        probability=located.probability,
        T_turn=located.T_turn,
    )
