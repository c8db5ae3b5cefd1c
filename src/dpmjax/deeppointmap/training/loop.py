"""The training loop: batches, steps, evaluation, reports, and the best parameters so far.

    drives = simulate_scenes(range(4))                      # or open_lidar_sequence(path) of your own
    trained = train(drives, training_preset("tiny"))
    save_model(trained.model, "model.safetensors")

A run that continues from the `TrainingProgress` of any report gives the numbers of an unbroken run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import flax.struct
import jax
import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import require_fields, runs_on_host
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.training.curriculum import CurriculumStage, Layout, TrainingConfig, layout_capacity
from dpmjax.deeppointmap.training.overlap_stage import (
    OverlapHooks,
    OverlapState,
    init_overlap,
    train_overlap,
    why_no_overlap,
    with_head,
)
from dpmjax.deeppointmap.training.processes import device_mesh, from_first, is_first, place
from dpmjax.deeppointmap.training.scan_store import SampleMaker, ScanStore, prepare_drives
from dpmjax.deeppointmap.training.step import TrainingReport, TrainingState, finish, init_training, make_step
from dpmjax.progress import progress_bar
from dpmjax.sequences import LidarSequence
from dpmjax.types import AnyArray, with_short_repr


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
        run_s: seconds of all steps that were compiled before.
        compile_s: seconds of the first step of each capacity of a layout, which is compiled.
        num_scans: number of scans that the steps of `run_s` processed.
        num_steps: number of the steps of `run_s`.
    """

    run_s: float = 0.0
    compile_s: float = 0.0
    num_scans: int = 0
    num_steps: int = 0

    @property
    def scans_per_s(self) -> float:
        """Number of scans that a second of steps processes; 0 before the second step."""
        return self.num_scans / self.run_s if self.run_s > 0 else 0.0


class StepRecord(NamedTuple):
    """Report of the loop after a step.

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
    """Functions that the loop calls; of several processes, those of process 0 count.

    Attributes:
        evaluate: scores a model, larger is better; the model with the best score is kept.
        evaluate_every: number of steps from one evaluation to the next.
        on_report: gets the record and the progress after each step.
        stop: called before each step; any number but 0 ends training.
        steps_left: called before each step with the number of steps done. It returns the number of steps to the new
            end, as for `training.finish`; 0 keeps the end. Training never goes beyond the end of the curriculum.
    """

    evaluate: Callable[[Model], float] | None = None
    evaluate_every: int = 100
    on_report: Callable[[StepRecord, TrainingProgress], object] = lambda _record, _progress: None
    # int() is 0: by default nothing ends training.
    stop: Callable[[], int] = int
    steps_left: Callable[[int], int] = lambda _step: 0

    def __post_init__(self) -> None:
        require_fields(self, "evaluate_every", low=1)


@with_short_repr
class Trained(NamedTuple):
    """Result of training.

    Attributes:
        model: the model with the best score; the last one without an evaluation. Its `config.trained` lists the stages
            that came to their end.
        progress: progress after the last step of registration.
        stopped_by: the number that `stop` returned; 0 after the last step.
        speed: seconds of the steps of this call.
        overlap: state of the second stage; None where it was not begun.
    """

    model: Model
    progress: TrainingProgress
    stopped_by: int
    speed: Speed
    overlap: OverlapState | None = None


def begin_training(config: TrainingConfig, *, seed: int = 0, start: Model | None = None) -> TrainingProgress:
    """Makes the progress before the first step.

    Args:
        config: settings of training.
        seed: seed of the parameters.
        start: a model whose parameters take the place of random ones; the optimiser begins at zero with any.

    Returns:
        Progress without an evaluation.

    Raises:
        ValueError: if the parameters of `start` have other shapes than those of `config.model`.
    """
    state = init_training(jax.random.key(seed), config)
    if start is not None:
        shapes = [jax.tree.map(np.shape, params) for params in (start.params, state.params)]
        if shapes[0] != shapes[1]:
            found = "others; replace(config, model=start.config)"
            raise ValueError(f"start: expected parameters of config.model, got {found}")
        state = replace(state, params=start.params)
    return TrainingProgress(state, state.params, np.asarray(-1, np.float32), np.asarray(0, np.int32))


def after_evaluation(progress: TrainingProgress, score: float) -> TrainingProgress:
    """Keeps the parameters of the state as the best ones, unless an earlier score was higher.

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


@runs_on_host("take the gradient of a loss on encode_pyramid there")
def train(
    drives: Sequence[LidarSequence] | ScanStore,
    config: TrainingConfig,
    *,
    seed: int = 0,
    start: TrainingProgress | Model | None = None,
    hooks: TrainingHooks | None = None,
) -> Trained:
    """Trains a model on drives with poses, on all devices, or continues a training (DeepPointMap section 3.3).

    The first stage trains everything but the overlap head, and the second stage this head alone; `config.stages` may
    leave one out. Each scan is prepared before the first step, or at each use where `config.num_variants` is 0. With
    several processes (`join_processes`), each calls this function with the same arguments; process 0 alone evaluates,
    reports and trains the head.

    Args:
        drives: sequences with a true pose for each scan, such as `io.open_lidar_sequence` and
            `simulation.simulate_scenes` return; or scans that are prepared already.
        config: settings of training; `training_preset` has three. Its epochs are converted to steps.
        seed: seed of parameters, samples and augmentation.
        start: progress to continue from, of which that of process 0 counts; or a model with the first parameters;
            None begins with random ones.
        hooks: evaluation, which chooses the best model, reports and stopping; None shows a bar, and
            `TrainingHooks()` nothing.

    Returns:
        The model, without calibration, and the progress.

    Raises:
        ValueError: if there is no drive, or `start` is a model of another network. Also if a drive has no poses, no
            readable scan, or no two scans at a distance of `config.sampling`. Also if all scans overlap or none do.
        TrainingLostError: if the loss is not finite.
    """
    is_head_alone = "registration" not in config.stages
    # Calibrations belong to the parameters that they were fitted for; the head is not among them.
    kept = start.config if is_head_alone and isinstance(start, Model) else None
    config = replace(config, model=replace(config.model, calibration=None, overlap=None, trained=()))
    begun = start if isinstance(start, TrainingProgress) else begin_training(config, seed=seed, start=start)
    store = drives if isinstance(drives, ScanStore) else prepare_drives(drives, config, seed=seed)
    if "overlap" in config.stages and (reason := why_no_overlap(store.table)) is not None:
        raise ValueError(f"drives: {reason}; leave the stage overlap out")
    if is_head_alone:
        first = Trained(Model(begun.state.params, kept or config.model), begun, 0, Speed())
        return _with_trained_head(first, store, config, hooks, seed=seed)
    config = config.for_scans(len(store.table), num_samples=jax.device_count())
    if not isinstance(start, TrainingProgress):
        begun = replace(begun, state=replace(begun.state, end=np.asarray(config.num_steps, np.int32)))
    with progress_bar("train", total=config.num_steps, unit="steps", is_shown=hooks is None) as bar:
        shown = hooks or TrainingHooks(on_report=lambda record, _: bar.update(record.step - bar.n))
        progress, stopped_by, speed = _run_steps(store, config, shown, begun, seed=seed)
    params = progress.best_params if int(progress.best_step) > 0 else progress.state.params
    ended = replace(config.model, trained=() if stopped_by else ("registration",))
    first = Trained(_local(Model(params, ended)), progress, stopped_by, speed)
    if stopped_by or "overlap" not in config.stages:
        return first
    return _with_trained_head(first, store, config, hooks, seed=seed)


def _with_trained_head(
    first: Trained, store: ScanStore, config: TrainingConfig, hooks: TrainingHooks | None, *, seed: int
) -> Trained:
    """Does the second stage, in process 0."""
    state = init_overlap(first.model)
    num_steps = config.overlap.num_steps(len(store.table))
    if is_first():
        with progress_bar("train overlap", total=num_steps, unit="steps", is_shown=hooks is None) as bar:
            stop = int if hooks is None else hooks.stop
            calls = OverlapHooks(lambda *_: bar.update(), stop)
            _, state = train_overlap(store, first.model, config, seed=seed, hooks=calls)
    state = from_first(state)
    is_whole = int(state.step) >= num_steps
    model = _local(with_head(first.model, state.head, is_trained=is_whole))
    return first._replace(model=model, stopped_by=0 if is_whole else 1, overlap=state)


def _run_steps(
    store: ScanStore, config: TrainingConfig, hooks: TrainingHooks, start: TrainingProgress, *, seed: int
) -> tuple[TrainingProgress, int, Speed]:
    """Returns the progress after the last step, the number that stopped it, and the seconds."""
    mesh, num_local = device_mesh(), jax.local_device_count()
    progress = place(from_first(start), mesh)
    step = make_step(config, mesh if jax.device_count() > 1 else None)
    speed, seen, stopped_by = Speed(), set[Layout](), 0
    numbers = range(num_local * jax.process_index(), num_local * (jax.process_index() + 1))
    number, end = int(progress.state.step), int(progress.state.end)
    maker = SampleMaker(store, config, seed, numbers=numbers, num_in_step=jax.device_count())
    with closing(maker.batches(number, max(end, config.num_steps))) as batches:
        batch = next(batches) if number < end else None
        while batch is not None:
            stopped_by, left = map(int, from_first((int(hooks.stop()), hooks.steps_left(number))))
            if stopped_by:
                break
            if left > 0 and (new_end := min(number + left, max(end, config.num_steps))) != end:
                progress, end = replace(progress, state=finish(progress.state, new_end - number)), new_end
            stage, layout = config.stage_at(number), config.layout_at(number, seed=seed)
            capacity = layout_capacity(layout, config.sampling)
            begun = time.perf_counter()
            state, report = step(progress.state, place(batch, mesh, is_batch=True))
            number += 1
            batch = next(batches) if number < end else None  # prepared while the device computes
            report = jax.device_get(report)
            seconds = time.perf_counter() - begun
            speed = _timed(speed, seconds, 0 if capacity not in seen else layout.num_scans * jax.device_count())
            seen.add(capacity)
            progress = replace(progress, state=state)
            if not math.isfinite(report.loss):
                raise TrainingLostError(f"the loss of step {number} is {report.loss}; resume from an older checkpoint")
            progress, score = _evaluate_when_due(progress, config, hooks)
            if is_first():
                hooks.on_report(StepRecord(number, stage, report, score, speed), progress)
    return progress, stopped_by, speed


def _timed(speed: Speed, seconds: float, num_scans: int) -> Speed:
    """Adds the seconds of a step; without scans, it was compiled."""
    if num_scans == 0:
        return speed._replace(compile_s=speed.compile_s + seconds)
    return Speed(speed.run_s + seconds, speed.compile_s, speed.num_scans + num_scans, speed.num_steps + 1)


def _evaluate_when_due(
    progress: TrainingProgress, config: TrainingConfig, hooks: TrainingHooks
) -> tuple[TrainingProgress, float]:
    done = int(progress.state.step)
    if done % hooks.evaluate_every and done != int(progress.state.end):
        return progress, math.nan
    score = math.nan
    if hooks.evaluate is not None and is_first():
        score = hooks.evaluate(_local(Model(progress.state.params, config.model)))
    return after_evaluation(progress, float(from_first(np.asarray(score, np.float32)))), score


def _local(tree: Any) -> Any:
    # Every device holds the same; the arrays of one device are enough.
    return jax.tree.map(lambda x: jax.numpy.asarray(np.asarray(x)), tree)
