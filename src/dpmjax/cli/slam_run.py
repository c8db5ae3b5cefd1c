"""SLAM of a drive in its folder: progress, state for a resumed run, files, pictures, and numbers with verdict."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax import geometry, metrics, saved_maps, slam, viz
from dpmjax.cli.drives import ScanReader
from dpmjax.cli.options import trust_words
from dpmjax.cli.run import Numbers, Run, write_table
from dpmjax.sequences import LidarSequence, counted

if TYPE_CHECKING:
    AnyScan = slam.TimedScan | np.ndarray

STATE = "run_state.npz"
# Seconds between writings of the state; a killed run repeats the scans since the last one.
SAVE_EVERY_S = 10.0
MAP_VOXEL_M, MAX_MAP_POINTS = 0.2, 3_000_000
MAP_RANGES_M = (2.0, 60.0)
LOOP_COLUMNS = ("found_by", "status", "overlap", "probability", "rmse_m")
SCAN_COLUMNS = (
    "scan", "status", "is_keyframe", "keyframe_scan", "score", "probability", "weak_sigma_m", "num_accepted", "reason",
    "source",
)  # fmt: skip


UNSURE = {
    "network": "placed by the network: at the start, or because alignment with the scans before failed",
    "coasting": "where nothing faces the axis of a corridor: the last speed goes on there, uncertain",
    "predicted": "placed by the predicted motion only: uncertain",
    "restarted": "not placed: a new part of the map begins there",
    "empty": "without enough points",
}
"""Texts for scans that were not aligned with the scans before them, by status."""


class SlamRun(NamedTuple):
    """A run until its end or its stop.

    Attributes:
        state: after the last scan.
        reports: reports of all scans.
        compile_s: seconds of compilation.
        run_s: seconds of all scans of this process, without compilation.
        scan_s: seconds of each scan of this process, without compilation and writing.
        error: the error that stopped the run; None without one.
    """

    state: slam.SlamState
    reports: tuple[slam.ScanReport, ...]
    compile_s: float
    run_s: float
    scan_s: tuple[float, ...]
    error: Exception | None


class _Clock:
    """Stands still during compilation."""

    def __init__(self) -> None:
        import jax

        self.compile_s = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def now_s(self) -> float:
        return time.perf_counter() - self.compile_s

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.compile_s += duration_secs


def find_beginning(folder: Path | None, methods: slam.SlamMethods, start: slam.SlamState) -> saved_maps.RunState:
    """Reads the state in the folder of an earlier run, if any; raises a `ValueError` for a run with other weights."""
    if folder is None or not (folder / STATE).is_file():
        return saved_maps.RunState(start, ())
    found = saved_maps.load_state(folder / STATE)
    require_same_weights(folder / STATE, found.state.slam_map, methods, "give those, or start again")
    return found


def map_drive(
    folder: Path, reader: ScanReader, methods: slam.SlamMethods, stop: Callable[[], bool] = lambda: False
) -> tuple[SlamRun, slam.SlamResult]:
    """Maps a drive from its beginning, or from the state in its folder.

    Args:
        folder: folder for the state; made here.
        reader: reads the scans.
        methods: matcher, geometry and settings.
        stop: called before each scan; True ends the run.

    Returns:
        The run with its seconds, and the trajectory and the map.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mapped = run_scans(folder, reader, methods, find_beginning(folder, methods, slam.init_slam()), stop=stop)
    if mapped.error is not None:
        raise mapped.error
    return mapped, slam.finish_slam(mapped.state, mapped.reports, methods.config)


def run_scans(
    folder: Path,
    reader: ScanReader,
    methods: slam.SlamMethods,
    beginning: saved_maps.RunState,
    *,
    stop: Callable[[], bool],
    viewer: viz.LiveViewer | None = None,
) -> SlamRun:
    """Places the remaining scans and saves the state of the last keyframe; an error stops the run.

    Args:
        folder: folder for the state.
        reader: reads the scans.
        methods: matcher, geometry and settings.
        beginning: state and reports of the scans that are done.
        stop: called before each scan; True ends the run.
        viewer: shows the run.

    Returns:
        The run.
    """
    clock, sequence, error = _Clock(), reader.sequence, None
    state, reports, scan_s = beginning.state, list(beginning.reports), list[float]()
    first, started, saved = len(reports), clock.now_s(), time.perf_counter()
    resumable: saved_maps.RunState | None = None

    def prepare(index: int) -> tuple[AnyScan, AnyScan | slam.PreparedInput]:
        scan = reader(index)
        return scan, slam.prepare_ahead(methods, scan)

    progress = tqdm(total=len(sequence), initial=first, desc=sequence.name, unit=" scans", dynamic_ncols=True)
    with progress as bar, closing(slam.in_advance(prepare, range(first, len(sequence)))) as scans:
        try:
            for row in range(first, len(sequence)):
                if stop():
                    break
                before = clock.now_s()
                scan, prepared = next(scans)
                guessed = slam.with_guess(state.front_end, reader.odometry, row)
                state, report = slam.step_slam(methods, state._replace(front_end=guessed), prepared)
                scan_s.append(clock.now_s() - before)
                reports.append(report)
                if report.is_keyframe:
                    resumable = saved_maps.RunState(state, tuple(reports))
                if resumable is not None and time.perf_counter() - saved > SAVE_EVERY_S:
                    saved_maps.save_state(folder / STATE, *resumable)
                    resumable, saved = None, time.perf_counter()
                if viewer is not None:
                    show_live(viewer, scan, state, report)
                num_loops = len(accepted_ends(state.loops.loops))
                counts = f"{counted(len(state.slam_map), 'keyframe')}, {counted(num_loops, 'loop')}"
                bar.set_postfix_str(f"{counts}, {report.status}, score {report.score:.2f}", refresh=False)
                bar.update(1)
        except Exception as failure:  # what was found is written before it goes on
            error = failure
        finally:
            if resumable is not None:
                saved_maps.save_state(folder / STATE, *resumable)
    return SlamRun(state, tuple(reports), clock.compile_s, clock.now_s() - started, tuple(scan_s), error)


def show_live(viewer: viz.LiveViewer, scan: AnyScan, state: slam.SlamState, report: slam.ScanReport) -> None:
    """Shows a scan in the viewer, and the map after a new keyframe."""
    T_world_keyframe = state.slam_map.T_world_keyframe
    if not len(T_world_keyframe):
        return
    points = slam.corrected_points(scan, report.T_turn)
    viewer.show_scan(report.scan, points, T_world_keyframe[report.keyframe] @ report.T_keyframe_scan)
    if report.is_keyframe:
        viewer.show_map(T_world_keyframe, points, T_world_keyframe[accepted_ends(state.loops.loops), :3, 3])


class Cloud(NamedTuple):
    """A thinned map.

    Attributes:
        points: (n, 3) in the world, m.
        heights_m: (n,) heights above the lidar that measured the point.
        voxel_m: side of a voxel; each voxel has one point.
    """

    points: np.ndarray
    heights_m: np.ndarray
    voxel_m: float


def write_loops(path: Path, loops: Sequence[slam.Loop], ends: Sequence[Mapping[str, int]]) -> None:
    """Writes every candidate of a loop: its two keyframes, its source, its outcome, and the numbers behind it.

    Args:
        path: the file.
        loops: the candidates.
        ends: cells of each keyframe, in the order of the map. Columns of the target begin with `other_`.
    """
    others = [{f"other_{name}": cell for name, cell in end.items()} for end in ends]
    rows = [{**ends[loop.source], **others[loop.target], **loop._asdict(), "rmse_m": loop.rmse} for loop in loops]
    names = [*ends[0], *others[0]] if ends else ["scan", "other_scan"]
    write_table(path, [*names, *LOOP_COLUMNS], rows)


def write_scans(path: Path, result: slam.SlamResult, sources: Sequence[str]) -> None:
    """Writes the reports on the placed scans."""
    rows = []
    for report, source in zip(result.reports, sources, strict=False):
        keyframe = result.keyframes[report.keyframe] if len(result.keyframes) else ""
        named = {"is_keyframe": int(report.is_keyframe), "keyframe_scan": keyframe, "source": source}
        rows.append(report._asdict() | named)
    write_table(path, SCAN_COLUMNS, rows)


def accepted_ends(loops: Sequence[slam.Loop]) -> np.ndarray:
    """Returns (m, 2) rows of the keyframes that accepted loops join."""
    ends = [(loop.source, loop.target) for loop in loops if loop.status == "accepted"]
    return np.array(ends, np.int64).reshape(-1, 2)


def gather_map(T_world_scan: np.ndarray, read_scan: Callable[[int], np.ndarray]) -> Cloud:
    """Transforms scans to the world frame and keeps one point for each voxel; larger maps have larger voxels.

    Args:
        T_world_scan: (n, 4, 4) poses.
        read_scan: reads the points of a scan, in its own frame.

    Returns:
        The points of all scans, thinned.
    """
    from dpmjax.scan.lidar.preprocess import first_of_each_voxel

    voxel_m, whole, fresh = MAP_VOXEL_M, np.zeros((0, 4), np.float32), list[np.ndarray]()
    for row, T in enumerate(tqdm(T_world_scan, desc="map", unit=" keyframes", dynamic_ncols=True)):
        points = read_scan(row).astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        points = points[(ranges > MAP_RANGES_M[0]) & (ranges < MAP_RANGES_M[1])]
        turned = points[first_of_each_voxel(points, voxel_m)] @ T[:3, :3].T
        fresh.append(np.column_stack([turned + T[:3, 3], turned[:, 2]]).astype(np.float32))
        # Larger maps are thinned less often, so that the work is linear in the size of the map.
        if row == len(T_world_scan) - 1 or sum(map(len, fresh)) > len(whole) + 200_000:
            whole, fresh = np.concatenate([whole, *fresh]), []
            whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
            while len(whole) > MAX_MAP_POINTS:
                voxel_m *= 1.5
                whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
    return Cloud(whole[:, :3], whole[:, 3], voxel_m)


def draw_pictures(run: Run, sequence: LidarSequence, result: slam.SlamResult, cloud: Cloud, numbers: Numbers) -> None:
    """Draws trajectory.png and map.png."""
    T, slam_map, name = result.T_world_scan, result.map, sequence.name
    reference, ends = sequence.T_world_lidar, accepted_ends(result.loops)

    def track(label: str, color: str, T_world_scan: np.ndarray, suffix: str) -> viz.Track:
        ate_m = numbers.get(f"ate{suffix}_m")
        return viz.Track(T_world_scan[:, :3, 3], color, label if ate_m is None else f"{label}, ATE {ate_m:.3f} m")

    # Odometry alone begins where the drive begins, also in a map that was there before.
    odometry = T[0] @ geometry.rigid.inverse(result.T_odometry_scan[0]) @ result.T_odometry_scan
    tracks = [track("odometry alone", viz.ODOMETRY, odometry, "_odometry")] if len(ends) else []
    if num_old := numbers["num_keyframes"] - numbers["num_new_keyframes"]:
        tracks.insert(0, viz.Track(slam_map.T_world_keyframe[:num_old, :3, 3], viz.INK, "the map before", "--"))
    tracks.append(track("SLAM", viz.PATH, T, ""))
    shown, known = None, sequence.has_reference
    if reference is not None and known.any():
        positions = reference[known, :3, 3]
        T_map_reference = metrics.align_rigid(positions, T[known, :3, 3])
        shown = positions @ T_map_reference[:3, :3].T + T_map_reference[:3, 3]
    title, loops = f"{name}: {counted(len(T), 'scan')}", slam_map.T_world_keyframe[ends, :3, 3]
    viz.save_figure(viz.trajectory_figure(title, tracks, shown, loops), run / "trajectory.png")
    title = f"{name}: {counted(len(result.keyframes), 'keyframe')}"
    if numbers["num_parts"] > 1:
        title += f", {numbers['num_parts']} parts at guessed relative poses"
    viz.save_figure(viz.height_map_figure(title, cloud.points, cloud.heights_m, T[:, :3, 3]), run / "map.png")


def open_map(path: Path, methods: slam.SlamMethods) -> slam.KeyframeMap:
    """Reads a saved map.

    Args:
        path: a file of `save_map`.
        methods: methods of the weights that must have made it.

    Returns:
        The map.

    Raises:
        ValueError: the file does not exist, is no map, or is a map of other weights.
    """
    slam_map = saved_maps.load_map(path)
    require_same_weights(path, slam_map, methods, "name the weights that made it with --weights")
    return slam_map


def require_same_weights(path: Path, slam_map: slam.KeyframeMap, methods: slam.SlamMethods, advice: str) -> None:
    """Raises a ValueError with advice if other weights than those of the methods made a map."""
    made_by, given = slam_map.origin, methods.origin
    if made_by is not None and made_by.fingerprint != given.fingerprint:
        raise ValueError(f"{path}: made with weights {made_by}, these are {given}; {advice}")


def run_numbers(result: slam.SlamResult, sequence: LidarSequence) -> Numbers:
    """Returns the numbers of a map for `metrics.json`; the sequence has the scans that were placed."""
    T, reference, assessment = result.T_world_scan, sequence.T_world_lidar, result.assessment
    loops = collections.Counter(loop.status for loop in result.loops)
    numbers = {
        "sequence": sequence.name,
        "num_scans": len(T),
        "path_m": float(metrics.path_lengths(T).max(initial=0.0)),
        "reference_doubt": metrics.reference_doubt(T, sequence),
        "num_keyframes": len(result.keyframes),
        "num_new_keyframes": sum(report.is_keyframe for report in result.reports),
        "num_parts": assessment.num_parts,
        "is_trusted": assessment.is_trusted,
        "uncertain_scans": list(assessment.uncertain_scans),
        "num_loops": loops["accepted"],
        **metrics.trajectory_errors(T, reference),
        **metrics.trajectory_errors(result.T_odometry_scan, reference, "_odometry"),
        "scan_statuses": dict(collections.Counter(report.status for report in result.reports)),
        "loop_statuses": dict(loops),
    }
    return {**judge(assessment, numbers), **numbers}


def judge(assessment: slam.MapAssessment, numbers: Numbers) -> Numbers:
    """Returns status and verdict of a run that came to its end.

    Args:
        assessment: of the map.
        numbers: of the run.

    Returns:
        The status "done", "uncertain" or "failed", and one sentence: whether the map can be trusted, its size, and its
        uncertain or wrong parts.
    """
    if assessment.fault is not None:
        advice = "check that the scans are 3-D, in metres, and follow each other"
        return {"status": "failed", "verdict": f"{assessment.fault}: {advice}"}
    statuses, scans = numbers["scan_statuses"], counted(sum(numbers["scan_statuses"].values()), "scan")
    text = f"{trust_words(assessment.is_trusted)}: {scans}, {numbers['path_m']:.1f} m driven, "
    text += counted(numbers["num_new_keyframes"], "keyframe")
    if numbers["num_keyframes"] > numbers["num_new_keyframes"]:
        text += f" ({numbers['num_keyframes']} in the map)"
    text += f", {counted(numbers['num_loops'], 'loop closure')}"
    for status, found in UNSURE.items():
        if status in statuses:
            text += f"; {counted(statuses[status], 'scan')} {found} (scans.csv has the reasons)"
    if assessment.num_parts > 1:
        text += f"; the map has {assessment.num_parts} parts that no loop joins; their relative pose is a guess"
    if numbers["reference_doubt"] is not None:
        text += f"; warning: {numbers['reference_doubt']}"
    for suffix, name in (("_odometry", "odometry alone"), ("", "SLAM")):
        if f"ate{suffix}_m" in numbers:
            text += f"; ATE of {name} {numbers[f'ate{suffix}_m']:.3f} m"
    return {"status": "done" if assessment.is_trusted else "uncertain", "verdict": text}
