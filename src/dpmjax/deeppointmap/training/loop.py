"""The training loop: batches, steps, evaluation, reports, and the best parameters so far.

    drives = simulate_scenes(range(4))                      # or open_lidar_sequence(path) of your own
    trained = train(drives, training_preset("tiny"))
    save_model(trained.model, "model.safetensors")

A run that continues from the `TrainingProgress` of any report gives the numbers of an unbroken run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.training.curriculum import CurriculumStage, TrainingConfig
from dpmjax.deeppointmap.training.data_pipeline import SampleMaker
from dpmjax.deeppointmap.training.drives import prepare_drives
from dpmjax.deeppointmap.training.processes import (
    BATCH_AXIS,
    device_mesh,
    from_first,
    is_first,
    largest,
    place,
    together,
)
from dpmjax.deeppointmap.training.records import (
    Speed,
    StepRecord,
    Trained,
    TrainingHooks,
    TrainingLostError,
    TrainingProgress,
    after_evaluation,
    begin_training,
    uncalibrated,
)
from dpmjax.deeppointmap.training.scan_store import ScanStore
from dpmjax.deeppointmap.training.step import finish, make_step
from dpmjax.sequences import LidarSequence

NO_HOOKS = TrainingHooks()


def train(
    drives: Sequence[LidarSequence] | ScanStore,
    config: TrainingConfig,
    *,
    seed: int = 0,
    start: TrainingProgress | Model | None = None,
    cache: Path | None = None,
    hooks: TrainingHooks = NO_HOOKS,
) -> Trained:
    """Trains a model on drives with poses, on all devices, or continues a training (DeepPointMap section 3.3).

    Each scan is prepared once before the first step. With several processes (`join_processes`), each calls this
    function with the same arguments; process 0 alone evaluates and reports.

    Args:
        drives: sequences with a true pose for each scan, such as `io.open_lidar_sequence` and
            `simulation.simulate_scenes` return; or scans that are prepared already.
        config: settings of training; `training_preset` has three.
        seed: seed of parameters, samples and augmentation.
        start: progress to continue from, that of process 0 counts; or a model to begin with its parameters; None
            begins with random parameters.
        cache: folder where scans that are prepared here are kept for later calls; None keeps them in memory.
        hooks: evaluation, which chooses the best model, reports and stopping.

    Returns:
        The model, without calibration, and the progress.

    Raises:
        ValueError: if there is no drive, or `start` is a model of another network. Also if a drive has no poses, no
            readable scan, or no two scans at a distance of `config.sampling`, and if `cache` is given with prepared
            scans.
        TrainingLostError: if the loss is not finite.
    """
    if cache is not None and isinstance(drives, ScanStore):
        raise ValueError("cache: expected None, because the scans of a ScanStore are prepared already")
    config = replace(config, model=uncalibrated(config.model))
    if not isinstance(start, TrainingProgress):
        start = begin_training(config, seed=seed, start=start)
    store = drives if isinstance(drives, ScanStore) else prepare_drives(drives, config, folder=cache, seed=seed)
    progress, stopped_by, speed = _run_steps(store, config, hooks, start, seed=seed)
    params = progress.best_params if int(progress.best_step) > 0 else progress.state.params
    return Trained(_local(Model(params, config.model)), progress, stopped_by, speed)


def _run_steps(
    store: ScanStore, config: TrainingConfig, hooks: TrainingHooks, start: TrainingProgress, *, seed: int
) -> tuple[TrainingProgress, int, Speed]:
    """Returns the progress after the last step, the number that stopped it, and the seconds."""
    mesh, num_local = device_mesh(), jax.local_device_count()
    progress = place(from_first(start), mesh)
    step = make_step(config, mesh if jax.device_count() > 1 else None)
    clock, stopped_by, is_finishing = _Clock(config.sampling.num_scans * jax.device_count()), 0, False
    first_sample = jax.process_index() * num_local
    number, end = int(progress.state.step), int(progress.state.end)
    with SampleMaker(store, config, seed=seed, num_samples=num_local, first_sample=first_sample) as maker:
        batches = maker.batches(number, end)
        with together():
            batch = next(batches, None)
        while batch is not None and not (stopped_by := largest(int(hooks.stop()))):
            if not is_finishing and (is_finishing := bool(largest(int(hooks.finish())))):
                progress = place(replace(progress, state=finish(progress.state, config)), mesh)
                end = int(progress.state.end)
            stage = config.stage_at(number)
            begun = time.perf_counter()
            state, report = step(progress.state, place(batch, mesh, BATCH_AXIS))
            number += 1
            with together():  # the next batch is prepared while the device computes
                batch = next(batches, None) if number < end else None
            report = jax.device_get(report)
            clock.add(stage, time.perf_counter() - begun)
            progress = replace(progress, state=state)
            if not math.isfinite(report.loss):
                raise TrainingLostError(f"the loss of step {number} is {report.loss}; resume from an older checkpoint")
            progress, score = _evaluate_when_due(progress, config, hooks)
            with together():
                if hooks.on_report is not None and is_first():
                    hooks.on_report(StepRecord(number, stage, report, score, clock.speed), progress)
    return progress, stopped_by, clock.speed


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
