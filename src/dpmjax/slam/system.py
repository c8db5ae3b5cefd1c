"""The whole system: scan by scan, front end, loop closure and optimisation make one map.

A thread prepares scans one scan ahead, because this needs no map; scans with times wait for the motion before them.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from dpmjax.checks import as_host_points, require_shape, require_type, runs_on_host
from dpmjax.deeppointmap.model import Model
from dpmjax.geometry import rigid
from dpmjax.pose_graph.free_nodes import pose_covariances
from dpmjax.pose_graph.graph import PoseGraph
from dpmjax.progress import progress_bar
from dpmjax.reading import read_path
from dpmjax.scan.lidar.corrections import deskew
from dpmjax.slam import descriptors, loop_closure, track
from dpmjax.slam.assess import MapAssessment, assess_map
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.interfaces import AnyScan, PreparedInput, SlamMethods, TimedScan
from dpmjax.slam.keyframe_map import KeyframeMap, as_pose_graph, measured_parts
from dpmjax.slam.loops import Loop, LoopState, has_new_loops, loops_of_map, num_accepted, optimize_map
from dpmjax.slam.model_methods import as_methods
from dpmjax.slam.track import FrontEndState, ScanReport
from dpmjax.types import Pose, Poses, with_short_repr

Item = TypeVar("Item")
Result = TypeVar("Result")


class SlamProcedure(NamedTuple):
    """The steps of a method of SLAM.

    Attributes:
        place_scan: estimates the pose of a scan, and makes some scans keyframes.
        close_loops: looks for loops of the newest keyframe of a drive.
        join_keyframe: looks for loops of a keyframe to allowed keyframes of other maps in the same record.
    """

    place_scan: Callable[..., tuple[FrontEndState, KeyframeMap, ScanReport]]
    close_loops: Callable[[SlamMethods, KeyframeMap, LoopState], tuple[KeyframeMap, LoopState]]
    join_keyframe: Callable[..., tuple[KeyframeMap, tuple[Loop, ...]]]


def procedure_of(config: SlamConfig) -> SlamProcedure:
    """Returns the steps of the configured method; no other function chooses between the methods."""
    if config.method == "descriptors":
        return SlamProcedure(descriptors.place_scan, descriptors.close_loops, descriptors.join_keyframe)
    return SlamProcedure(track.place_scan, loop_closure.close_loops, loop_closure.join_keyframe)


@with_short_repr
class SlamState(NamedTuple):
    """State of SLAM between two scans.

    Attributes:
        front_end: state of odometry, with the local map.
        slam_map: keyframes and edges.
        loops: candidates of loops.
        begun: the first scan and the state before it. It waits here if it has times, until the second scan gives its
            motion. None otherwise.
    """

    front_end: FrontEndState
    slam_map: KeyframeMap
    loops: LoopState
    begun: tuple[SlamState, TimedScan] | None = None


class SlamResult(NamedTuple):
    """Result of `run_slam`.

    Attributes:
        T_world_scan: (n, 4, 4) float64 poses of all scans. The world is the frame of the first scan, or of the map
            that was extended.
        keyframes: (k,) numbers of the scans that are keyframes.
        loops: every candidate and its outcome; rows are those of `keyframes`.
        graph: poses of the keyframes and the kept edges, with numbers of scans as ids; None without any keyframe.
        reports: report of each scan.
        state: state after the last scan, from which `step_slam` continues.
        T_odometry_scan: (n, 4, 4) poses of all scans by odometry alone, without any loop.
    """

    T_world_scan: Poses
    keyframes: np.ndarray
    loops: tuple[Loop, ...]
    graph: PoseGraph | None
    reports: tuple[ScanReport, ...]
    state: SlamState
    T_odometry_scan: Poses

    def __repr__(self) -> str:
        accepted = sum(loop.status == "accepted" for loop in self.loops)
        return f"SlamResult({len(self.reports)} scans, {len(self.keyframes)} keyframes, {accepted} loops)"

    @property
    def covariances(self) -> Float[np.ndarray, "k 6 6"]:
        """Covariances of the poses of the keyframes (`pose_graph.pose_covariances`), computed at each access."""
        return np.zeros((0, 6, 6)) if self.graph is None else pose_covariances(self.graph)

    @property
    def map(self) -> KeyframeMap:
        """The map: keyframes, poses and edges."""
        return self.state.slam_map

    @property
    def assessment(self) -> MapAssessment:
        """Whether the map can be trusted, and its uncertain scans."""
        num_parts = len(set(measured_parts(self.map).tolist()))
        return assess_map([report.status for report in self.reports], num_parts)


def init_slam(slam_map: KeyframeMap | None = None) -> SlamState:
    """Begins an empty map, or a new part of an earlier one.

    The numbers of scans continue those of the map. The pose of the new part in the map is unknown until a loop
    joins it.

    Args:
        slam_map: map from `load_map` or of an earlier run; None for an empty one.

    Returns:
        The state before the first scan.

    Raises:
        ValueError: if it is no map.
    """
    slam_map = KeyframeMap() if slam_map is None else slam_map
    require_type("slam_map", slam_map, KeyframeMap, "load_map")
    if len(slam_map) == 0:
        return SlamState(FrontEndState(), KeyframeMap(), LoopState())
    return SlamState(FrontEndState(num_scans=slam_map.keyframes[-1].scan + 1), slam_map, loops_of_map(slam_map))


def step_slam(methods: SlamMethods, state: SlamState, scan: AnyScan | PreparedInput) -> tuple[SlamState, ScanReport]:
    """Estimates the pose of a scan, and searches loops of a new keyframe.

    Args:
        methods: methods from `make_methods`.
        state: state after the scan before.
        scan: (n, 3) points in metres, in the frame of the lidar, or a `TimedScan`, which is deskewed by the predicted
            motion. Points that are not finite are dropped. Or the output of `prepare_ahead` for them.

    Returns:
        The state after the scan, and its report.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    if isinstance(scan, PreparedInput):
        return _step(methods, state, scan)
    if not isinstance(scan, TimedScan):
        return _step(methods, state, prepare_input(methods, scan))
    after, report = _step(methods, state, prepare_input(methods, scan, state.front_end.T_before_last))
    if report.status == "first":
        return after._replace(begun=(state, scan)), report
    if state.begun is None or report.status not in ("tracked", "network"):
        return after, report
    # The first two scans are deskewed by the motion between them, and placed again.
    before, first = state.begun
    # Number of times that the first two scans are deskewed: the motion between them changes little after the first.
    for _ in range(2):
        T_turn = after.front_end.T_before_last
        after, _ = _step(methods, before, prepare_input(methods, first, T_turn))
        after = after._replace(front_end=after.front_end._replace(T_before_last=T_turn))
        after, report = _step(methods, after, prepare_input(methods, scan, T_turn))
    return after, report


def _step(methods: SlamMethods, state: SlamState, scan: PreparedInput) -> tuple[SlamState, ScanReport]:
    """Places a prepared scan and searches loops of a new keyframe."""
    procedure, loops = procedure_of(methods.config), state.loops
    front, slam_map, report = procedure.place_scan(methods, state.front_end, state.slam_map, scan)
    if report.is_keyframe:
        slam_map, loops = procedure.close_loops(methods, slam_map, loops)
    num_new = num_accepted(loops.loops) - num_accepted(state.loops.loops)
    return SlamState(front, slam_map, loops), report._replace(num_accepted=num_new)


def finish_slam(state: SlamState, reports: Iterable[ScanReport], config: SlamConfig) -> SlamResult:
    """Optimises a last time and puts every scan into the world.

    Args:
        state: state after the last scan.
        reports: reports of all scans.
        config: settings.

    Returns:
        Trajectory, keyframes, loops and graph.
    """
    reports, slam_map, loops = tuple(reports), state.slam_map, state.loops
    if has_new_loops(slam_map, loops.loops):
        slam_map, loops = optimize_map(slam_map, loops)
    return SlamResult(
        T_world_scan=place_scans(slam_map.T_world_keyframe, reports),
        keyframes=slam_map.column("scan").astype(np.int64),
        loops=loops.loops,
        graph=as_pose_graph(slam_map) if len(slam_map) else None,
        reports=reports,
        state=state._replace(slam_map=slam_map, loops=loops),
        T_odometry_scan=place_scans(slam_map.column("T_odometry_keyframe").reshape(-1, 4, 4), reports),
    )


def place_scans(T_world_keyframe: Poses, reports: Sequence[ScanReport]) -> Poses:
    """Computes the world pose of each scan from the pose of its keyframe.

    Args:
        T_world_keyframe: poses of the keyframes; none if all scans were empty.
        reports: reports of all scans.

    Returns:
        Poses of the scans; the world is the frame of the first one, or of the map that was extended.
    """
    if not len(T_world_keyframe) or not reports:
        return np.tile(np.eye(4), (len(reports), 1, 1))
    T_keyframe_scan = np.array([report.T_keyframe_scan for report in reports])
    T_world_scan = T_world_keyframe[[report.keyframe for report in reports]] @ T_keyframe_scan
    return rigid.inverse(T_world_scan[0]) @ T_world_scan if reports[0].scan == 0 else T_world_scan


@runs_on_host("call encode_pyramid, correlate and icp there")
def run_slam(
    model: Model | SlamMethods,
    scans: Iterable[AnyScan] | str | Path,
    config: SlamConfig | None = None,
    *,
    slam_map: KeyframeMap | str | Path | None = None,
    odometry: Poses | None = None,
    progress: bool = True,
) -> SlamResult:
    """Makes one map of a drive by odometry, loop closure and optimisation of the pose graph (DeepPointMap section 4).

    Every scan gets a pose, also an empty one. `reports` has how each pose was found, and flags uncertain ones.

    Args:
        model: a trained model; or methods of your own.
        scans: points in metres, each in the frame of the lidar, in the order of time; any iterable of arrays or
            files, or the folder or bag of a drive (`io.open_lidar_sequence`). `TimedScan`s are deskewed.
        config: settings; None takes the defaults. Methods of your own carry theirs.
        slam_map: map from `load_map`, or its file, to be extended; None begins an empty one.
        odometry: (n, 4, 4) poses of the lidar at each scan by wheels or an IMU, in any world; NaN for missing poses.
            They give the first guess of each motion, in place of the previous motion.
        progress: False shows no bar.

    Returns:
        `T_world_scan` of every scan, keyframes, loops, graph, map and reports.

    Raises:
        ValueError: if a scan is not (n, 3), if an argument is of another type, if methods come with a configuration, or
            if the map was made with other weights.
    """
    methods, reports = as_methods(model, config), list[ScanReport]()
    state = init_slam(read_path(slam_map, "saved_maps.load_map"))
    drive: Iterable[AnyScan] = read_path(scans, "io.open_lidar_sequence")
    total = len(drive) if isinstance(drive, Sized) else None
    prepared = in_advance(partial(prepare_ahead, methods), drive)
    with progress_bar("SLAM", prepared, total=total, unit="scans", is_shown=progress) as bar:
        for scan in bar:
            guessed = with_guess(state.front_end, odometry, len(reports))
            state, report = step_slam(methods, state._replace(front_end=guessed), scan)
            reports.append(report)
    return finish_slam(state, reports, methods.config)


def with_guess(state: FrontEndState, odometry: Poses | None, index: int) -> FrontEndState:
    """Replaces the predicted motion to a scan by the motion of odometry, if there is one.

    Args:
        state: state of the front end before the scan.
        odometry: (n, 4, 4) poses of the lidar, NaN where there is none; None for no odometry.
        index: row of the scan.

    Returns:
        The state.
    """
    if odometry is None or not 0 < index < len(odometry):
        return state
    T_last_scan: Pose = rigid.inverse(odometry[index - 1]) @ odometry[index]
    if not np.isfinite(T_last_scan).all():
        return state
    return state._replace(T_before_last=T_last_scan)


def prepare_input(methods: SlamMethods, scan: AnyScan, T_turn: Pose | None = None) -> PreparedInput:
    """Prepares a scan without the map: thins it, and encodes it if every scan is encoded.

    Args:
        methods: matcher, geometry, settings.
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: predicted motion, by which a scan with times is deskewed; None for a scan without times.

    Returns:
        The prepared scan.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    scan = scan if isinstance(scan, TimedScan) else as_host_points("scan", scan)
    thinned, compact = methods.geometry.thin(corrected_points(scan, T_turn)), None
    if thinned is not None and methods.config.encodes_each_scan:
        compact = methods.matcher.encode(thinned)
    return PreparedInput(len(scan.points if isinstance(scan, TimedScan) else scan), thinned, T_turn, compact)


def corrected_points(scan: AnyScan, T_turn: Pose | None) -> Float[np.ndarray, "n 3"]:
    """Returns the finite points of a scan; the motion of the lidar is undone if the scan has times.

    Args:
        scan: points in metres, in the frame of the lidar, perhaps with times.
        T_turn: motion from one scan to the next; None leaves the points unchanged.

    Returns:
        The points.

    Raises:
        ValueError: if the shape is not (n, 3), or if there are not n times.
    """
    points = as_host_points("scan", scan.points if isinstance(scan, TimedScan) else scan)
    is_finite = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2])
    if not isinstance(scan, TimedScan) or T_turn is None:
        return points if is_finite.all() else points[is_finite]
    offsets = np.asarray(scan.offsets)
    require_shape("scan.offsets", offsets, points.shape[:1])
    return deskew(points[is_finite], offsets[is_finite], T_turn)


def prepare_ahead(methods: SlamMethods, scan: AnyScan) -> PreparedInput | TimedScan:
    """Prepares a scan before the earlier scans have poses, for instance in another thread.

    Args:
        methods: methods from `make_methods`.
        scan: see `step_slam`.

    Returns:
        The input of `step_slam`. A scan with times is unchanged, because the previous motion is not known yet.

    Raises:
        ValueError: if the shape is not (n, 3).
    """
    return scan if isinstance(scan, TimedScan) else prepare_input(methods, scan)


def in_advance(work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
    """Works on items in a thread, one item ahead of the caller.

    Args:
        work: called with each item in order.
        items: the items. The thread of the caller takes them one ahead.

    Yields:
        The results, in order; an error of the work is raised in place of its result.
    """
    with ThreadPoolExecutor(1) as pool:
        done: Future[Result] | None = None
        for item in items:
            begun = pool.submit(work, item)
            if done is not None:
                yield done.result()
            done = begun
        if done is not None:
            yield done.result()
