"""A SLAM run in its folder: progress, and the state for a resumed run."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import slam, viz
from dpmjax.cli import slam_results as results
from dpmjax.cli.drives import ScanReader
from dpmjax.cli.run import Run
from dpmjax.saved_maps import RunState, load_state, save_state
from dpmjax.sequences import LidarSequence, counted

STATE = "run_state.npz"
# Seconds between writings of the state; a killed run repeats the scans since the last one.
SAVE_EVERY_S = 10.0
# A scan from its file, and the same scan prepared for SLAM.
_Prepared = tuple[slam.TimedScan | np.ndarray, slam.TimedScan | slam.PreparedInput]


class DriveFolder(NamedTuple):
    """Folder of a drive without a run of its own; no signal stops its mapping."""

    path: Path
    is_stopped: bool = False

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def fail(self, error: Exception) -> None:
        """Raises the error, which the worker sends back."""
        raise error


class SlamRun(NamedTuple):
    """A run until its end or its stop.

    Attributes:
        state: after the last scan.
        reports: reports of all scans.
        compile_s: seconds of compilation.
        run_s: seconds of all scans of this process, without compilation.
        scan_s: seconds of each scan of this process, without compilation and writing.
    """

    state: slam.SlamState
    reports: tuple[slam.ScanReport, ...]
    compile_s: float
    run_s: float
    scan_s: tuple[float, ...]


class _Clock:
    """Stands still during compilation."""

    def __init__(self) -> None:
        self.compile_s = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def now_s(self) -> float:
        return time.perf_counter() - self.compile_s

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.compile_s += duration_secs


def find_beginning(earlier: Path | None, methods: slam.SlamMethods, start: slam.SlamState) -> RunState:
    """Reads the state of an earlier run, if there is one; raises a `ValueError` for a run with other weights."""
    path = None if earlier is None else earlier / STATE
    if path is None or not path.is_file():
        return RunState(start, ())
    found = load_state(path)
    results.require_same_weights(path, found.state.slam_map, methods, "give those, or start again")
    return found


def map_drive(run: Run, sequence: LidarSequence, methods: slam.SlamMethods) -> tuple[SlamRun, slam.SlamResult]:
    """Maps a drive from its beginning, or from the state in its folder.

    Args:
        run: folder for the state.
        sequence: the drive.
        methods: matcher, geometry and settings.

    Returns:
        The run with its seconds, and the trajectory and the map.
    """
    beginning = find_beginning(run.path if run.is_resumed else None, methods, slam.init_slam())
    mapped = run_scans(run, ScanReader(sequence), methods, beginning)
    return mapped, slam.finish_slam(mapped.state, mapped.reports, methods.config)


def run_scans(
    run: Run | DriveFolder,
    reader: ScanReader,
    methods: slam.SlamMethods,
    beginning: RunState,
    *,
    viewer: viz.LiveViewer | None = None,
    odometry: np.ndarray | None = None,
) -> SlamRun:
    """Places the remaining scans and saves the state of the last keyframe; an error stops the run.

    Args:
        run: folder for the state.
        reader: reads the scans.
        methods: matcher, geometry and settings.
        beginning: state and reports of the scans that are done.
        viewer: shows the run.
        odometry: (n, 4, 4) poses of the lidar, as first guesses; None without odometry.

    Returns:
        The run.
    """
    clock, sequence = _Clock(), reader.sequence
    state, reports, scan_s = beginning.state, list(beginning.reports), list[float]()
    first, started = len(reports), clock.now_s()
    saved = time.perf_counter()
    resumable: RunState | None = None
    progress = tqdm(total=len(sequence), initial=first, desc=sequence.name, unit=" scans", dynamic_ncols=True)
    with progress as bar, closing(_prepared_scans(reader, methods, first)) as scans:
        try:
            for row in range(first, len(sequence)):
                if run.is_stopped:
                    break
                before = clock.now_s()
                scan, prepared = next(scans)
                guessed = slam.with_guess(state.front_end, odometry, row)
                state, report = slam.step_slam(methods, state._replace(front_end=guessed), prepared)
                scan_s.append(clock.now_s() - before)
                reports.append(report)
                if report.is_keyframe:
                    resumable = RunState(state, tuple(reports))
                if resumable is not None and time.perf_counter() - saved > SAVE_EVERY_S:
                    save_state(run / STATE, *resumable)
                    resumable, saved = None, time.perf_counter()
                if viewer is not None:
                    show_live(viewer, scan, state, report)
                bar.set_postfix_str(_progress(state, report, clock.compile_s), refresh=False)
                bar.update(1)
        except Exception as error:  # what was found is written before it goes on
            run.fail(error)
        finally:
            if resumable is not None:
                save_state(run / STATE, *resumable)
    return SlamRun(state, tuple(reports), clock.compile_s, clock.now_s() - started, tuple(scan_s))


def _prepared_scans(reader: ScanReader, methods: slam.SlamMethods, first: int) -> Generator[_Prepared, None, None]:
    """Reads and prepares each scan while the caller works on the one before."""

    def prepare(index: int) -> _Prepared:
        scan = reader(index)
        return scan, slam.prepare_ahead(methods, scan)

    return slam.in_advance(prepare, range(first, len(reader.sequence)))


def _progress(state: slam.SlamState, report: slam.ScanReport, compile_s: float) -> str:
    num_loops = len(results.accepted_ends(state.loops.loops))
    parts = [counted(len(state.slam_map), "keyframe"), counted(num_loops, "loop"), f"score {report.score:.2f}"]
    if report.status not in ("first", "tracked"):
        parts.append(report.status)
    return ", ".join([*parts, f"compiled {compile_s:.0f} s"])


def show_live(
    viewer: viz.LiveViewer, scan: slam.TimedScan | np.ndarray, state: slam.SlamState, report: slam.ScanReport
) -> None:
    """Shows a scan in the viewer, and the map after a new keyframe."""
    T_world_keyframe = state.slam_map.T_world_keyframe
    if not len(T_world_keyframe):
        return
    points = slam.corrected_points(scan, report.T_turn)
    viewer.show_scan(report.scan, points, T_world_keyframe[report.keyframe] @ report.T_keyframe_scan)
    if report.is_keyframe:
        viewer.show_map(T_world_keyframe, points, T_world_keyframe[results.accepted_ends(state.loops.loops), :3, 3])
