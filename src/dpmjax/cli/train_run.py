"""A DeepPointMap training: its drives, evaluations, table, progress bar and checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.checkpoints import Checkpoints
from dpmjax.cli.run import CHECKPOINTS, HISTORY, Run
from dpmjax.deeppointmap.training.curriculum import Layout, layout_capacity
from dpmjax.sequences import LidarSequence

# Largest number of scans of an evaluation, all drives together.
MAX_EVALUATED_SCANS = 96
OVERLAP_STAGE = "overlap"
BEST_CHECKPOINTS, OVERLAP_CHECKPOINTS = "checkpoints_best", "checkpoints_overlap"
# Seconds between checkpoints; Ctrl-C and the end write one too.
SAVE_EVERY_S = 300.0
SHOWN = ("loss", "pairing", "offset", "top1_accuracy", "score")
MEASURES = (*SHOWN, "coarse", "gradient_norm", "learning_rate")
# Names of the recalls of the pairs that choose the model.
RECALLS = {"near": "recall", "middle": "recall_far"}
OVERLAP_MEASURES = ("overlap_loss", "overlap_accuracy")
# Coefficients of determination of predicted offsets, on the pairs that choose the model; empty without an offset head.
OFFSETS = ("offset_r2_normal", "offset_r2_along", "offset_r2_up")
COLUMNS = ("step", "stage", "run_s", *MEASURES, *RECALLS.values(), *OFFSETS, *OVERLAP_MEASURES)


class Selection(NamedTuple):
    """Pairs that choose the model.

    Attributes:
        pairs: pairs of scans. None if no drive has held-out places; then the last model is kept.
        chosen_by: a name of the pairs, for `metrics.json`.
    """

    pairs: dpm.EvaluationPairs | None
    chosen_by: str


def part_of_drive(source: cli.Source, part: Literal["training", "held_out"]) -> LidarSequence:
    """Opens the held-out places of a drive, or the remaining scans without those near them."""
    drive = source()
    return drive.take(getattr(dpm.split_places(drive), part))


def draw_selection(
    settings: dpm.TrainingConfig,
    num_pairs: int,
    drives: Sequence[cli.Source],
    chosen_by: str,
    *,
    on_wait: Callable[[], object] = lambda: None,
) -> Selection:
    """Draws the pairs that choose the model.

    Args:
        settings: settings of training.
        num_pairs: number of pairs of each kind, all drives together.
        drives: held-out places, or drives of `--validate`.
        chosen_by: a name of the pairs, for `metrics.json`.
        on_wait: called before each drive; an error of it ends the preparation.

    Returns:
        The pairs; none if no drive has any.
    """

    def opened() -> Iterator[LidarSequence]:
        for source in tqdm(drives, desc="prepare evaluation", unit=" drives", dynamic_ncols=True):
            on_wait()
            drive, max_scans = source(), max(2, MAX_EVALUATED_SCANS // len(drives))
            yield drive.take(slice(None, None, -(-len(drive) // max_scans) or 1))

    pairs = dpm.draw_evaluation_pairs(opened(), max(1, num_pairs // len(drives)), settings.model)
    if not pairs.pairs:
        return Selection(None, "the last step: no drive has held-out places")
    return Selection(pairs, chosen_by)


class Records:
    """The table, the progress bar, the checkpoints and the evaluation of a run, in the first process only.

    Attributes:
        run: the run; its folder gets the files.
        selection: pairs that choose the model.
        untrained: the model before the first step.
        start: progress to start from: the latest checkpoint of a resumed run.
        earlier_s: run time of the steps of earlier calls of `train`.
        overlap_start: state of the second stage to start from; None for its beginning.
        takes_last: True keeps the last model, as published, instead of the best one.
    """

    def __init__(
        self,
        run: Run,
        settings: dpm.TrainingConfig,
        selection: Selection,
        *,
        seed: int,
        weights: dpm.Model | None = None,
        takes_last: bool = False,
    ) -> None:
        self.run, self.selection, self._settings = run, selection, settings
        self._overlap_checkpoints = Checkpoints(run / OVERLAP_CHECKPOINTS)
        self._checkpoints, self._best = Checkpoints(run / CHECKPOINTS), Checkpoints(run / BEST_CHECKPOINTS)
        begun = dpm.begin_training(settings, seed=seed, start=weights)
        self.takes_last = takes_last
        trained = () if weights is None else weights.config.trained
        config = replace(settings.model, trained=trained)
        if weights is not None and "registration" not in settings.stages:
            config = weights.config  # a calibration stays where the head alone is trained
        self.untrained = dpm.Model(begun.state.params, config)
        self.start = self._restored(begun)
        self.overlap_start = self._overlap_checkpoints.restore_latest(dpm.init_overlap(self.untrained), fallback=None)
        first = int(self.start.state.step)
        if self.overlap_start is not None:
            first += int(self.overlap_start.step)
        earlier = run.continue_table(HISTORY, until=first)
        self.earlier_s = max((float(row["run_s"]) for row in earlier), default=0.0)
        total = int(self.start.state.end) if "registration" in settings.stages else 0
        self._bar = tqdm(total=total, initial=first, desc="train", unit=" steps", dynamic_ncols=True)
        self._last_saved, self._recalls = time.perf_counter(), dict.fromkeys((*RECALLS.values(), *OFFSETS), math.nan)
        self.run_s, self._pace_s = self.earlier_s, math.nan
        self.seed, self._seen = seed, set[Layout]()
        if total:
            self._tell_compilation(self.start.state)

    def evaluate(self, model: dpm.Model) -> float:
        """Returns the mean recall of the pairs of scans that choose the model, and measures their offsets."""
        pairs = self.selection.pairs
        if pairs is None:
            return math.nan
        found = dpm.evaluate_registration(model, pairs)
        self._recalls |= {RECALLS[band]: recall.recall for band, recall in found.recalls.items()}
        self._recalls |= dict(zip(OFFSETS, found.offset_r2.tolist(), strict=True))
        return float(np.mean([recall.recall for recall in found.recalls.values()]))

    def on_report(self, record: dpm.StepRecord, progress: dpm.TrainingProgress) -> None:
        """Adds a row, updates the bar, and writes a checkpoint every few minutes."""
        values = _values(record)
        if math.isfinite(record.score):
            values |= {name: value for name, value in self._recalls.items() if math.isfinite(value)}
        measured = {name: f"{value:.7g}" for name, value in values.items()}
        self.run_s = self.earlier_s + record.speed.run_s + record.speed.compile_s
        self._pace_s = record.speed.run_s / record.speed.num_steps if record.speed.num_steps else math.nan
        self._append(record.step, _stage_name(record.stage), measured)
        self._bar.set_postfix_str(_summary(record, self._recalls["recall"]), refresh=False)
        self._bar.total = int(progress.state.end)
        self._bar.update(1)
        self._tell_compilation(progress.state)
        if time.perf_counter() - self._last_saved > SAVE_EVERY_S:
            self.save(progress)
            self._last_saved = time.perf_counter()

    def _append(self, step: int, stage: str, measured: dict[str, str]) -> None:
        row = {"step": step, "stage": stage, "run_s": round(self.run_s, 3), **measured}
        self.run.append_row(HISTORY, **dict.fromkeys(COLUMNS, "") | row)

    def steps_left(self, step: int, *, total_s: float) -> int:
        """Returns the number of steps in the seconds that remain of `total_s`; 0 does not change the plan.

        If `total_s` is 0, training ends after a quarter of the steps that were done before this call.
        """
        if total_s == 0:
            first, end = int(self.start.state.step), int(self.start.state.end)
            return min(max(1, math.ceil(first / 4)), end - first) if step == first else 0
        if not math.isfinite(total_s) or math.isnan(self._pace_s):
            return 0
        return max(1, round((total_s - self.run_s) / self._pace_s))

    def train_head(self, trained: dpm.Trained, store: dpm.ScanStore, stop: Callable[[], int], seed: int) -> dpm.Trained:
        """Trains the overlap head, or continues; with rows after those of the first stage, and its own checkpoints."""
        before = int(trained.progress.state.step)
        earlier_s, begun = self.run_s, time.perf_counter()
        first = 0 if self.overlap_start is None else int(self.overlap_start.step)
        total = self._settings.overlap.num_steps(len(store.table))
        with tqdm(total=total, initial=first, desc="train overlap", unit=" steps", dynamic_ncols=True) as bar:

            def on_report(record: dpm.OverlapRecord, state: dpm.OverlapState) -> None:
                self.run_s = earlier_s + time.perf_counter() - begun
                values = {"overlap_loss": record.loss, "overlap_accuracy": record.accuracy}
                values |= {"learning_rate": record.learning_rate}
                measured = {name: f"{value:.7g}" for name, value in values.items()}
                self._append(before + record.step, OVERLAP_STAGE, measured)
                bar.set_postfix_str(f"loss {record.loss:.3f}, right {record.accuracy:.2f}", refresh=False)
                bar.update(1)
                if time.perf_counter() - self._last_saved > SAVE_EVERY_S:
                    self._overlap_checkpoints.save(record.step, state)
                    self._last_saved = time.perf_counter()

            hooks: dict[str, Any] = {"on_report": on_report, "stop": stop, "start": self.overlap_start}
            model, state = dpm.train_overlap(store, trained.model, self._settings, seed=seed, **hooks)
        self._overlap_checkpoints.save(int(state.step), state)
        stopped_by = 0 if int(state.step) >= total else stop()
        return trained._replace(model=model, overlap=state, stopped_by=stopped_by)

    def save(self, progress: dpm.TrainingProgress) -> None:
        """Writes a checkpoint, and the best parameters if they have changed since the last one."""
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
        capacity = layout_capacity(self._settings.layout_at(step, seed=self.seed), self._settings.sampling)
        if step < int(state.end) and capacity not in self._seen:
            self._seen.add(capacity)
            maps = f"maps of {capacity.num_source} and {capacity.num_target} scans"
            self._bar.set_postfix_str(f"{_stage_name(self._settings.stage_at(step))}, compiling {maps}")

    def __enter__(self) -> Records:
        return self

    def __exit__(self, *error: Any) -> None:
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
    """Returns the result of both stages, and saves their last states; only the process with records trains the head.

    Training ends after about `total_s` seconds of steps, compilation and evaluation, with those of earlier calls. If
    `total_s` is 0, it ends after a quarter of the steps that were done before.
    """
    trains_first, trains_head = "registration" in settings.stages, "overlap" in settings.stages
    settings = replace(settings, stages=("registration",))
    if records is None:
        return dpm.train(store, settings, seed=seed, hooks=hooks)
    with records:
        stop = hooks.stop
        if not trains_first:
            return records.train_head(dpm.Trained(records.untrained, records.start, 0, dpm.Speed()), store, stop, seed)
        if records.selection.pairs is not None:
            hooks = replace(hooks, evaluate=records.evaluate)
        hooks = replace(hooks, on_report=records.on_report)
        hooks = replace(hooks, steps_left=partial(records.steps_left, total_s=total_s))
        trained = dpm.train(store, settings, seed=seed, start=records.start, hooks=hooks)
        records.save(trained.progress)
        if records.takes_last:
            trained = trained._replace(model=with_params(trained.model, trained.progress.state.params))
        return trained if trained.stopped_by or not trains_head else records.train_head(trained, store, stop, seed)


def with_params(model: dpm.Model, params: Any) -> dpm.Model:
    """Returns the model with the parameters of another step, on the device."""
    return model.replace(params=jax.tree.map(lambda leaf: jax.numpy.asarray(np.asarray(leaf)), params))


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
