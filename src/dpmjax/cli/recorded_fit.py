"""One fit of scans in a run folder, planar or in space: history, checkpoints, progress bar, Ctrl-C, resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from dpmjax.cli.result_files import HistoryFile, read_history
from dpmjax.cli.run_folder import CHECKPOINTS, HISTORY, RunFolder

if TYPE_CHECKING:
    from dpmjax.checkpoints import Checkpoints
    from dpmjax.deepmapping import DeepMappingConfig, Fitted, Problem
    from dpmjax.deepmapping.fit import Fit, Progress
    from dpmjax.sequences import ScanSequence

# Of the table; the error, named with its unit, comes last.
_COLUMNS = ("step", "phase", "run_s", "loss", "occupancy", "chamfer")
# Seconds between checkpoints; Ctrl-C and the end write one too.
_SAVE_EVERY_S = 20.0


class FitRun(NamedTuple):
    """A fit in a run folder.

    Attributes:
        fitted: the fit; poses in the unit of the scans.
        steps: steps done in all.
        run_s: seconds of stepping, compile time apart.
        compile_s: seconds of compiling.
        has_map: M-Net has been trained.
    """

    fitted: Fitted
    steps: int
    run_s: float
    compile_s: float
    has_map: bool


class FitTask(NamedTuple):
    """What is fitted in a run folder.

    Attributes:
        problem: of the engine.
        data: of the problem.
        seed: of the run.
        measure: ATE of the problem's poses in the unit below; NaN without a reference.
        length: unit of the ATE.
    """

    problem: Problem
    data: Any
    seed: int
    measure: Callable[[NDArray[np.float64]], float]
    length: str


class RecordedFit(NamedTuple):
    """A fit that `record_fit` has done.

    Attributes:
        done: the fit, poses in the unit of the problem.
        run_s: seconds of stepping, those of earlier runs too, compile time apart.
        has_map: M-Net has been trained.
    """

    done: Fit
    run_s: float
    has_map: bool


def run_fit(
    folder: RunFolder,
    sequence: ScanSequence,
    settings: DeepMappingConfig,
    *,
    start: NDArray[np.float64] | None,
    seed: int,
    stop: Callable[[float], bool],
) -> FitRun:
    """Fits planar scans, or continues where the checkpoints of the folder end.

    Args:
        folder: of the run; gets `metrics.csv` and checkpoints.
        sequence: the scans.
        settings: of DeepMapping.
        start: (n, 3) poses, or None for a cold start.
        seed: of the run.
        stop: called before each call of the step with the run time so far, seconds; the fit ends where it is True.

    Returns:
        FitRun.
    """
    from dpmjax.deepmapping.planar import as_fitted, planar_data, planar_problem
    from dpmjax.types import ScanSet

    data, unit = planar_data(ScanSet(sequence.points, sequence.mask), start)
    measure = _ate_of(sequence, unit)
    task = FitTask(planar_problem(settings, data), data, seed, measure, sequence.unit)
    done, run_s, has_map = record_fit(folder, task, stop=stop)
    return FitRun(as_fitted(done, unit, settings), int(done.state.step), run_s, done.compile_s, has_map)


def record_fit(folder: RunFolder, task: FitTask, *, stop: Callable[[float], bool]) -> RecordedFit:
    """Fits, or continues where the checkpoints of the folder end.

    Args:
        folder: of the run; gets `metrics.csv` and checkpoints.
        task: what is fitted.
        stop: called before each call of the step with the run time so far, seconds; the fit ends where it is True.

    Returns:
        RecordedFit.
    """
    import jax

    from dpmjax.checkpoints import Checkpoints
    from dpmjax.deepmapping.fit import init, resume

    state = init(task.problem, task.data, key=jax.random.key(task.seed))
    checkpoints = Checkpoints(Path(folder.path) / CHECKPOINTS)
    if folder.is_resumed:
        state = checkpoints.restore_latest(state, fallback=state)
    with _Recorder(folder, task, checkpoints, int(state.step)) as recorder:
        done = resume(task.problem, state, task.data, on_report=recorder.record, stop=lambda: stop(recorder.run_s))
    checkpoints.save(int(done.state.step), done.state)
    has_map = task.problem.phases[int(done.state.phase)].occupancy_weight > 0.0
    return RecordedFit(done, recorder.run_s, has_map)


class _Recorder:
    """Writes what a fit reports to the table, the progress bar and the checkpoints."""

    def __init__(self, folder: RunFolder, task: FitTask, checkpoints: Checkpoints, step: int) -> None:
        self._checkpoints = checkpoints
        self._measure, self._length = task.measure, task.length
        self._earlier_s = _earlier_seconds(folder, step)
        self.run_s = self._earlier_s
        self._bar = tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]", desc="fit")
        columns = (*_COLUMNS, f"ate_{task.length}")
        self._history = HistoryFile(folder / HISTORY, columns, keep_until=step if folder.is_resumed else None)
        self._saved_at = time.perf_counter()

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()
        self._history.__exit__(None, None, None)

    def record(self, progress: Progress) -> None:
        """One call of the step."""
        report, phase, step = progress.report, progress.phase.name, int(progress.state.step)
        self.run_s = self._earlier_s + progress.run_s
        ate = self._measure(np.asarray(report.poses, np.float64))
        losses = {name: float(np.mean(term)) for name, term in report.terms._asdict().items()}
        row = {"step": step, "phase": phase, "run_s": round(self.run_s, 4), f"ate_{self._length}": ate}
        self._history.append(**row, loss=report.loss, **losses)
        ate_text = f", ATE {ate:.3g} {self._length}" if math.isfinite(ate) else ""
        show_progress(self._bar, f"{phase}, loss {report.loss:.4f}{ate_text}", progress.share, self.run_s)
        if time.perf_counter() - self._saved_at > _SAVE_EVERY_S:
            self._checkpoints.save(step, progress.state)
            self._saved_at = time.perf_counter()


def _earlier_seconds(folder: RunFolder, step: int) -> float:
    """Run time of the steps that an earlier run has done."""
    if not folder.is_resumed or not (folder / HISTORY).exists():
        return 0.0
    return max((float(row["run_s"]) for row in read_history(folder / HISTORY) if int(row["step"]) <= step), default=0.0)


def _ate_of(sequence: ScanSequence, unit: float) -> Callable[[NDArray[np.float64]], float]:
    from dpmjax.metrics import absolute_trajectory_error

    reference = sequence.reference_poses
    if reference is None:
        return lambda _: math.nan
    return lambda poses: absolute_trajectory_error(unit * poses[:, :2], reference[:, :2])


def show_progress(bar: tqdm, text: str, done: float, run_s: float) -> None:
    """Moves the bar to the share that is done, and writes the text and the seconds left."""
    done = min(1.0, done)
    left = run_s * (1.0 - done) / max(done, 1e-9)
    bar.set_postfix_str(f"{text}, {left:.0f} s left", refresh=False)
    bar.update(done - bar.n)


def draw_loss(folder: RunFolder, unit: str) -> None:
    """Draws loss.png: loss and error of the fit over its run time."""
    from dpmjax import viz

    rows = read_history(folder / HISTORY)
    if rows:
        seconds, loss, ate = (
            np.array([float(row[name] or "nan") for row in rows]) for name in ("run_s", "loss", f"ate_{unit}")
        )
        history = viz.History(seconds, loss, [row["phase"] for row in rows], ate)
        viz.save_figure(viz.history_figure(history, unit), folder / "loss.png")
