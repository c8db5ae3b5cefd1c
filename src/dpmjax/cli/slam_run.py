"""SLAM of a drive in a folder: progress, and the state for a resumed run."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import slam, viz
from dpmjax.cli import slam_results as results
from dpmjax.cli.drives import ScanReader
from dpmjax.saved_maps import RunState, load_state, save_state
from dpmjax.sequences import counted

STATE = "run_state.npz"
# Seconds between writings of the state; a killed run repeats the scans since the last one.
SAVE_EVERY_S = 10.0
# A scan from its file, and the same scan prepared for SLAM.
_Prepared = tuple[slam.TimedScan | np.ndarray, slam.TimedScan | slam.PreparedInput]


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
        self.compile_s = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def now_s(self) -> float:
        return time.perf_counter() - self.compile_s

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.compile_s += duration_secs


def find_beginning(folder: Path | None, methods: slam.SlamMethods, start: slam.SlamState) -> RunState:
    """Reads the state in the folder of an earlier run, if any; raises a `ValueError` for a run with other weights."""
    if folder is None or not (folder / STATE).is_file():
        return RunState(start, ())
    found = load_state(folder / STATE)
    results.require_same_weights(folder / STATE, found.state.slam_map, methods, "give those, or start again")
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
    beginning: RunState,
    *,
    stop: Callable[[], bool],
    viewer: viz.LiveViewer | None = None,
    odometry: np.ndarray | None = None,
) -> SlamRun:
    """Places the remaining scans and saves the state of the last keyframe; an error stops the run.

    Args:
        folder: folder for the state.
        reader: reads the scans.
        methods: matcher, geometry and settings.
        beginning: state and reports of the scans that are done.
        stop: called before each scan; True ends the run.
        viewer: shows the run.
        odometry: (n, 4, 4) poses of the lidar, as first guesses; None without odometry.

    Returns:
        The run.
    """
    clock, sequence, error = _Clock(), reader.sequence, None
    state, reports, scan_s = beginning.state, list(beginning.reports), list[float]()
    first, started, saved = len(reports), clock.now_s(), time.perf_counter()
    resumable: RunState | None = None

    def prepare(index: int) -> _Prepared:
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
                guessed = slam.with_guess(state.front_end, odometry, row)
                state, report = slam.step_slam(methods, state._replace(front_end=guessed), prepared)
                scan_s.append(clock.now_s() - before)
                reports.append(report)
                if report.is_keyframe:
                    resumable = RunState(state, tuple(reports))
                if resumable is not None and time.perf_counter() - saved > SAVE_EVERY_S:
                    save_state(folder / STATE, *resumable)
                    resumable, saved = None, time.perf_counter()
                if viewer is not None:
                    show_live(viewer, scan, state, report)
                num_loops = len(results.accepted_ends(state.loops.loops))
                counts = f"{counted(len(state.slam_map), 'keyframe')}, {counted(num_loops, 'loop')}"
                bar.set_postfix_str(f"{counts}, {report.status}, score {report.score:.2f}", refresh=False)
                bar.update(1)
        except Exception as failure:  # what was found is written before it goes on
            error = failure
        finally:
            if resumable is not None:
                save_state(folder / STATE, *resumable)
    return SlamRun(state, tuple(reports), clock.compile_s, clock.now_s() - started, tuple(scan_s), error)


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
