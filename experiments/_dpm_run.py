"""The drives that a DeepPointMap training reads; the table, the progress bar and the checkpoints that it writes."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import jax
from scipy.spatial import cKDTree
from tqdm import tqdm

from dpmjax.checkpoints import Checkpoints
from dpmjax.deeppointmap import Model, SamplingConfig, ScanStore, TrainingConfig, TrainingHooks, init_training, train
from dpmjax.deeppointmap.curriculum import CurriculumStage
from dpmjax.deeppointmap.inference import EvaluationPairs, evaluate_registration
from dpmjax.deeppointmap.training_loop import StepRecord, Trained, TrainingProgress, begin_training
from dpmjax.io import LidarSequence, list_lidar_sequences, open_lidar_sequence
from dpmjax.simulation import HDL64E, DriveConfig, TownConfig, simulate_lidar_sequence
from experiments._result_files import HistoryFile, read_history
from experiments._run_folder import CHECKPOINTS, HISTORY, RunFolder

LOGGER = logging.getLogger("dpmjax.training")
TOWN = "town"
# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED = 1_000_000
# Seconds between checkpoints; Ctrl-C and the end write one too.
SAVE_EVERY_S = 60.0
SHOWN = ("loss", "overlap_accuracy", "pairing", "offset", "top1_accuracy", "recall")
MEASURES = (*SHOWN, "coarse", "gradient_norm", "learning_rate")
COLUMNS = ("step", "stage", "run_s", *MEASURES)


def town_drive(seed: int, *, length_m: float) -> LidarSequence:
    """Returns a drive through a town: 64 beams, a third of the columns, a scan every two metres."""
    return simulate_lidar_sequence(
        seed,
        TownConfig(route_length_m=length_m),
        driving=DriveConfig(speed_m_s=8.0, rate_hz=4.0),
        sensor=HDL64E.with_azimuths(600),
    )


def open_drives(data: Sequence[str], towns: Sequence[int], town_length_m: float) -> list[LidarSequence]:
    """Returns the drives to train on.

    Raises:
        ValueError: if a path cannot be read or holds no useful drive.
    """
    drives: list[LidarSequence] = []
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            drives += [town_drive(seed, length_m=town_length_m) for seed in towns]
            continue
        names: Sequence[str | None] = list_lidar_sequences(entry) or [None]
        found = [open_lidar_sequence(entry, sequence=name) for name in names]
        reasons = {drive.name: reason for drive in found if (reason := why_useless(drive)) is not None}
        if len(reasons) == len(found):
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for name, reason in reasons.items():
            LOGGER.warning("%s is left out: %s", name, reason)
        drives += [drive for drive in found if drive.name not in reasons]
    return drives


def why_useless(drive: LidarSequence) -> str | None:
    """Returns the reason why nothing can be learned from a drive; None where something can."""
    limits = SamplingConfig()
    if drive.T_world_lidar is None:
        return "no poses; training needs a pose for each scan"
    positions = drive.T_world_lidar[:, :3, 3]
    tree = cKDTree(positions)
    num_near, num_too_near = (tree.count_neighbors(tree, r) for r in (limits.max_distance_m, limits.min_distance_m))
    if num_near == num_too_near:
        found = f"{len(positions)} scans, no two of them {limits.min_distance_m} to {limits.max_distance_m} m apart"
        return f"{found}; training needs such pairs (are the poses in metres?)"
    reason = ""
    for number in range(len(drive)):
        try:
            drive.read_scan(number)
        except ValueError as error:
            reason = reason or str(error)
            continue
        return None
    return f"all {len(drive)} scans are bad; the first, {reason}"


class Records:
    """The table, the progress bar, the checkpoints and the evaluation of a run; one process has them.

    Attributes:
        folder: folder of the run.
        pairs: held-out pairs.
        untrained: the model before the first step.
        start: progress to start from: the latest checkpoint of a resumed run.
        earlier_s: run time of the steps before `start`.
    """

    def __init__(self, folder: RunFolder, settings: TrainingConfig, pairs: EvaluationPairs, *, seed: int) -> None:
        self.folder, self.pairs, self._settings = folder, pairs, settings
        self._checkpoints = Checkpoints(folder / CHECKPOINTS)
        self.start = begin_training(init_training(jax.random.key(seed), settings))
        self.untrained = Model(self.start.state.params, settings.model)
        if folder.is_resumed:
            self.start = self._checkpoints.restore_latest(self.start, fallback=self.start)
        first = int(self.start.state.step)
        self._history = HistoryFile(folder / HISTORY, COLUMNS, keep_until=first if folder.is_resumed else None)
        self.earlier_s = max((float(row["run_s"]) for row in read_history(folder / HISTORY)), default=0.0)
        self._bar = tqdm(total=settings.num_steps, initial=first, desc="train", unit=" steps", dynamic_ncols=True)
        self._last_saved, self._recall = time.perf_counter(), math.nan
        self._seen: set[CurriculumStage | None] = set()
        self._tell_compilation(first)

    def evaluate(self, model: Model) -> float:
        """Returns the recall on the held-out pairs."""
        return evaluate_registration(model, self.pairs).recall.recall

    def on_report(self, record: StepRecord, progress: TrainingProgress) -> None:
        """Adds a row, updates the bar, and writes a checkpoint when it is time."""
        self._recall = record.score if math.isfinite(record.score) else self._recall
        measured = {name: f"{value:.7g}" for name, value in _values(record).items()}
        run_s = round(self.earlier_s + record.speed.run_s, 3)
        self._history.append(step=record.step, stage=_stage_name(record.stage), run_s=run_s, **measured)
        self._bar.set_postfix_str(_summary(record, self._recall), refresh=False)
        self._bar.update(1)
        self._tell_compilation(record.step)
        if time.perf_counter() - self._last_saved > SAVE_EVERY_S:
            self.save(progress)
            self._last_saved = time.perf_counter()

    def save(self, progress: TrainingProgress) -> None:
        """Writes a checkpoint."""
        self._checkpoints.save(int(progress.state.step), progress)

    def _tell_compilation(self, done: int) -> None:
        stage = self._settings.stage_at(done) if done < self._settings.num_steps else None
        if done < self._settings.num_steps and stage not in self._seen:
            self._seen.add(stage)
            self._bar.set_postfix_str(f"compiling {_stage_name(stage)}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self._history.__exit__(*error)
        self._bar.close()


def run_training(
    records: Records | None, store: ScanStore, settings: TrainingConfig, hooks: TrainingHooks, *, seed: int
) -> Trained:
    """Returns the result of training, after saving its last state; one process has records."""
    if records is None:
        return train(store, settings, seed=seed, hooks=hooks)
    with records:
        hooks = replace(hooks, evaluate=records.evaluate, on_report=records.on_report)
        trained = train(store, settings, seed=seed, start=records.start, hooks=hooks)
        records.save(trained.progress)
        return trained


def _stage_name(stage: CurriculumStage | None) -> str:
    return "overlap" if stage is None else f"K={stage.max_group}"


def _values(record: StepRecord) -> dict[str, Any]:
    values = {**record.report._asdict(), **record.report.terms._asdict(), "recall": record.score}
    return {name: float(values[name]) for name in MEASURES if math.isfinite(values[name])}


def _summary(record: StepRecord, recall: float) -> str:
    values = {**_values(record), **({"recall": recall} if math.isfinite(recall) else {})}
    parts = [f"{name} {values[name]:.3f}" for name in SHOWN if name in values]
    return ", ".join([_stage_name(record.stage), *parts, f"{record.speed.scans_per_s:.1f} scans/s"])
