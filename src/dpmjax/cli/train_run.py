"""A DeepPointMap training in its folder: prepared drives, evaluations, table, progress bar and checkpoints.

All processors share the preparation of the scans, even of one long drive.
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli
from dpmjax import deeppointmap as dpm
from dpmjax.checkpoints import Checkpoints
from dpmjax.cli.run import CHECKPOINTS, HISTORY, Run
from dpmjax.sequences import LidarSequence
from dpmjax.types import Poses

# Scans of a drive that a processor prepares at a time; with more the bar stands still, with fewer the drive is opened
# more often.
NUM_AT_ONCE = 16
# Largest number of scans of an evaluation, and number of its pairs of each kind, all drives together.
MAX_EVALUATED_SCANS, NUM_HELD_OUT_PAIRS = 96, 32
# Pairs of scans, near and far, which choose the model, and the names of their recalls.
RECALLS = {"near": "recall", "middle": "recall_far"}
OVERLAP_CHECKPOINTS = "checkpoints_overlap"
# Seconds between checkpoints; Ctrl-C and the end write one too.
SAVE_EVERY_S = 300.0
MEASURES = ("loss", "pairing", "offset", "top1_accuracy", "score", "coarse", "gradient_norm", "learning_rate")
# Coefficients of determination of predicted offsets, on the pairs that choose the model; empty without an offset head.
OFFSETS = ("offset_r2_normal", "offset_r2_along", "offset_r2_up")
COLUMNS = ("step", "stage", "run_s", *MEASURES, *RECALLS.values(), *OFFSETS, "overlap_loss", "overlap_accuracy")


class PlannedDrive(NamedTuple):
    """A drive before its preparation.

    Attributes:
        source: opens the drive.
        T_world_lidar: true poses of its scans, metres.
        path: file of its prepared scans.
        found: the prepared drive if the file exists already; None otherwise.
    """

    source: cli.Source
    T_world_lidar: Poses
    path: Path
    found: dpm.PreparedDrive | None


def part_of_drive(source: cli.Source, part: Literal["training", "held_out"]) -> LidarSequence:
    """Opens the held-out places of a drive, or the remaining scans without those near them."""
    drive = source()
    return drive.take(getattr(dpm.split_places(drive), part))


def prepare_sources(
    sources: Sequence[cli.Source], settings: dpm.TrainingConfig, folder: Path, *, seed: int
) -> list[dpm.PreparedDrive]:
    """Prepares all drives on all processors and keeps them in a folder for later runs.

    Args:
        sources: the drives.
        settings: settings of training.
        folder: folder of prepared scans.
        seed: seed of the variants.

    Returns:
        The drives, in order.

    Raises:
        ValueError: if the prepared scans do not fit on the disk, or if a drive cannot be read.
    """
    if settings.num_variants == 0:
        print("each scan is prepared anew at each use; nothing is kept on disk")
        return [dpm.prepare_drive(source(), settings) for source in sources]
    with _workers() as pool:
        opened = pool.map(partial(_plan, settings=settings, folder=folder, seed=seed), sources)
        plans = list(tqdm(opened, "open drives", len(sources), unit=" drives", dynamic_ncols=True))
        # The same drive may be given twice.
        missing = {plan.path: plan for plan in plans if plan.found is None}
        num_scans = sum(len(plan.T_world_lidar) for plan in missing.values())
        check_space(num_scans, settings, folder)
        work = partial(_prepare, settings=settings, seed=seed)
        # All parts are begun here; each result is forgotten when it was written.
        parts = {path: pool.map(work, *_parts(plan)) for path, plan in missing.items()}
        with tqdm(desc="prepare scans", total=num_scans, unit=" scans", dynamic_ncols=True) as bar:

            def scans_of(path: Path) -> Iterator[dpm.PreparedScan]:
                for part in parts[path]:
                    yield from part
                    bar.update(len(part))

            made = {
                path: dpm.store_scans(path, plan.T_world_lidar, scans_of(path), settings)
                for path, plan in missing.items()
            }
    return [plan.found or made[plan.path] for plan in plans]


def check_space(num_scans: int, settings: dpm.TrainingConfig, folder: Path) -> None:
    """Prints the size of the prepared scans; raises a ValueError if the disk has less free space."""
    each = dpm.stored_bytes(settings)
    needed = num_scans * each
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    scans, free_text = f"{num_scans} scans of {each / 1e6:.2f} MB", f"{free / 1e9:.1f} GB are free"
    if needed > free:
        advice = f"--variants 1 needs {needed / settings.num_variants / 1e9:.1f} GB, --variants 0 nothing"
        raise ValueError(f"--cache {folder}: {scans} need {needed / 1e9:.1f} GB, {free_text}; {advice}")
    if num_scans > 0:
        print(f"prepares {scans}: {needed / 1e9:.1f} GB in {folder}, {free_text}")


@contextmanager
def _workers() -> Iterator[ProcessPoolExecutor]:
    """Yields processes, which are gone after an error."""
    # A fresh interpreter: a fork of a process that runs JAX may hang.
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), initializer=_begin_worker) as pool:
        try:
            yield pool
        except BaseException:
            processes = active_children()
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()
            raise


def _begin_worker() -> None:
    # The device belongs to the process that trains, and so does the answer to Ctrl-C.
    jax.config.update("jax_platforms", "cpu")
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _plan(source: cli.Source, settings: dpm.TrainingConfig, folder: Path, seed: int) -> PlannedDrive:
    drive = source()
    if drive.T_world_lidar is None:
        raise ValueError(f"{drive.name}: expected a true pose for each scan, got a drive without poses")
    path = dpm.prepared_path(drive, settings, folder, seed)
    return PlannedDrive(source, drive.T_world_lidar, path, dpm.find_prepared(path, drive.T_world_lidar))


def _parts(plan: PlannedDrive) -> tuple[list[cli.Source], list[range]]:
    num = len(plan.T_world_lidar)
    rows = [range(first, min(first + NUM_AT_ONCE, num)) for first in range(0, num, NUM_AT_ONCE)]
    return [plan.source] * len(rows), rows


def _prepare(source: cli.Source, numbers: range, settings: dpm.TrainingConfig, seed: int) -> list[dpm.PreparedScan]:
    return list(dpm.prepare_variants(source(), numbers, settings, seed))


class Selection(NamedTuple):
    """Pairs that choose the model.

    Attributes:
        pairs: pairs of scans. None if no drive has held-out places; then the last model is kept.
        chosen_by: a name of the pairs, for `metrics.json`.
    """

    pairs: dpm.EvaluationPairs | None
    chosen_by: str


def draw_selection(settings: dpm.TrainingConfig, drives: Sequence[cli.Source], chosen_by: str) -> Selection:
    """Draws the pairs that choose the model.

    Args:
        settings: settings of training.
        drives: held-out places, or drives of `--validate`.
        chosen_by: a name of the pairs, for `metrics.json`.

    Returns:
        The pairs; none if no drive has any.
    """

    def opened() -> Iterator[LidarSequence]:
        for source in tqdm(drives, desc="prepare evaluation", unit=" drives", dynamic_ncols=True):
            drive, max_scans = source(), max(2, MAX_EVALUATED_SCANS // len(drives))
            yield drive.take(slice(None, None, -(-len(drive) // max_scans) or 1))

    num_pairs = max(1, NUM_HELD_OUT_PAIRS // len(drives))
    pairs = dpm.draw_evaluation_pairs(opened(), num_pairs, settings.model)
    return (
        Selection(pairs, chosen_by) if pairs.pairs else Selection(None, "the last step: no drive has held-out places")
    )


class Records:
    """The table, the progress bar, the checkpoints and the evaluation of a run, in the first process only.

    Attributes:
        run: the run; its folder gets the files.
        selection: pairs that choose the model.
        seed: seed of the training.
        takes_last: True keeps the last model, as published, instead of the best one.
        untrained: the model before the first step.
        start: progress to start from: the latest checkpoint of a resumed run.
        overlap_start: state of the second stage to start from; None for its beginning.
        run_s: run time of the steps, with those of earlier processes.
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
        self.seed, self.takes_last = seed, takes_last
        self._checkpoints, self._of_overlap = Checkpoints(run / CHECKPOINTS), Checkpoints(run / OVERLAP_CHECKPOINTS)
        begun, config = dpm.begin_training(settings, seed=seed, start=weights), settings.model
        if weights is not None and "registration" not in settings.stages:
            config = weights.config  # a calibration stays where the head alone is trained
        elif weights is not None:
            config = replace(config, trained=weights.config.trained)
        self.untrained = dpm.Model(begun.state.params, config)
        self.start = self._checkpoints.restore_latest(begun, fallback=begun)
        self.overlap_start = self._of_overlap.restore_latest(dpm.init_overlap(self.untrained), fallback=None)
        num_done = int(self.start.state.step) + (0 if self.overlap_start is None else int(self.overlap_start.step))
        earlier = run.continue_table(HISTORY, until=num_done)
        self.run_s = self._earlier_s = max((float(row["run_s"]) for row in earlier), default=0.0)
        total = int(self.start.state.end) if "registration" in settings.stages else 0
        self._bar = tqdm(total=total, initial=num_done, desc="train", unit=" steps", dynamic_ncols=True)
        self._saved_at, self._pace_s, self._recalls = time.perf_counter(), math.nan, dict[str, float]()

    def evaluate(self, model: dpm.Model) -> float:
        """Returns the mean recall of the pairs that choose the model, and measures their offsets."""
        assert self.selection.pairs is not None
        found = dpm.evaluate_registration(model, self.selection.pairs)
        self._recalls = {RECALLS[band]: recall.recall for band, recall in found.recalls.items()}
        self._recalls |= dict(zip(OFFSETS, found.offset_r2.tolist(), strict=True))
        return float(np.mean([recall.recall for recall in found.recalls.values()]))

    def on_report(self, record: dpm.StepRecord, progress: dpm.TrainingProgress) -> None:
        """Adds a row, updates the bar, and writes a checkpoint every few minutes."""
        speed, values = record.speed, {**record.report._asdict(), **record.report.terms._asdict()}
        values = {name: float(values[name]) for name in MEASURES if name in values} | {"score": record.score}
        if values["offset"] == 0:  # no offset head is trained
            del values["offset"]
        values |= self._recalls if math.isfinite(record.score) else {}
        self.run_s = self._earlier_s + speed.run_s + speed.compile_s
        self._pace_s = speed.run_s / speed.num_steps if speed.num_steps else math.nan
        self._bar.total = int(progress.state.end)
        shown = f"loss {values['loss']:.3f}, {speed.scans_per_s:.1f} scans/s"
        self._add_row(self._bar, record.step, f"K={record.stage.max_group}", values, shown)
        if time.perf_counter() - self._saved_at > SAVE_EVERY_S:
            self.save(progress)

    def _add_row(self, bar: tqdm[Any], step: int, stage: str, values: dict[str, float], shown: str) -> None:
        measured = {name: f"{value:.7g}" for name, value in values.items() if math.isfinite(value)}
        row = {"step": step, "stage": stage, "run_s": round(self.run_s, 3), **measured}
        self.run.append_row(HISTORY, **dict.fromkeys(COLUMNS, "") | row)
        bar.set_postfix_str(f"{stage}, {shown}", refresh=False)
        bar.update(1)

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

    def train_head(self, trained: dpm.Trained, store: dpm.ScanStore, stop: Callable[[], int]) -> dpm.Trained:
        """Trains the overlap head, or continues; with rows after those of the first stage, and its own checkpoints."""
        num_before, earlier_s, begun = int(trained.progress.state.step), self.run_s, time.perf_counter()
        first = 0 if self.overlap_start is None else int(self.overlap_start.step)
        total = self._settings.overlap.num_steps(len(store.table))
        with tqdm(total=total, initial=first, desc="train overlap", unit=" steps", dynamic_ncols=True) as bar:

            def on_report(record: dpm.OverlapRecord, state: dpm.OverlapState) -> None:
                self.run_s = earlier_s + time.perf_counter() - begun
                values = {"overlap_loss": record.loss, "overlap_accuracy": record.accuracy}
                values |= {"learning_rate": record.learning_rate}
                self._add_row(bar, num_before + record.step, "overlap", values, f"loss {record.loss:.3f}")
                if time.perf_counter() - self._saved_at > SAVE_EVERY_S:
                    self._of_overlap.save(record.step, state)
                    self._saved_at = time.perf_counter()

            hooks, start = dpm.OverlapHooks(on_report, stop), self.overlap_start
            model, state = dpm.train_overlap(
                store, trained.model, self._settings, seed=self.seed, start=start, hooks=hooks
            )
        self._of_overlap.save(int(state.step), state)
        stopped_by = 0 if int(state.step) >= total else stop()
        return trained._replace(model=model, overlap=state, stopped_by=stopped_by)

    def save(self, progress: dpm.TrainingProgress) -> None:
        """Writes a checkpoint."""
        self._checkpoints.save(int(progress.state.step), progress)
        self._saved_at = time.perf_counter()

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
        trained = dpm.Trained(records.untrained, records.start, 0, dpm.Speed())
        if trains_first:
            hooks = replace(
                hooks,
                evaluate=None if records.selection.pairs is None else records.evaluate,
                on_report=records.on_report,
                steps_left=partial(records.steps_left, total_s=total_s),
            )
            trained = dpm.train(store, settings, seed=seed, start=records.start, hooks=hooks)
            records.save(trained.progress)
            if records.takes_last:
                params = jax.tree.map(lambda leaf: jax.numpy.asarray(np.asarray(leaf)), trained.progress.state.params)
                trained = trained._replace(model=trained.model.replace(params=params))
        return trained if trained.stopped_by or not trains_head else records.train_head(trained, store, hooks.stop)
