"""A DeepPointMap training: its drives and evaluations, and the table, the bar and the checkpoints that it writes."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import replace
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.checkpoints import Checkpoints
from dpmjax.io import open_lidar_sequence
from dpmjax.simulation import HDL32E, HDL64E, OS1_64, simulate_drive

# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED, SELECTION_SEED = 1_000_000, 2_000_000
SELECTION_PAIRS, VALIDATION_PAIRS = 320, 60
SELECTION_SCENES = (("suburb", HDL64E), ("canyon", OS1_64), ("country", HDL32E), ("campus", OS1_64))
SELECTION_LENGTH_M = 250.0
KINDS = (dpm.PairKind(2.0, 10.0), dpm.PairKind(10.0, 20.0), dpm.PairKind(2.0, 10.0, 4), dpm.PairKind(10.0, 20.0, 4))
"""Pairs that models are selected and reported by: scans and maps of four scans, near and far."""

KIND_NAMES = ("recall", "recall_far", "recall_maps", "recall_maps_far")
# Seconds between checkpoints; Ctrl-C and the end write one too.
SAVE_EVERY_S = 300.0
SHOWN = ("loss", "pairing", "offset", "top1_accuracy", "score")
MEASURES = (*SHOWN, "coarse", "gradient_norm", "learning_rate")
RECALLS = (*KIND_NAMES, "real_recall", "real_recall_far")
# Coefficients of determination of predicted offsets, on the selection pairs; empty without an offset head.
OFFSETS = ("offset_r2_normal", "offset_r2_along", "offset_r2_up")
COLUMNS = ("step", "stage", "run_s", *MEASURES, *RECALLS, *OFFSETS)


class EvaluationSets(NamedTuple):
    """Pairs of a run.

    Attributes:
        selection: pairs of towns of their own, by which the best model is chosen.
        real: pairs of each folder of real scans, which are measured but not used for selection.
        held_out: pairs of another town, measured once at the end.
    """

    selection: tuple[dpm.EvaluationPairs, ...]
    real: tuple[dpm.EvaluationPairs, ...]
    held_out: dpm.EvaluationPairs


def draw_sets(
    settings: dpm.TrainingConfig,
    held_out_pairs: int,
    validate: Sequence[Path],
    *,
    length_m: float,
    on_wait: Callable[[], object] = lambda: None,
) -> EvaluationSets:
    """Returns the pairs of a run; `validate` names folders of real scans, `length_m` is that of towns.

    `on_wait` is called before each drive; an error of it ends the preparation.
    """
    draw = partial(dpm.draw_evaluation_pairs, config=settings.model)
    num = max(1, SELECTION_PAIRS // (len(KINDS) * len(SELECTION_SCENES)))
    towns = [
        simulate_drive(SELECTION_SEED + number, length_m=min(length_m, SELECTION_LENGTH_M), kind=kind, sensor=sensor)
        for number, (kind, sensor) in enumerate(SELECTION_SCENES)
    ]
    held_out = simulate_drive(HELD_OUT_SEED, length_m=length_m, kind="suburb", sensor=HDL64E)
    work = [partial(draw, town, num, kinds=KINDS, max_scans=64) for town in towns]
    work += [partial(draw, open_lidar_sequence(path), VALIDATION_PAIRS, kinds=KINDS[:2]) for path in validate]
    work += [partial(draw, held_out, held_out_pairs, kinds=KINDS)]
    sets = []
    for one in tqdm(work, desc="prepare evaluation", unit=" drives", dynamic_ncols=True):
        on_wait()
        sets.append(one())
    return EvaluationSets(tuple(sets[: len(towns)]), tuple(sets[len(towns) : -1]), sets[-1])


def prepare_sources(
    sources: Sequence[cli.Source],
    settings: dpm.TrainingConfig,
    folder: Path,
    *,
    seed: int,
    on_wait: Callable[[], object] = lambda: None,
) -> list[dpm.PreparedDrive]:
    """Returns all drives, each prepared in a process of its own and kept in `folder` for later runs.

    `on_wait` is called every second, or after each scan of a single drive; an error of it ends the preparation.
    """
    prepare = partial(_prepare, settings=settings, folder=folder, seed=seed)
    if len(sources) == 1:
        with tqdm(desc="prepare scans", unit=" scans", dynamic_ncols=True) as bar:
            return [prepare(sources[0], on_scan=lambda: (bar.update(1), on_wait()))]
    # A fresh interpreter: a fork of a process that runs JAX may hang.
    num_workers = min(len(sources), os.cpu_count() or 1)
    with ProcessPoolExecutor(num_workers, get_context("spawn"), initializer=_begin_worker) as pool:
        begun = [pool.submit(prepare, source) for source in sources]
        with tqdm(desc="prepare scans", total=len(begun), unit=" drives", dynamic_ncols=True) as bar:
            try:
                remaining = set(begun)
                while remaining:
                    done, remaining = wait(remaining, timeout=1.0, return_when=FIRST_COMPLETED)
                    for one in done:
                        one.result()  # an error ends the preparation of all drives
                    bar.update(len(done))
                    on_wait()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for process in active_children():
                    process.kill()
                    process.join()
                    for unfinished in folder.glob(f".*.npy.{process.pid}*"):
                        unfinished.unlink()
                raise
        return [one.result() for one in begun]


def _begin_worker() -> None:
    # The device belongs to the process that trains, and so does the answer to Ctrl-C.
    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _prepare(source: cli.Source, *, settings: dpm.TrainingConfig, **options: Any) -> dpm.PreparedDrive:
    return dpm.prepare_drive(source(), settings, **options)


class Records:
    """The table, the progress bar, the checkpoints and the evaluation of a run; one process has them.

    Attributes:
        folder: folder of the run.
        sets: pairs of evaluations.
        untrained: the model before the first step.
        start: progress to start from: the latest checkpoint of a resumed run.
        earlier_s: run time of the steps of earlier calls of `train`.
    """

    def __init__(
        self,
        folder: cli.RunFolder,
        settings: dpm.TrainingConfig,
        sets: EvaluationSets,
        *,
        seed: int,
        weights: dpm.Model | None = None,
    ) -> None:
        self.folder, self.sets, self._settings = folder, sets, settings
        self._checkpoints, self._best = Checkpoints(folder / cli.CHECKPOINTS), Checkpoints(folder / cli.BEST)
        begun = dpm.begin_training(settings, seed=seed, start=weights)
        self.untrained = dpm.Model(begun.state.params, settings.model)
        self.start = self._restored(begun)
        first = int(self.start.state.step)
        self._history = cli.HistoryFile(folder / cli.HISTORY, COLUMNS, keep_until=first)
        self.earlier_s = max((float(row["run_s"]) for row in cli.read_history(folder / cli.HISTORY)), default=0.0)
        total = int(self.start.state.end)
        self._bar = tqdm(total=total, initial=first, desc="train", unit=" steps", dynamic_ncols=True)
        self._last_saved, self._recalls = time.perf_counter(), dict.fromkeys((*RECALLS, *OFFSETS), math.nan)
        self.run_s = self.earlier_s
        self._seen: set[dpm.CurriculumStage] = set()
        self._tell_compilation(self.start.state)

    def evaluate(self, model: dpm.Model) -> float:
        """Returns the mean recall on the selection pairs, and measures their offsets and the recall on real pairs."""

        def mean_recalls(found: Sequence[dpm.Evaluation]) -> list[float]:
            return np.mean([[recall.recall for recall in one.recalls] for one in found], axis=0).tolist()

        found, real = (
            [dpm.evaluate_registration(model, pairs) for pairs in sets]
            for sets in (self.sets.selection, self.sets.real)
        )
        of_kinds = mean_recalls(found)
        of_real = mean_recalls(real) if real else [math.nan, math.nan]
        predicted = [offsets for one in found for offsets in one.offsets]
        r2 = dpm.measure_offsets(predicted if model.config.decoder.predicts_offsets else []).r2.tolist()
        self._recalls = dict(zip((*RECALLS, *OFFSETS), (*of_kinds, *of_real, *r2), strict=True))
        return float(np.mean(of_kinds))

    def on_report(self, record: dpm.StepRecord, progress: dpm.TrainingProgress) -> None:
        """Adds a row, updates the bar, and writes a checkpoint every few minutes."""
        values = _values(record)
        if math.isfinite(record.score):
            values |= {name: value for name, value in self._recalls.items() if math.isfinite(value)}
        measured = {name: f"{value:.7g}" for name, value in values.items()}
        self.run_s = self.earlier_s + record.speed.run_s + record.speed.compile_s
        self._history.append(step=record.step, stage=_stage_name(record.stage), run_s=round(self.run_s, 3), **measured)
        self._bar.set_postfix_str(_summary(record, self._recalls["recall"]), refresh=False)
        self._bar.total = int(progress.state.end)
        self._bar.update(1)
        self._tell_compilation(progress.state)
        if time.perf_counter() - self._last_saved > SAVE_EVERY_S:
            self.save(progress)
            self._last_saved = time.perf_counter()

    def save(self, progress: dpm.TrainingProgress) -> None:
        """Writes a checkpoint, and the best parameters where they have changed since the last one."""
        if int(progress.best_step):
            self._best.save(int(progress.best_step), progress.best_params)
        self._checkpoints.save(int(progress.state.step), replace(progress, best_params={}))

    def _restored(self, start: dpm.TrainingProgress) -> dpm.TrainingProgress:
        found = self._checkpoints.restore_latest(replace(start, best_params={}), fallback=None)
        if found is None:
            return start
        if int(found.best_step):
            params = self._best.restore(int(found.best_step), start.best_params)
            if params is not None:
                return replace(found, best_params=params)
        return replace(start, state=found.state, best_params=found.state.params)

    def _tell_compilation(self, state: dpm.TrainingState) -> None:
        stage = self._settings.stage_at(int(state.step))
        if int(state.step) < int(state.end) and stage not in self._seen:
            self._seen.add(stage)
            self._bar.set_postfix_str(f"compiling {_stage_name(stage)}")

    def __enter__(self) -> Records:
        return self

    def __exit__(self, *error: Any) -> None:
        self._history.__exit__(*error)
        self._bar.close()


def run_training(
    records: Records | None,
    store: dpm.ScanStore,
    settings: dpm.TrainingConfig,
    hooks: dpm.TrainingHooks,
    *,
    seed: int,
    plateau_s: float = math.inf,
) -> dpm.Trained:
    """Returns the result of training, after saving its last state; one process has records.

    After `plateau_s` seconds of steps, compilation and evaluation, those of earlier calls included, the decay of the
    learning rate begins.
    """
    if records is None:
        return dpm.train(store, settings, seed=seed, hooks=hooks)
    with records:
        hooks = replace(hooks, evaluate=records.evaluate, on_report=records.on_report)
        hooks = replace(hooks, finish=lambda: records.run_s >= plateau_s)
        trained = dpm.train(store, settings, seed=seed, start=records.start, hooks=hooks)
        records.save(trained.progress)
        return trained


def _stage_name(stage: dpm.CurriculumStage) -> str:
    return f"K={stage.max_group}"


def _values(record: dpm.StepRecord) -> dict[str, Any]:
    values = {**record.report._asdict(), **record.report.terms._asdict(), "score": record.score}
    if values["offset"] == 0:  # no offset head is trained
        values["offset"] = math.nan
    return {name: float(values[name]) for name in MEASURES if math.isfinite(values[name])}


def _summary(record: dpm.StepRecord, recall: float) -> str:
    values = {**_values(record), **({"recall": recall} if math.isfinite(recall) else {})}
    parts = [f"{name} {values[name]:.3f}" for name in SHOWN if name in values]
    return ", ".join([_stage_name(record.stage), *parts, f"{record.speed.scans_per_s:.1f} scans/s"])
