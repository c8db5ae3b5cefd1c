"""One fit of scans in a run folder, planar or in space: history, checkpoints, progress bar, Ctrl-C, resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from dpmjax import cli

if TYPE_CHECKING:
    import jax

    from dpmjax.deepmapping import Fit, Problem, Progress

# Columns of the table; the last one is the error, named with its unit.
_COLUMNS = ("step", "phase", "run_s", "loss", "occupancy", "chamfer")
# Seconds between checkpoints; Ctrl-C and the end write one too.
_SAVE_EVERY_S = 20.0


class FitRecorder:
    """Engine of a fit in a run folder (`engine=` of `fit_deepmapping`), which resumes from the last checkpoint.

    `functools.partial(recorder, measure=...)` is the same engine with a column for the error.

    Attributes:
        steps: number of steps of all runs.
        run_s: seconds of stepping of all runs, without compilation.
        compile_s: seconds of compiling.
        has_map: True where M-Net has been trained.
    """

    def __init__(self, folder: cli.RunFolder, length: str, *, stop: Callable[[float], bool]) -> None:
        """Makes an engine for one fit.

        Args:
            folder: folder of the run; gets `metrics.csv` and checkpoints.
            length: unit of the ATE.
            stop: called before each call of the step with the run time so far, seconds; the fit ends where it is True.
        """
        self._folder, self._length, self._stop = folder, length, stop
        self.steps, self.run_s, self.compile_s, self.has_map = 0, 0.0, 0.0, False

    def __call__(
        self,
        problem: Problem,
        data: Any,
        *,
        key: jax.Array,
        measure: Callable[[NDArray[np.float64]], float] = lambda _: math.nan,
    ) -> Fit:
        """Fits, or resumes from the last checkpoint of the folder; `measure` computes the ATE of its poses."""
        from dpmjax.checkpoints import Checkpoints
        from dpmjax.deepmapping import init, resume

        folder, state = self._folder, init(problem, data, key=key)
        checkpoints = Checkpoints(Path(folder.path) / cli.CHECKPOINTS)
        state = checkpoints.restore_latest(state, fallback=state)
        columns = (*_COLUMNS, f"ate_{self._length}")
        bar = tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]", desc="fit")
        saved_at = time.perf_counter()

        def record(progress: Progress) -> None:
            nonlocal saved_at
            self.run_s = earlier_s + progress.run_s
            self._write(progress, measure(np.asarray(progress.report.poses, np.float64)), history, bar)
            if time.perf_counter() - saved_at > _SAVE_EVERY_S:
                checkpoints.save(int(progress.state.step), progress.state)
                saved_at = time.perf_counter()

        with bar, cli.HistoryFile(folder / cli.HISTORY, columns, keep_until=int(state.step)) as history:
            earlier_s = max((float(row["run_s"]) for row in cli.read_history(folder / cli.HISTORY)), default=0.0)
            self.run_s = earlier_s
            done = resume(problem, state, data, on_report=record, stop=lambda: self._stop(self.run_s))
        checkpoints.save(int(done.state.step), done.state)
        self.steps, self.compile_s = int(done.state.step), done.compile_s
        self.has_map = self.steps > 0 and problem.phases[int(done.state.phase)].occupancy_weight > 0.0
        return done

    @property
    def numbers(self) -> dict[str, float]:
        """Returns seconds and steps under the names of `metrics.json`."""
        return {"fit_s": self.run_s, "compile_s": self.compile_s, "steps": self.steps}

    def _write(self, progress: Progress, ate: float, history: cli.HistoryFile, bar: tqdm) -> None:
        """Adds one call of the step to the table and to the progress bar."""
        report, phase, step = progress.report, progress.phase.name, int(progress.state.step)
        losses = {name: float(np.mean(term)) for name, term in report.terms._asdict().items()}
        row = {"step": step, "phase": phase, "run_s": round(self.run_s, 4), f"ate_{self._length}": ate}
        history.append(**row, loss=report.loss, **losses)
        ate_text = f", ATE {ate:.3g} {self._length}" if math.isfinite(ate) else ""
        show_progress(bar, f"{phase}, loss {report.loss:.4f}{ate_text}", progress.share, self.run_s)


def show_progress(bar: tqdm, text: str, done: float, run_s: float) -> None:
    """Updates the bar to the share that is done, with the text and the remaining seconds."""
    done = min(1.0, done)
    left = run_s * (1.0 - done) / max(done, 1e-9)
    bar.set_postfix_str(f"{text}, {left:.0f} s left", refresh=False)
    bar.update(done - bar.n)


def draw_loss(folder: cli.RunFolder, unit: str) -> None:
    """Draws loss.png: loss and error of the fit over its run time."""
    from dpmjax import viz

    rows = cli.read_history(folder / cli.HISTORY)
    if rows:
        seconds, loss, ate = (
            np.array([float(row[name] or "nan") for row in rows]) for name in ("run_s", "loss", f"ate_{unit}")
        )
        curves = {"loss": loss} | ({f"ATE, {unit}": ate} if np.isfinite(ate).any() else {})
        figure = viz.curves_figure(seconds, curves, x_label="run time, s", phases=[row["phase"] for row in rows])
        viz.save_figure(figure, folder / "loss.png")
