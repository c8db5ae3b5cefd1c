"""The front end: each scan in turn gets a pose, and some become keyframes (DeepPointMap section 4).

The last motion or the decoder gives a first guess. The alignment with the local map makes it exact. The pose is
accepted if a large share of the elements meet planes.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import are_near, orthonormal, turn_rad
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.slide import diagonal_information, sigma_along
from dpmjax.slam.interfaces import Alignment, Match, PreparedInput, Proposal, SlamMethods
from dpmjax.slam.keyframe_map import EdgeKind, Keyframe, KeyframeMap, MapEdge, add_keyframe, with_origin
from dpmjax.slam.local_map import LocalMap, PlacedElements, joined_surface, local_map_of, placed_scan, with_scan
from dpmjax.slam.surface_geometry import SAME_M, SAME_RAD
from dpmjax.types import Information, Pose

# Smallest accepted score.
MIN_SCORE = 0.2

# Smallest accepted share of the usual score.
MIN_SCORE_SHARE = 0.4

# Share of the usual score above which no other start is tried.
GOOD_SHARE = 0.85

# Largest distance and turn between two poses of one place.
PLACE_M, PLACE_RAD = 2.0, 0.8

# Largest turn between the decoder's motion and the pose that it confirms.
CONFIRMED_RAD = 0.087

# Smallest P(correct) of a decoder's motion that is accepted at any score: few elements of sparse scans meet planes.
SURE_PROBABILITY = 0.9

# Least lead in score with which a pose replaces the tracked one of another place; for a pose far off by an unsure
# decoder it is this share of the usual score.
MIN_LEAD, UNSURE_LEAD_SHARE = 0.1, 0.5

# Number of scans whose median is the usual score, and of the first scans whose poses the decoder proposes: a wrong pose
# among them makes low scores usual. Fewer, until the decoder has agreed four times, made two short drives 12 % worse.
USUAL_WINDOW, NUM_USUAL = 20, 10

# Standard deviation of a predicted translation.
GUESS_M = 1.0

# Standard deviation of a predicted rotation.
GUESS_RAD = 0.2

# Standard deviation of the relative pose of two parts without a measurement between them.
UNKNOWN_M = 1000.0


# Source of a pose. "first": first scan of the map, or of a new part of a loaded one. "tracked": aligned from the
# predicted pose, or registered by the decoder where the method is "descriptors". "network": aligned from the decoder's
# pose, or confirmed by it at a low score. "coasting": aligned in a corridor whose walls leave the way along it open;
# along it, the last motion goes on. "predicted": no alignment was accepted; the pose is a guess. "empty": too few
# points. "restarted": first scan of a new part at a guessed pose, after several rejected scans; loops may join it.
ScanStatus = Literal["first", "tracked", "network", "coasting", "predicted", "empty", "restarted"]


class ScanReport(NamedTuple):
    """The pose of a scan and how it was found.

    Attributes:
        scan: its number.
        status: how the pose was found.
        reason: the numbers that decided.
        keyframe: row of the keyframe that the pose is relative to; its own row if it is one.
        T_keyframe_scan: relative pose. Loops do not change it, because they move keyframes only.
        is_keyframe: True if it became a keyframe.
        score: agreement of the scan with the local map; with the method "descriptors", confidence of the decoder.
        probability: P(correct) of the network; None if it did not run.
        num_accepted: number of loops that were accepted at this scan.
        num_points: number of points of the scan.
        T_turn: predicted motion that a scan with times was deskewed by; None for a scan without times.
        weak_sigma_m: standard deviation of the position along a corridor, metres; None elsewhere, and for a guess.
    """

    scan: int
    status: ScanStatus
    reason: str
    keyframe: int
    T_keyframe_scan: Pose
    is_keyframe: bool = False
    score: float = 0.0
    probability: float | None = None
    num_accepted: int = 0
    num_points: int = 0
    T_turn: Pose | None = None
    weak_sigma_m: float | None = None


class RegisteredScan(NamedTuple):
    """A scan that the decoder has registered with a keyframe.

    Attributes:
        scan: its number.
        extent_m: median range of its points.
        compact: the encoded scan.
        target: row of the keyframe.
        match: the registration.
    """

    scan: int
    extent_m: float
    compact: CompactScan
    target: int
    match: Match


class FrontEndState(NamedTuple):
    """State of odometry after a scan. The frame is that of the last keyframe.

    Attributes:
        num_scans: number of scans so far, those of a loaded map among them.
        recent: the last accepted scans that lie apart, oldest first; none before the first keyframe.
        local_map: nearest keyframes and recent scans; None if it must be built from the map.
        T_keyframe_last: pose of the last scan.
        T_before_last: motion of the last scan since the scan before.
        scores: scores of recent accepted scans.
        lost: scans since the last accepted one, at their predicted poses.
        dropped: the same for the method "descriptors", with their registrations; None for an empty scan.
        keyframe_ratio: factor of the distance of keyframes for the method "descriptors"; None before the first.
        num_coasting: number of scans since the position along a corridor was last measured.
    """

    num_scans: int = 0
    recent: tuple[PlacedElements, ...] = ()
    local_map: LocalMap | None = None
    T_keyframe_last: Pose = np.eye(4)
    T_before_last: Pose = np.eye(4)
    scores: tuple[float, ...] = ()
    lost: tuple[PlacedElements, ...] = ()
    dropped: tuple[RegisteredScan | None, ...] = ()
    keyframe_ratio: float | None = None
    num_coasting: int = 0

    @property
    def predicted(self) -> Pose:
        """The pose of the next scan if the last motion goes on."""
        return self.T_keyframe_last @ self.T_before_last

    @property
    def usual_score(self) -> float:
        """Median score of recent scans; 1 without any."""
        return float(np.median(self.scores)) if self.scores else 1.0


def place_scan(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: PreparedInput
) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    """Estimates the pose of a scan, and makes it a keyframe if it is far enough from the last one.

    Args:
        methods: matcher, geometry, settings.
        state: after the scan before.
        slam_map: the map so far.
        scan: the scan.

    Returns:
        The state and the map after the scan, and its report.
    """
    thinned, row = scan.thinned, max(len(slam_map) - 1, 0)
    report = ScanReport(state.num_scans, "empty", empty_reason(scan), row, state.predicted, num_points=scan.num_points)
    if thinned is None:
        return state._replace(num_scans=state.num_scans + 1, T_keyframe_last=state.predicted), slam_map, report
    report = report._replace(T_turn=scan.T_turn)
    if not state.recent:
        reason = "a new part of the map begins here" if len(slam_map) else "the map begins here"
        report = report._replace(status="first", reason=reason, T_keyframe_scan=np.eye(4), score=1.0)
        located = _Located(report, diagonal_information(UNKNOWN_M, np.pi), scan.compact)
        return _make_keyframe(methods, state, slam_map, thinned, located)
    local_map = state.local_map or local_map_of(slam_map, state.recent, methods.config.odometry)
    state = state._replace(local_map=local_map)
    located = _Search(methods, state, local_map, thinned, scan.compact).located(report)
    report = located.report
    if report.status == "restarted" or _is_keyframe(methods, report, thinned):
        return _make_keyframe(methods, state, slam_map, thinned, located)
    after = _advanced(state, report)
    placed = placed_scan(thinned.surface, report.T_keyframe_scan)
    if report.status == "predicted":
        after = after._replace(lost=(*state.lost, placed))
    else:
        # People move around a lidar that stands still, so the local map is renewed where it fits less.
        is_changed = bool(state.scores) and report.score < GOOD_SHARE * state.usual_score
        recent = with_scan(state.recent, placed, 0.0 if is_changed else thinned.extent_m)
        if recent is not state.recent:
            surface = joined_surface((*local_map.keyframes, *recent))
            after = after._replace(recent=recent, local_map=local_map._replace(surface=surface))
    return after, slam_map, report


def empty_reason(scan: PreparedInput) -> str:
    """Returns the reason why a scan has no surface.

    Args:
        scan: the scan.

    Returns:
        One text.
    """
    return f"too few of its {scan.num_points} points lie on surfaces 1 to 60 m from the lidar"


class _Located(NamedTuple):
    # The pose and why it was accepted; its information in the tangent of the scan; the scan, if it was encoded.
    report: ScanReport
    information: Information
    compact: CompactScan | None = None


class _Attempt(NamedTuple):
    # The best pose; that from the prediction and other motions; the poses that the decoder proposes; the encoded scan.
    best: Alignment
    tracked: Alignment | None
    proposal: Proposal | None = None
    compact: CompactScan | None = None


class _Search(NamedTuple):
    # The search of the pose of a scan, which may be encoded already.
    methods: SlamMethods
    state: FrontEndState
    local_map: LocalMap
    scan: Scan
    compact: CompactScan | None

    def located(self, report: ScanReport) -> _Located:
        """Estimates the pose, and accepts it or guesses another one."""
        state, config, usual = self.state, self.methods.config.front_end, self.state.usual_score
        tried = self._attempt()
        best, probability = tried.best, None if tried.proposal is None else tried.proposal.probability
        # A new part has no usual score yet, and sparse scans never score high.
        wanted = max(MIN_SCORE, MIN_SCORE_SHARE * usual if state.scores else 0.0)
        is_far = not are_near(state.predicted, best.T_map_scan, PLACE_M, PLACE_RAD)
        if is_far and state.scores and (probability or 0.0) < config.min_probability:
            # A motion that neither the last motion nor the decoder supports needs the usual score.
            wanted = GOOD_SHARE * usual
        T, information = best.T_map_scan, best.information
        status: ScanStatus = "tracked" if best is tried.tracked else "network"
        if best.score < wanted and not _is_confirmed(tried, config.min_probability):
            T = self._guess(tried)
            # After six scans without an accepted pose, a new segment begins. Loops may join it later.
            status = "restarted" if len(state.lost) + 1 >= 6 else "predicted"
            information = diagonal_information(GUESS_M, GUESS_RAD)
        elif self.scan.weak_axis is not None:
            sigma_m = sigma_along(information, self.scan.weak_axis)
            report = report._replace(weak_sigma_m=sigma_m)
            if sigma_m > GUESS_M:
                # An alignment there is noise, which would change the speed.
                status, T = "coasting", _with_guess_along(T, state.predicted, self.scan.weak_axis)
        reason = f"score {best.score:.2f} of usually {usual:.2f}"
        if probability is not None:
            reason += f", P {probability:.2f} by the network"
        if status == "coasting":
            reason += ", nothing faces the axis of the corridor"
        # The next prediction uses this pose three times, so a rounding error would triple from scan to scan.
        report = report._replace(status=status, reason=reason, T_keyframe_scan=orthonormal(T))
        report = report._replace(score=best.score, probability=probability)
        return _Located(report, information, tried.compact)

    def _guess(self, tried: _Attempt) -> Pose:
        """Returns the guessed pose of a rejected scan, aligned with the lost scans, too: behind a door the map ends."""
        if self.state.lost:
            surface = joined_surface((*self.local_map.keyframes, *self.state.recent, *self.state.lost))
            wider = self._replace(local_map=self.local_map._replace(surface=surface), compact=tried.compact)
            tried = wider._attempt()
        T, predicted = tried.best.T_map_scan, self.state.predicted
        # An alignment is the better guess, unless it is too far from the last motion.
        return T if are_near(predicted, T, 3 * GUESS_M, 3 * GUESS_RAD) else predicted

    def _attempt(self) -> _Attempt:
        """Aligns from the prediction and from the decoder's motions, in the order that the configuration names."""
        (matcher, geometry, config, _), state, local_map, scan, compact = self
        predicted, is_predicted = state.predicted, config.odometry.proposer == "prediction"
        good_score = max(MIN_SCORE, GOOD_SHARE * state.usual_score)
        tracked, min_probability = None, config.front_end.min_probability
        # The second scan of a drive has no last motion.
        if is_predicted and state.scores:
            tracked = geometry.align(local_map, scan, predicted)
            if tracked.score >= good_score and len(state.scores) >= NUM_USUAL:
                return _Attempt(tracked, tracked)
        compact = matcher.encode(scan) if compact is None else compact
        row = local_map.nearest(predicted[:3, 3])
        # Number of motions that the decoder proposes.
        proposal = matcher.propose(compact, local_map.compact[row], 3)
        starts = orthonormal(local_map.keyframes[row].T_map_scan @ proposal.T_target_source)
        best = matched = geometry.search(local_map, scan, starts)
        if tracked is None and (is_predicted or matched.score < good_score):
            tracked = geometry.align(local_map, scan, predicted)
        if tracked is not None:
            is_agreed = are_near(tracked.T_map_scan, matched.T_map_scan, SAME_M, SAME_RAD)
            is_agreed &= proposal.probability >= min_probability
            is_near = are_near(tracked.T_map_scan, matched.T_map_scan, PLACE_M, PLACE_RAD)
            # At a low score, too, no further starts are needed where a sure decoder leads to the same pose.
            if not is_agreed and (matched.score < good_score or not is_near):
                others = state.T_keyframe_last @ geometry.other_motions(state.T_before_last, scan.extent_m)
                tracked = self._better_of(tracked, geometry.search(local_map, scan, orthonormal(others)), MIN_LEAD)
            # Symmetric places fit at other poses, too. Before any motion is known, nothing supports the prediction.
            is_near = are_near(tracked.T_map_scan, matched.T_map_scan, PLACE_M, np.inf)
            is_sure = is_near or proposal.probability >= min_probability
            lead = MIN_LEAD if is_sure else max(MIN_LEAD, UNSURE_LEAD_SHARE * state.usual_score)
            best = self._better_of(tracked, matched, lead if state.scores else 0.0)
        return _Attempt(best, tracked, proposal._replace(T_target_source=starts), compact)

    def _better_of(self, tracked: Alignment, other: Alignment, lead: float) -> Alignment:
        """Returns `other` if its score beats that of `tracked`; at another place it must beat it by the lead."""
        # A scan of a corridor fits almost as well after any shift along it.
        place_m = PLACE_M if self.scan.weak_axis is None else SAME_M
        is_same = are_near(tracked.T_map_scan, other.T_map_scan, place_m, PLACE_RAD)
        return other if other.score > tracked.score + (0.0 if is_same else lead) else tracked


def _with_guess_along(T_map_scan: Pose, guess: Pose, axis: Float[np.ndarray, "3"]) -> Pose:
    """Returns the pose, moved along an axis of the scan to the position of the guess."""
    held, along = T_map_scan.copy(), T_map_scan[:3, :3] @ axis
    held[:3, 3] += along @ (guess - T_map_scan)[:3, 3] * along
    return held


def _is_confirmed(tried: _Attempt, min_probability: float) -> bool:
    """Returns True where the decoder is sure of the pose, or where it and the alignment from other starts end there."""
    best, proposal = tried.best, tried.proposal
    if proposal is None or not are_near(proposal.T_target_source[0], best.T_map_scan, PLACE_M, CONFIRMED_RAD):
        return False
    if proposal.is_calibrated and proposal.probability >= SURE_PROBABILITY:
        return True
    if tried.tracked is None or proposal.probability < min_probability or best.score < MIN_SCORE:
        return False
    return are_near(tried.tracked.T_map_scan, best.T_map_scan, PLACE_M, CONFIRMED_RAD)


def _is_keyframe(methods: SlamMethods, report: ScanReport, scan: Scan) -> bool:
    config, T = methods.config.front_end, report.T_keyframe_scan
    spacing_m = np.clip(config.keyframe_share * scan.extent_m, config.min_keyframe_m, config.max_keyframe_m)
    # Turn between keyframes at a smaller distance.
    is_away = bool(np.linalg.norm(T[:3, 3]) > spacing_m) or turn_rad(T) > 0.6
    return is_away and report.status != "predicted"


def _make_keyframe(
    methods: SlamMethods, state: FrontEndState, slam_map: KeyframeMap, scan: Scan, located: _Located
) -> tuple[FrontEndState, KeyframeMap, ScanReport]:
    report, row = located.report, len(slam_map)
    T, is_guess = report.T_keyframe_scan, row > 0 and report.status in ("first", "restarted")
    compact = methods.matcher.encode(scan) if located.compact is None else located.compact
    kind: EdgeKind = "guess" if is_guess else "odometry"
    edge = MapEdge(row, row - 1, T, located.information, kind) if row else None
    slam_map = with_keyframe(methods, slam_map, Keyframe(state.num_scans, T, 0.0, 0, scan.extent_m, compact), edge)
    # In the frame of the new keyframe; the scans of another segment have no place in it, but the lost ones begin it.
    T_new_old, before = rigid.inverse(T), state.lost if is_guess else state.recent
    moved = tuple(one._replace(T_map_scan=T_new_old @ one.T_map_scan) for one in before)
    placed = placed_scan(scan.surface, np.eye(4))
    recent = with_scan(moved, placed, scan.extent_m)
    after = _advanced(state, report)._replace(recent=recent, local_map=None, T_keyframe_last=np.eye(4))
    return after, slam_map, report._replace(keyframe=row, T_keyframe_scan=np.eye(4), is_keyframe=True)


def with_keyframe(methods: SlamMethods, slam_map: KeyframeMap, keyframe: Keyframe, edge: MapEdge | None) -> KeyframeMap:
    """Adds a keyframe at the pose that its edge gives.

    Args:
        methods: matcher and settings.
        slam_map: the map before.
        keyframe: the new keyframe. If there is an edge, its pose, path and segment are replaced by those of the edge.
        edge: edge from the keyframe to an earlier one; a "guess" begins a segment. None for the first of a map.

    Returns:
        The map after.
    """
    T_world_keyframe = keyframe.T_odometry_keyframe
    if edge is not None:
        last, T = slam_map.keyframes[-1], edge.T_target_source
        T_world_keyframe = slam_map.T_world_keyframe[edge.target] @ T
        T_odometry_keyframe = slam_map.keyframes[edge.target].T_odometry_keyframe @ T
        step_m = float(np.linalg.norm(T_odometry_keyframe[:3, 3] - last.T_odometry_keyframe[:3, 3]))
        keyframe = keyframe._replace(
            T_odometry_keyframe=T_odometry_keyframe,
            path_m=last.path_m + step_m,
            segment=last.segment + (edge.kind == "guess"),
        )
    vector = methods.matcher.vector(keyframe.compact)
    return add_keyframe(with_origin(slam_map, methods.origin), keyframe, T_world_keyframe, vector, edge)


def _advanced(state: FrontEndState, report: ScanReport) -> FrontEndState:
    """Returns the state after a scan: only an accepted one changes the predicted motion."""
    T, num_coasting = report.T_keyframe_scan, state.num_coasting
    after = state._replace(num_scans=state.num_scans + 1, T_keyframe_last=T)
    if report.status == "predicted":
        return after
    after = after._replace(lost=(), num_coasting=num_coasting + 1 if report.status == "coasting" else 0)
    if report.status in ("first", "restarted"):
        return after._replace(scores=())
    T_before_last = rigid.inverse(state.T_keyframe_last) @ T
    # The error along a corridor is that of all scans since it was known, and not of the last step.
    before_m = state.T_before_last[:3, 3]
    T_before_last[:3, 3] = before_m + (T_before_last[:3, 3] - before_m) / (num_coasting + 1)
    return after._replace(T_before_last=T_before_last, scores=(*state.scores, report.score)[-USUAL_WINDOW:])
