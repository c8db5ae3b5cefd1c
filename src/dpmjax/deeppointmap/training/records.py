"""The records of a training: progress, hooks, reports, result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import flax.struct
import jax
import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import require_count
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.training.curriculum import CurriculumStage, TrainingConfig
from dpmjax.deeppointmap.training.step import TrainingReport, TrainingState, init_training
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
    """Functions that the loop calls. `evaluate` and `on_report` are called in process 0 only.

    Attributes:
        evaluate: scores a model, larger is better; the model with the best score is kept.
        evaluate_every: number of steps from one evaluation to the next.
        on_report: gets the record and the progress after each step.
        stop: called before each step; any number but 0 ends training in all processes.
        finish: called before each step until it returns True in any process; from then on the learning rate falls, as
            `training.finish` describes.
    """

    evaluate: Callable[[Model], float] | None = None
    evaluate_every: int = 100
    on_report: Callable[[StepRecord, TrainingProgress], None] | None = None
    stop: Callable[[], int] = int
    finish: Callable[[], bool] = bool

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
            raise ValueError(
                "start: expected parameters of config.model, got others; replace(config, model=start.config)"
            )
        state = replace(state, params=start.params)
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


def uncalibrated(model: ModelConfig) -> ModelConfig:
    """Removes the calibrations, which belong to the parameters that they were fitted for.

    Args:
        model: configuration of a model.

    Returns:
        A new configuration.
    """
    return replace(model, calibration=None, overlap=None)
