"""A DeepPointMap training: its drives and evaluations, and the table, the bar and the checkpoints that it writes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.checkpoints import Checkpoints
from dpmjax.deeppointmap.training.curriculum import Layout, layout_capacity
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
COLUMNS = ("step", "stage", "run_s", *MEASURES, *RECALLS)


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
        self._last_saved, self._recalls = time.perf_counter(), dict.fromkeys(RECALLS, math.nan)
        self.run_s, self._pace_s = self.earlier_s, math.nan
        self._seed, self._seen = seed, set[Layout]()
        self._tell_compilation(self.start.state)

    def evaluate(self, model: dpm.Model) -> float:
        """Returns the mean recall on the selection pairs, and measures that on real pairs."""

        def mean_recalls(sets: Sequence[dpm.EvaluationPairs]) -> list[float]:
            found = (dpm.evaluate_registration(model, pairs).recalls for pairs in sets)
            return np.mean([[recall.recall for recall in recalls] for recalls in found], axis=0).tolist()

        of_kinds = mean_recalls(self.sets.selection)
        of_real = mean_recalls(self.sets.real) if self.sets.real else [math.nan, math.nan]
        self._recalls = dict(zip(RECALLS, (*of_kinds, *of_real), strict=True))
        return float(np.mean(of_kinds))

    def on_report(self, record: dpm.StepRecord, progress: dpm.TrainingProgress) -> None:
        """Adds a row, updates the bar, and writes a checkpoint every few minutes."""
        values = _values(record)
        if math.isfinite(record.score):
            values |= {name: value for name, value in self._recalls.items() if math.isfinite(value)}
        measured = {name: f"{value:.7g}" for name, value in values.items()}
        self.run_s = self.earlier_s + record.speed.run_s + record.speed.compile_s
        self._pace_s = record.speed.run_s / record.speed.num_steps if record.speed.num_steps else math.nan
        self._history.append(step=record.step, stage=_stage_name(record.stage), run_s=round(self.run_s, 3), **measured)
        self._bar.set_postfix_str(_summary(record, self._recalls["recall"]), refresh=False)
        self._bar.total = int(progress.state.end)
        self._bar.update(1)
        self._tell_compilation(progress.state)
        if time.perf_counter() - self._last_saved > SAVE_EVERY_S:
            self.save(progress)
            self._last_saved = time.perf_counter()

    def steps_left(self, step: int, *, total_s: float) -> int:
        """Returns the number of steps in the seconds that remain of `total_s`; 0 where the plan stays as it is.

        Where `total_s` is 0, a quarter of the steps that were done before this call remain.
        """
        if total_s == 0:
            first, end = int(self.start.state.step), int(self.start.state.end)
            return min(max(1, math.ceil(first / 4)), end - first) if step == first else 0
        if not math.isfinite(total_s) or math.isnan(self._pace_s):
            return 0
        return max(1, round((total_s - self.run_s) / self._pace_s))

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
        step = int(state.step)
        capacity = layout_capacity(self._settings.layout_at(step, seed=self._seed), self._settings.sampling)
        if step < int(state.end) and capacity not in self._seen:
            self._seen.add(capacity)
            maps = f"maps of {capacity.num_source} and {capacity.num_target} scans"
            self._bar.set_postfix_str(f"{_stage_name(self._settings.stage_at(step))}, compiling {maps}")

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
    total_s: float = math.inf,
) -> dpm.Trained:
    """Returns the result of training, after saving its last state; one process has records.

    Training ends after about `total_s` seconds of steps, compilation and evaluation, those of earlier calls included;
    with 0 it ends after a quarter of the steps that are done.
    """
    if records is None:
        return dpm.train(store, settings, seed=seed, hooks=hooks)
    with records:
        hooks = replace(hooks, evaluate=records.evaluate, on_report=records.on_report)
        hooks = replace(hooks, steps_left=partial(records.steps_left, total_s=total_s))
        trained = dpm.train(store, settings, seed=seed, start=records.start, hooks=hooks)
        records.save(trained.progress)
        return trained


def _stage_name(stage: dpm.CurriculumStage) -> str:
    return f"K={stage.max_group}"


def _values(record: dpm.StepRecord) -> dict[str, Any]:
    values = {**record.report._asdict(), **record.report.terms._asdict(), "score": record.score}
    return {name: float(values[name]) for name in MEASURES if math.isfinite(values[name])}


def _summary(record: dpm.StepRecord, recall: float) -> str:
    values = {**_values(record), **({"recall": recall} if math.isfinite(recall) else {})}
    parts = [f"{name} {values[name]:.3f}" for name in SHOWN if name in values]
    return ", ".join([_stage_name(record.stage), *parts, f"{record.speed.scans_per_s:.1f} scans/s"])
