"""The training loop: batches, steps, evaluation, reports, and the best parameters so far.

    store = ScanStore([prepare_drive(drive, config) for drive in drives])
    trained = train(store, config, hooks=TrainingHooks(evaluate=..., on_report=...))

A run that continues from the `TrainingProgress` of any report gives the numbers of an unbroken run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import flax.struct
import jax
import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import require_count
from dpmjax.deeppointmap.curriculum import CurriculumStage, TrainingConfig
from dpmjax.deeppointmap.data_pipeline import SampleMaker
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.processes import BATCH_AXIS, device_mesh, from_first, is_first, largest, place, together
from dpmjax.deeppointmap.scan_store import ScanStore
from dpmjax.deeppointmap.training import TrainingReport, TrainingState, init_training, make_step
from dpmjax.types import AnyArray


class TrainingLostError(ArithmeticError):
    """The loss is not finite."""


@flax.struct.dataclass
class TrainingProgress:
    """The state of training and the best parameters so far; a checkpoint of it resumes the run exactly.

    Attributes:
        state: state after the last step.
        best_params: parameters with the best score; the initial ones before the first evaluation.
        best_score: the best score; -1 before the first evaluation.
        best_step: number of steps before the best evaluation; 0 before the first.
    """

    state: TrainingState
    best_params: dict[str, Any]
    best_score: Float[AnyArray, ""]
    best_step: Int[AnyArray, ""]


class Speed(NamedTuple):
    """Seconds of steps.

    Attributes:
        run_s: seconds of all steps, without compilation.
        compile_s: seconds of the first step of each stage.
        scans_per_s: scans that a second of steps processes.
    """

    run_s: float
    compile_s: float
    scans_per_s: float


class StepRecord(NamedTuple):
    """What the loop reports after a step.

    Attributes:
        step: number of steps done.
        stage: stage of the step.
        report: measures of the step.
        score: score of an evaluation after this step; NaN without one.
        speed: seconds of the steps of this call.
    """

    step: int
    stage: CurriculumStage
    report: TrainingReport
    score: float
    speed: Speed


@dataclass(frozen=True)
class TrainingHooks:
    """Functions that the loop calls. `evaluate` and `on_report` are called in process 0 only.

    Attributes:
        evaluate: scores a model, larger is better; the model with the best score is kept.
        evaluate_every: number of steps from one evaluation to the next.
        on_report: gets the record and the progress after each step.
        stop: called before each step; any number but 0 ends training in all processes.
    """

    evaluate: Callable[[Model], float] | None = None
    evaluate_every: int = 100
    on_report: Callable[[StepRecord, TrainingProgress], None] | None = None
    stop: Callable[[], int] = int

    def __post_init__(self) -> None:
        require_count("evaluate_every", self.evaluate_every)


class Trained(NamedTuple):
    """Result of training.

    Attributes:
        model: the model with the best score; the last one without an evaluation.
        progress: progress after the last step.
        stopped_by: the number that `stop` returned; 0 after the last step.
        speed: seconds of the steps of this call.
    """

    model: Model
    progress: TrainingProgress
    stopped_by: int
    speed: Speed


def train(
    store: ScanStore,
    config: TrainingConfig,
    *,
    seed: int = 0,
    start: TrainingProgress | None = None,
    hooks: TrainingHooks = TrainingHooks(),
) -> Trained:
    """Trains a model on all devices, or continues a training.

    With several processes (`join_processes`), each calls this function with the same settings.

    Args:
        store: the scans.
        config: settings of training.
        seed: seed of parameters, samples and augmentation.
        start: progress to continue from; that of process 0 counts.
        hooks: evaluation, reports and stopping.

    Returns:
        The model and the progress.

    Raises:
        TrainingLostError: if the loss is not finite.
    """
    if start is None:
        start = begin_training(init_training(jax.random.key(seed), config))
    mesh, num_local = device_mesh(), jax.local_device_count()
    progress = place(from_first(start), mesh)
    step = make_step(config, mesh if jax.device_count() > 1 else None)
    clock, stopped_by = _Clock(config.sampling.num_scans * jax.device_count()), 0
    first_sample = jax.process_index() * num_local
    with SampleMaker(store, config, seed=seed, num_samples=num_local, first_sample=first_sample) as maker:
        batches = maker.batches(int(progress.state.step), int(start.state.end))
        with together():
            batch = next(batches, None)
        while batch is not None and not (stopped_by := largest(int(hooks.stop()))):
            stage = config.stage_at(int(progress.state.step))
            begun = time.perf_counter()
            state, report = step(progress.state, place(batch, mesh, BATCH_AXIS))
            with together():  # the next batch is prepared while the device computes
                batch = next(batches, None)
            report = jax.device_get(report)
            clock.add(stage, time.perf_counter() - begun)
            progress = replace(progress, state=state)
            number = int(state.step)
            if not math.isfinite(report.loss):
                raise TrainingLostError(f"the loss of step {number} is {report.loss}; resume from an older checkpoint")
            progress, score = _evaluate_when_due(progress, config, hooks)
            with together():
                if hooks.on_report is not None and is_first():
                    hooks.on_report(StepRecord(number, stage, report, score, clock.speed), progress)
    params = progress.best_params if int(progress.best_step) > 0 else progress.state.params
    model = _local(Model(params, config.model))
    return Trained(model, progress, stopped_by, clock.speed)


def begin_training(state: TrainingState) -> TrainingProgress:
    """Makes the progress before the first step.

    Args:
        state: from `init_training`.

    Returns:
        Progress without an evaluation.
    """
    return TrainingProgress(state, state.params, np.asarray(-1, np.float32), np.asarray(0, np.int32))


def after_evaluation(progress: TrainingProgress, score: float) -> TrainingProgress:
    """Keeps the parameters of the state if no score was better; of equal scores, the later one counts.

    Args:
        progress: progress before the evaluation.
        score: score of the parameters of the state.

    Returns:
        The new progress.
    """
    if not score >= float(progress.best_score):
        return progress
    state = progress.state
    return TrainingProgress(state, state.params, np.asarray(score, np.float32), np.asarray(state.step, np.int32))


def _evaluate_when_due(
    progress: TrainingProgress, config: TrainingConfig, hooks: TrainingHooks
) -> tuple[TrainingProgress, float]:
    done = int(progress.state.step)
    if done % hooks.evaluate_every and done != int(progress.state.end):
        return progress, math.nan
    score = math.nan
    with together():
        if hooks.evaluate is not None and is_first():
            score = hooks.evaluate(_local(Model(progress.state.params, config.model)))
    return after_evaluation(progress, float(from_first(np.asarray(score, np.float32)))), score


def _local(tree: Any) -> Any:
    # Every device holds the same; the arrays of one device are enough.
    return jax.tree.map(lambda x: jax.numpy.asarray(np.asarray(x)), tree)


class _Clock:
    """Sums up the seconds of steps; the first step of each stage counts as compilation."""

    def __init__(self, scans_per_step: int) -> None:
        self.speed, self._scans, self._scans_per_step = Speed(0.0, 0.0, 0.0), 0, scans_per_step
        self._seen: set[CurriculumStage] = set()

    def add(self, stage: CurriculumStage, seconds: float) -> None:
        if stage not in self._seen:
            self._seen.add(stage)
            self.speed = self.speed._replace(compile_s=self.speed.compile_s + seconds)
            return
        self._scans += self._scans_per_step
        run_s = self.speed.run_s + seconds
        self.speed = self.speed._replace(run_s=run_s, scans_per_s=self._scans / run_s)
