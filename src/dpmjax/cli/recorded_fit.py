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

from dpmjax import viz
from dpmjax.cli.run import CHECKPOINTS, HISTORY, Numbers, Run

if TYPE_CHECKING:
    import jax

    from dpmjax.deepmapping import Fit, Problem, Progress

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

    def __init__(self, run: Run, length: str, *, max_s: float = math.inf) -> None:
        """Makes an engine for one fit.

        Args:
            run: gets `metrics.csv` and checkpoints.
            length: unit of the ATE.
            max_s: seconds of stepping after which the fit ends.
        """
        self._run, self._length, self._max_s = run, length, max_s
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

        state = init(problem, data, key=key)
        checkpoints = Checkpoints(Path(self._run / CHECKPOINTS))
        state = checkpoints.restore_latest(state, fallback=state)
        earlier = self._run.continue_table(HISTORY, until=int(state.step))
        earlier_s = self.run_s = max((float(row["run_s"]) for row in earlier), default=0.0)
        bar = tqdm(
            total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}{postfix}]", desc="fit"
        )
        saved_at = time.perf_counter()

        def record(progress: Progress) -> None:
            nonlocal saved_at
            self.run_s = earlier_s + progress.run_s
            ate = measure(np.asarray(progress.report.poses, np.float64))
            self._append(progress, ate)
            self._show(progress, ate, bar)
            if time.perf_counter() - saved_at > _SAVE_EVERY_S:
                checkpoints.save(int(progress.state.step), progress.state)
                saved_at = time.perf_counter()

        with bar:
            done = resume(problem, state, data, on_report=record, stop=self._is_over)
        checkpoints.save(int(done.state.step), done.state)
        self.steps, self.compile_s = int(done.state.step), done.compile_s
        self.has_map = self.steps > 0 and problem.phases[int(done.state.phase)].occupancy_weight > 0.0
        return done

    @property
    def numbers(self) -> Numbers:
        """Returns seconds and steps under the names of `metrics.json`."""
        return {"fit_s": self.run_s, "compile_s": self.compile_s, "steps": self.steps}

    def _is_over(self) -> bool:
        return self._run.is_stopped or self.run_s >= self._max_s

    def _append(self, progress: Progress, ate: float) -> None:
        """Adds one call of the step to the table."""
        report = progress.report
        row = {"step": int(progress.state.step), "phase": progress.phase.name, "run_s": round(self.run_s, 4)}
        row |= {"loss": report.loss, **{name: float(np.mean(term)) for name, term in report.terms._asdict().items()}}
        self._run.append_row(HISTORY, **row, **{f"ate_{self._length}": ate})

    def _show(self, progress: Progress, ate: float, bar: tqdm) -> None:
        """Moves the bar to the share that is done."""
        ate_text = f", ATE {ate:.3g} {self._length}" if math.isfinite(ate) else ""
        bar.set_postfix_str(f"{progress.phase.name}, loss {progress.report.loss:.4f}{ate_text}", refresh=False)
        bar.update(progress.share - bar.n)


def draw_loss(run: Run, unit: str) -> None:
    """Draws loss.png: loss and error of the fit over its run time."""
    if rows := run.read_table(HISTORY):
        seconds, loss, ate = (
            np.array([float(row[name] or "nan") for row in rows]) for name in ("run_s", "loss", f"ate_{unit}")
        )
        curves = {"loss": loss} | ({f"ATE, {unit}": ate} if np.isfinite(ate).any() else {})
        figure = viz.curves_figure(seconds, curves, x_label="run time, s", phases=[row["phase"] for row in rows])
        viz.save_figure(figure, run / "loss.png")
