"""The drives that a DeepPointMap training reads; the table, the progress bar and the checkpoints that it writes."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Self

import jax
from scipy.spatial import cKDTree
from tqdm import tqdm

from dpmjax.checkpoints import Checkpoints
from dpmjax.deeppointmap import Model, SamplingConfig, ScanStore, TrainingConfig, TrainingHooks, init_training, train
from dpmjax.deeppointmap.curriculum import CurriculumStage
from dpmjax.deeppointmap.evaluation import EvaluationPairs, evaluate_registration
from dpmjax.deeppointmap.training_loop import StepRecord, Trained, TrainingProgress, begin_training
from dpmjax.io import LidarSequence, list_lidar_sequences, open_lidar_sequence
from dpmjax.simulation import HDL64E, DriveConfig, TownConfig, simulate_lidar_sequence
from experiments._history import HistoryFile, read_history
from experiments._run_folder import CHECKPOINTS, HISTORY, RunFolder

LOGGER = logging.getLogger("dpmjax.training")
TOWN = "town"
# Far from the seeds of training towns, which count up from the seed of the run.
HELD_OUT_SEED = 1_000_000
# Seconds between checkpoints; Ctrl-C and the end write one too.
SAVE_EVERY_S = 60.0
TERMS = ("pairing", "coarse", "offset", "top1_accuracy")
REPORTED = ("overlap_accuracy", "gradient_norm", "learning_rate")
COLUMNS = ("step", "stage", "run_s", "loss", *TERMS, *REPORTED, "recall")


def town_drive(seed: int, *, length_m: float) -> LidarSequence:
    """Returns a drive through a town: 64 beams, a third of the columns, a scan every two metres."""
    return simulate_lidar_sequence(
        seed,
        TownConfig(route_length_m=length_m),
        driving=DriveConfig(speed_m_s=8.0, rate_hz=4.0),
        sensor=HDL64E.with_azimuths(600),
    )


def open_drives(data: Sequence[str], *, num_towns: int, town_length_m: float, seed: int) -> list[LidarSequence]:
    """Returns the drives to train on.

    Raises:
        ValueError: if a path cannot be read or holds no useful drive.
    """
    drives: list[LidarSequence] = []
    for entry in data:
        if entry == TOWN and not Path(entry).exists():
            drives += [town_drive(seed + number, length_m=town_length_m) for number in range(num_towns)]
            continue
        names: Sequence[str | None] = list_lidar_sequences(entry) or [None]
        found = [open_lidar_sequence(entry, sequence=name) for name in names]
        reasons = {drive.name: why_useless(drive) for drive in found}
        useful = [drive for drive in found if reasons[drive.name] is None]
        if not useful:
            raise ValueError("; ".join(f"{entry}: {reason}" for reason in dict.fromkeys(reasons.values())))
        for drive in found:
            if reasons[drive.name] is not None:
                LOGGER.warning("%s is left out: %s", drive.name, reasons[drive.name])
        drives += useful
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
        self.earlier_s = _earlier_seconds(folder, first)
        self._history = HistoryFile(folder / HISTORY, COLUMNS, keep_until=first if folder.is_resumed else None)
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
        self._history.append(**_row(record, self.earlier_s + record.run_s))
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
    records: Records | None,
    store: ScanStore,
    settings: TrainingConfig,
    *,
    seed: int,
    recall_every: int,
    stop: Callable[[], int],
) -> Trained:
    """Returns the result of training, after saving its last state; one process has records."""
    with records or nullcontext():
        if records is None:
            return train(store, settings, seed=seed, hooks=TrainingHooks(evaluate_every=recall_every, stop=stop))
        hooks = TrainingHooks(records.evaluate, recall_every, records.on_report, stop)
        trained = train(store, settings, seed=seed, start=records.start, hooks=hooks)
        records.save(trained.progress)
        return trained


def _stage_name(stage: CurriculumStage | None) -> str:
    return "overlap" if stage is None else f"K={stage.max_group}"


def _row(record: StepRecord, run_s: float) -> dict[str, Any]:
    report = record.report
    values = {"loss": report.loss, "recall": record.score}
    values |= {name: getattr(report.terms, name) for name in TERMS} | {name: getattr(report, name) for name in REPORTED}
    known = {name: f"{float(value):.7g}" for name, value in values.items() if math.isfinite(value)}
    return {"step": record.step, "stage": _stage_name(record.stage), "run_s": round(run_s, 3), **known}


def _summary(record: StepRecord, recall: float) -> str:
    report = record.report
    values = {
        "loss": report.loss,
        "accuracy": report.overlap_accuracy,
        "pairing": report.terms.pairing,
        "offset": report.terms.offset,
        "top-1": report.terms.top1_accuracy,
        "recall": recall,
    }
    parts = [f"{name} {float(value):.3f}" for name, value in values.items() if math.isfinite(value)]
    return ", ".join([_stage_name(record.stage), *parts, f"{record.scans_per_s:.1f} scans/s"])


def _earlier_seconds(folder: RunFolder, step: int) -> float:
    if not folder.is_resumed or not (folder / HISTORY).exists():
        return 0.0
    return max((float(row["run_s"]) for row in read_history(folder / HISTORY) if int(row["step"]) <= step), default=0.0)
