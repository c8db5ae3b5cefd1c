"""A SLAM run in its folder: progress, the journal, interim results, seconds of each stage; a stop at any scan."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
from tqdm import tqdm

from dpmjax.cli.run_folder import RunFolder
from dpmjax.cli.slam_files import write_scans, write_trajectory
from dpmjax.cli.slam_outcome import SlamRun
from dpmjax.cli.slam_reader import ScanReader
from dpmjax.sequences import LidarSequence
from dpmjax.slam import (
    Journal,
    JournalContent,
    SlamMethods,
    SlamResult,
    SlamState,
    finish_slam,
    init_slam,
    place_scans,
    read_journal,
    step_slam,
)

if TYPE_CHECKING:
    from dpmjax.slam import ScanReport
    from dpmjax.slam.front_end import AnyScan

JOURNAL = "slam.journal"
# Seconds between interim results, for those who look at a run that goes on.
FLUSH_EVERY_S = 30.0
_STAGES = {
    "measure": "surface",
    "align": "odometry",
    "align_scans": "neighbours",
    "describe": "encode",
    "register": "loops",
    "overlaps": "loops",
}


class Beginning(NamedTuple):
    """Where a run goes on.

    Attributes:
        start: state before the first scan of the drive.
        earlier: what the journal of a resumed run holds; None for a new one.
    """

    start: SlamState
    earlier: JournalContent | None = None


class Hooks(NamedTuple):
    """Callbacks of a run.

    Attributes:
        is_stopped: whether to end before the next scan.
        on_scan: called with each scan, the state after it and its report; None for no call.
    """

    is_stopped: Callable[[], bool]
    on_scan: Callable[[AnyScan, SlamState, ScanReport], None] | None = None


class Stopwatch:
    """Seconds of stages, and of compilation, which belongs to none."""

    def __init__(self) -> None:
        self.stages_s: collections.defaultdict[str, float] = collections.defaultdict(float)
        self.compile_s = 0.0
        jax.monitoring.register_event_duration_secs_listener(self._on_event)

    def timed(self, stage: str, work: Callable[..., Any], *arguments: Any) -> Any:
        """Calls `work` and counts its time for a stage."""
        started, compiled = time.perf_counter(), self.compile_s
        try:
            return work(*arguments)
        finally:
            self.stages_s[stage] += time.perf_counter() - started - (self.compile_s - compiled)

    def _on_event(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            self.compile_s += duration_secs


class Timed:
    """A matcher or a geometry whose calls are counted.

    Args:
        wrapped: the matcher or the geometry.
        watch: counts.
    """

    def __init__(self, wrapped: Any, watch: Stopwatch) -> None:
        self._wrapped, self._watch = wrapped, watch

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._wrapped, name)
        return partial(self._watch.timed, _STAGES[name], found) if name in _STAGES else found


def find_beginning(folder: RunFolder, methods: SlamMethods, start: SlamState, reader: ScanReader) -> Beginning:
    """Reads what a run has done that is resumed."""
    if not folder.is_resumed or not (folder / JOURNAL).is_file():
        return Beginning(start)
    first = start.front_end.num_scans
    return Beginning(start, read_journal(folder / JOURNAL, methods, lambda scan: reader(scan - first), start))


def map_drive(
    folder: RunFolder, sequence: LidarSequence, methods: SlamMethods, is_stopped: Callable[[], bool]
) -> tuple[SlamRun, SlamResult]:
    """Maps a drive from its beginning, or goes on from the journal in its folder.

    Args:
        folder: for the journal and interim results.
        sequence: the drive.
        methods: matcher, geometry and settings.
        is_stopped: whether to end before the next scan.

    Returns:
        The run with its seconds, and the trajectory and the map.

    Raises:
        InputError: a scan on the way that cannot be read.
    """
    reader = ScanReader(sequence)
    beginning = find_beginning(folder, methods, init_slam(), reader)
    run = run_scans(folder, sequence, reader, methods, beginning, Hooks(is_stopped))
    if run.failure is not None:
        raise run.failure
    return run, finish_slam(run.state, run.reports, methods.config)


def run_scans(
    folder: RunFolder,
    sequence: LidarSequence,
    reader: ScanReader,
    methods: SlamMethods,
    beginning: Beginning,
    hooks: Hooks,
) -> SlamRun:
    """Places all scans that are left; what ends it early is in the result, and what was found is in the journal."""
    watch = Stopwatch()
    timed = methods._replace(matcher=Timed(methods.matcher, watch), geometry=Timed(methods.geometry, watch))
    earlier, state = beginning.earlier, beginning.start
    reports, fresh = list(earlier.reports if earlier else ()), []
    journal = Journal(folder / JOURNAL, earlier, state)
    state = earlier.state if earlier else state
    first, failure, started, flushed = len(reports), None, time.perf_counter(), time.perf_counter()
    bar = tqdm(total=len(sequence), initial=first, desc=sequence.name, unit=" scans", dynamic_ncols=True)
    scans = reader.iterate(first)
    try:
        for _ in range(first, len(sequence)):
            if hooks.is_stopped():
                break
            scan = watch.timed("read", next, scans)
            state, report = step_slam(timed, state, scan)
            reports.append(report)
            fresh.append(report)
            if report.is_keyframe:
                watch.timed("journal", journal.append, methods, state, fresh)
                fresh = []
            if hooks.on_scan is not None:
                watch.timed("viewer", hooks.on_scan, scan, state, report)
            bar.set_postfix_str(_progress(state, reports, watch), refresh=False)
            bar.update(1)
            if time.perf_counter() - flushed > FLUSH_EVERY_S:
                watch.timed("write", write_interim, folder, sequence, state, reports)
                flushed = time.perf_counter()
    except Exception as error:  # what was found is written before it goes on
        failure = error
    finally:
        scans.close()
        if fresh:
            journal.append(methods, state, fresh)
        journal.close()
        bar.close()
    run_s = time.perf_counter() - started - watch.compile_s
    watch.stages_s["rest"] = run_s - sum(watch.stages_s.values())
    num_done = len(reports) - first
    return SlamRun(state, tuple(reports), dict(watch.stages_s), watch.compile_s, run_s, num_done, failure)


def write_interim(folder: RunFolder, sequence: LidarSequence, state: SlamState, reports: list[ScanReport]) -> None:
    """Writes trajectory and scans.csv as they are now."""
    slam_map = state.slam_map
    times = None if sequence.times is None else sequence.times[: len(reports)]
    write_trajectory(folder.path, place_scans(slam_map.T_world_keyframe, reports), times)
    keyframes = [keyframe.scan for keyframe in slam_map.keyframes]
    write_scans(folder / "scans.csv", reports, keyframes, sequence.sources)


def _progress(state: SlamState, reports: list[ScanReport], watch: Stopwatch) -> str:
    accepted = sum(loop.status == "accepted" for loop in state.loops.loops)
    parts = [f"kf {len(state.slam_map)}", f"loops {accepted}", f"score {reports[-1].score:.2f}"]
    if reports[-1].status not in ("first", "tracked"):
        parts.append(reports[-1].status)
    return ", ".join([*parts, f"compiled {watch.compile_s:.0f} s"])
