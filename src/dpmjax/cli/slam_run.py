"""A SLAM run in its folder: progress, interim results, seconds of each stage, and the state for a resumed run."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli, slam, viz
from dpmjax.saved_maps import RunState, load_state, save_state
from dpmjax.sequences import LidarSequence, counted

STATE = "run_state.npz"
# Seconds between writings of the state; a killed run repeats the scans since the last one.
SAVE_EVERY_S = 10.0
# Seconds between interim results.
FLUSH_EVERY_S = 30.0
# End of the names of stages that run in the thread of the next scan.
AHEAD = " ahead"
# A scan as it was read, and as it is placed.
_Prepared = tuple[slam.TimedScan | np.ndarray, slam.TimedScan | slam.PreparedInput]
_STAGES = {
    "thin": "thinning",
    **dict.fromkeys(("align", "search"), "odometry"),
    "encode": "encoder",
    "propose": "decoder",
    **dict.fromkeys(("register", "overlaps"), "loops"),
}


class Stopwatch:
    """Seconds of stages, and of compilation, which is counted separately."""

    def __init__(self) -> None:
        self.stages_s: collections.defaultdict[str, float] = collections.defaultdict(float)
        self.compile_s = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def timed(self, stage: str, work: Callable[..., Any], *arguments: Any) -> Any:
        """Calls `work` and counts its time for a stage."""
        started = self.now_s()
        try:
            return work(*arguments)
        finally:
            self.stages_s[stage] += self.now_s() - started

    def count_rest(self, run_s: float) -> None:
        """Counts the seconds that no stage has; stages ahead run at the same time as others."""
        counted = (seconds for stage, seconds in self.stages_s.items() if not stage.endswith(AHEAD))
        self.stages_s["rest"] = run_s - sum(counted)

    def now_s(self) -> float:
        """Returns the time of a clock that stands still during compilation."""
        return time.perf_counter() - self.compile_s

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.compile_s += duration_secs


class Timed:
    """A matcher or a geometry whose calls are counted.

    Args:
        wrapped: the matcher or the geometry.
        watch: counts.
        suffix: of the names of the stages.
    """

    def __init__(self, wrapped: Any, watch: Stopwatch, suffix: str = "") -> None:
        self._wrapped, self._watch, self._suffix = wrapped, watch, suffix

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._wrapped, name)
        return partial(self._watch.timed, _STAGES[name] + self._suffix, found) if name in _STAGES else found


def find_beginning(earlier: Path | None, methods: slam.SlamMethods, start: slam.SlamState) -> RunState:
    """Reads the state of an earlier run, if there is one; raises a `ValueError` for a run with other weights."""
    path = None if earlier is None else earlier / STATE
    if path is None or not path.is_file():
        return RunState(start, ())
    found = load_state(path)
    cli.require_same_weights(path, found.state.slam_map, methods, "give those, or start again")
    return found


def map_drive(
    folder: cli.RunFolder, sequence: LidarSequence, methods: slam.SlamMethods, is_stopped: Callable[[], bool]
) -> tuple[cli.SlamRun, slam.SlamResult]:
    """Maps a drive from its beginning, or from the state in its folder.

    Args:
        folder: folder for the state and interim results.
        sequence: the drive.
        methods: matcher, geometry and settings.
        is_stopped: True to end before the next scan.

    Returns:
        The run with its seconds, and the trajectory and the map.

    Raises:
        InputError: a scan on the way that cannot be read.
    """
    beginning = find_beginning(folder.path if folder.is_resumed else None, methods, slam.init_slam())
    run = run_scans(folder, cli.ScanReader(sequence), methods, beginning, is_stopped)
    if run.failure is not None:
        raise run.failure
    return run, slam.finish_slam(run.state, run.reports, methods.config)


def run_scans(
    folder: cli.RunFolder,
    reader: cli.ScanReader,
    methods: slam.SlamMethods,
    beginning: RunState,
    is_stopped: Callable[[], bool],
    viewer: viz.LiveViewer | None = None,
) -> cli.SlamRun:
    """Places the remaining scans and saves the state of the last keyframe; the result has an error that ended the run.

    Args:
        folder: folder for the state and interim results.
        reader: reads the scans.
        methods: matcher, geometry and settings.
        beginning: state and reports of the scans that are done.
        is_stopped: True to end before the next scan.
        viewer: shows the run.

    Returns:
        The run.
    """
    watch, sequence = Stopwatch(), reader.sequence
    timed = _timed(methods, watch)
    state, reports, scan_s = beginning.state, list(beginning.reports), list[float]()
    first, failure, started = len(reports), None, watch.now_s()
    flushed = saved = time.perf_counter()
    resumable: RunState | None = None
    progress = tqdm(total=len(sequence), initial=first, desc=sequence.name, unit=" scans", dynamic_ncols=True)
    with progress as bar, closing(_prepared_scans(reader, _timed(methods, watch, AHEAD), first)) as scans:
        try:
            for _ in range(first, len(sequence)):
                if is_stopped():
                    break
                before = watch.now_s()
                scan, prepared = watch.timed("waiting", next, scans)
                state, report = slam.step_slam(timed, state, prepared)
                scan_s.append(watch.now_s() - before)
                reports.append(report)
                if report.is_keyframe:
                    resumable = RunState(state, tuple(reports))
                if resumable is not None and time.perf_counter() - saved > SAVE_EVERY_S:
                    watch.timed("write", save_state, folder / STATE, *resumable)
                    resumable, saved = None, time.perf_counter()
                if viewer is not None:
                    watch.timed("viewer", show_live, viewer, scan, state, report)
                bar.set_postfix_str(_progress(state, report, watch), refresh=False)
                bar.update(1)
                if time.perf_counter() - flushed > FLUSH_EVERY_S:
                    watch.timed("write", write_interim, folder, sequence, state, reports)
                    flushed = time.perf_counter()
        except Exception as error:  # what was found is written before it goes on
            failure = error
        finally:
            if resumable is not None:
                watch.timed("write", save_state, folder / STATE, *resumable)
    run_s = watch.now_s() - started
    watch.count_rest(run_s)
    return cli.SlamRun(state, tuple(reports), dict(watch.stages_s), watch.compile_s, run_s, tuple(scan_s), failure)


def _prepared_scans(reader: cli.ScanReader, methods: slam.SlamMethods, first: int) -> Generator[_Prepared, None, None]:
    """Reads and prepares each scan while the caller works on the one before."""

    def prepare(index: int) -> _Prepared:
        scan = reader(index)
        return scan, slam.prepare_ahead(methods, scan)

    return slam.in_advance(prepare, range(first, len(reader.sequence)))


def _timed(methods: slam.SlamMethods, watch: Stopwatch, suffix: str = "") -> slam.SlamMethods:
    matcher, geometry = (Timed(part, watch, suffix) for part in (methods.matcher, methods.geometry))
    return methods._replace(matcher=matcher, geometry=geometry)


def write_interim(
    folder: cli.RunFolder, sequence: LidarSequence, state: slam.SlamState, reports: Sequence[slam.ScanReport]
) -> None:
    """Writes the present trajectory and scans.csv."""
    slam_map, done = state.slam_map, sequence.take(slice(0, len(reports)))
    cli.write_trajectory(folder.path, slam.place_scans(slam_map.T_world_keyframe, reports), done.times)
    cli.write_scans(folder / "scans.csv", reports, [keyframe.scan for keyframe in slam_map.keyframes], done.sources)


def _progress(state: slam.SlamState, report: slam.ScanReport, watch: Stopwatch) -> str:
    num_loops = len(cli.accepted_ends(state.loops.loops))
    parts = [counted(len(state.slam_map), "keyframe"), counted(num_loops, "loop"), f"score {report.score:.2f}"]
    if report.status not in ("first", "tracked"):
        parts.append(report.status)
    return ", ".join([*parts, f"compiled {watch.compile_s:.0f} s"])


def show_live(viewer: viz.LiveViewer, scan: Any, state: slam.SlamState, report: slam.ScanReport) -> None:
    """Shows a scan in the viewer, and the map after a new keyframe."""
    T_world_keyframe = state.slam_map.T_world_keyframe
    if not len(T_world_keyframe):
        return
    points = slam.corrected_points(scan, report.T_turn)
    viewer.show_scan(report.scan, points, T_world_keyframe[report.keyframe] @ report.T_keyframe_scan)
    if report.is_keyframe:
        viewer.show_map(T_world_keyframe, points, T_world_keyframe[cli.accepted_ends(state.loops.loops), :3, 3])
