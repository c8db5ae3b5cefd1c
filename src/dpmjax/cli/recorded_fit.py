"""One fit of scans in a run folder, planar or in space: history, checkpoints, progress bar, Ctrl-C, resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
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
SAVE_EVERY_S = 20.0


class FitRecorder:
    """Engine of a fit in a run folder (`engine=` of `fit_deepmapping`), which resumes from the last checkpoint.

    `functools.partial(recorder, measure=...)` is the same engine with a column for the error.

    Attributes:
        numbers: seconds and steps of all runs, under the names of `metrics.json`.
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
        self.numbers: Numbers = {"fit_s": 0.0, "compile_s": 0.0, "steps": 0}
        self.has_map = False

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

        state, checkpoints = init(problem, data, key=key), Checkpoints(self._run / CHECKPOINTS)
        state = checkpoints.restore_latest(state, fallback=state)
        earlier = self._run.continue_table(HISTORY, until=int(state.step))
        run_s = earlier_s = max((float(row["run_s"]) for row in earlier), default=0.0)
        saved_at = time.perf_counter()

        def record(progress: Progress) -> None:
            nonlocal saved_at, run_s
            report, phase, step = progress.report, progress.phase.name, int(progress.state.step)
            run_s, ate = earlier_s + progress.run_s, measure(np.asarray(report.poses, np.float64))
            terms = {name: float(np.mean(term)) for name, term in report.terms._asdict().items()}
            row = {"step": step, "phase": phase, "run_s": round(run_s, 4), "loss": report.loss, **terms}
            self._run.append_row(HISTORY, **row, **{f"ate_{self._length}": ate})
            ate_text = f", ATE {ate:.3g} {self._length}" if math.isfinite(ate) else ""
            bar.set_postfix_str(f"{phase}, loss {report.loss:.4f}{ate_text}", refresh=False)
            bar.update(progress.share - bar.n)
            if time.perf_counter() - saved_at > SAVE_EVERY_S:
                checkpoints.save(step, progress.state)
                saved_at = time.perf_counter()

        bar_format = "{desc} {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}{postfix}]"
        with tqdm(total=1.0, bar_format=bar_format, desc="fit") as bar:
            stop = lambda: self._run.is_stopped or run_s >= self._max_s  # noqa: E731
            done = resume(problem, state, data, on_report=record, stop=stop)
        steps = int(done.state.step)
        checkpoints.save(steps, done.state)
        self.numbers = {"fit_s": run_s, "compile_s": done.compile_s, "steps": steps}
        self.has_map = steps > 0 and problem.phases[int(done.state.phase)].occupancy_weight > 0.0
        return done


def draw_loss(run: Run, unit: str) -> None:
    """Draws loss.png: loss and error of the fit over its run time."""
    if rows := run.read_table(HISTORY):
        names = {"run_s": "", "loss": "loss", f"ate_{unit}": f"ATE, {unit}"}
        curves = {label: np.array([float(row[name] or "nan") for row in rows]) for name, label in names.items()}
        seconds, phases = curves.pop(""), [row["phase"] for row in rows]
        curves = {label: curve for label, curve in curves.items() if np.isfinite(curve).any()}
        viz.save_figure(viz.curves_figure(seconds, curves, x_label="run time, s", phases=phases), run / "loss.png")
