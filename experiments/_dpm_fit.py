"""The loop around the step of DeepPointMap's training: batches ahead, step, record, measure, save, stop, resume."""

from __future__ import annotations

import math
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from tqdm import tqdm

from experiments._command import StopFlag
from experiments._history import HistoryFile, read_history
from experiments._processes import from_first, together
from experiments._run_folder import CHECKPOINTS, HISTORY, RunFolder

if TYPE_CHECKING:
    from dpmjax.deeppointmap import Model, TrainingConfig, TrainingState
    from experiments._dpm_data import ScanStore
    from experiments._dpm_progress import Progress
    from experiments._dpm_recall import Examination, Examined, PairedScans

COLUMNS = ("step", "stage", "run_s", "loss", "pairing", "coarse", "offset", "top1_accuracy", "overlap_accuracy")
COLUMNS += ("gradient_norm", "learning_rate", "recall")
# A checkpoint so often; Ctrl-C and the end write one too.
_SAVE_EVERY_S = 60.0


class TrainingLostError(ArithmeticError):
    """The loss is no number any more."""


@dataclass(frozen=True)
class TrainRun:
    """What the training hands on.

    Attributes:
        model: the best one by recall, of those measured; where none was, that of the last step.
        untrained: as it was at the beginning.
        examination: the held-out pairs.
        examined: what the model makes of them.
        steps: steps done in all.
        best_step: after how many steps the model had its best recall; None where it was never measured.
        run_s: seconds of stepping, compile time apart; with those before a resume.
        compile_s: seconds of the first call of each stage, this time.
        scans_per_s: that the steps of this time took in.
    """

    model: Model
    untrained: Model
    examination: Examination
    examined: Examined
    steps: int
    best_step: int | None
    run_s: float
    compile_s: float
    scans_per_s: float


def run_training(
    folder: RunFolder | None,
    store: ScanStore,
    config: TrainingConfig,
    paired: PairedScans | None,
    *,
    seed: int,
    recall_every: int,
    stop: StopFlag,
) -> TrainRun | None:
    """Trains, or continues where the checkpoints of the folder end.

    Of several processes (`experiments._processes`) each calls this with the same arguments; the first one alone writes
    and measures.

    Args:
        folder: of the run; gets `metrics.csv` and checkpoints. None in all processes but the first.
        store: the scans.
        config: of training.
        paired: held-out pairs. None in all processes but the first.
        seed: of the run.
        recall_every: steps from one measurement of recall to the next.
        stop: asked between steps.

    Returns:
        The run; None in all processes but the first.

    Raises:
        TrainingLostError: the loss is not finite.
        OtherProcessError: another process failed.
    """
    import jax

    from dpmjax import deeppointmap as dpm
    from experiments._dpm_data import SampleMaker, made_ahead
    from experiments._dpm_progress import before_step

    state = dpm.init(jax.random.key(seed), config)
    untrained = dpm.model_of(state, config)
    with together():
        records = None if folder is None or paired is None else _Records(folder, paired, untrained)
        progress = _start(state, records)
    mesh, num_local = dpm.device_mesh(), jax.local_device_count()
    progress = dpm.replicate(from_first(progress), mesh)
    first = int(progress.state.step)
    step = dpm.make_step(config, mesh if jax.device_count() > 1 else None)
    maker = SampleMaker(store, config, seed=seed, num_samples=num_local, first_sample=jax.process_index() * num_local)
    scans_a_step = config.sampling.num_scans * jax.device_count()
    clock = _Clock(0.0 if records is None else records.begin(first, config))
    seen: set[Any] = set()
    with records or nullcontext(), made_ahead(maker, first, config.num_steps) as batches:
        begun = time.perf_counter()
        with together(stop):
            batch = next(batches, None)
        waited_s = time.perf_counter() - begun
        while batch is not None and not stop.is_requested:
            progress = before_step(progress, config)
            number = int(progress.state.step)
            stage = config.stage_at(number)
            if records is not None and stage not in seen:
                records.bar.set_postfix_str(f"compiling {_stage_name(stage)}")
            begun = time.perf_counter()
            state, report = step(progress.state, dpm.shard_batch(batch, mesh))
            report, progress = jax.device_get(report), replace(progress, state=state)
            clock.add(waited_s + time.perf_counter() - begun, is_compiling=stage not in seen)
            seen.add(stage)
            if not math.isfinite(report.loss):
                raise TrainingLostError(f"the loss of step {number + 1} is {report.loss}; --resume goes on before it")
            progress, recall = _measure_when_due(progress, stage, records, config, recall_every)
            with together(stop):
                if records is not None:
                    records.write(number + 1, stage, clock.run_s, report, recall, clock.rate * scans_a_step, progress)
                begun = time.perf_counter()
                batch = next(batches, None)
                waited_s = time.perf_counter() - begun
    maker.close()
    return None if records is None else _finish(records, progress, config, untrained, clock, scans_a_step)


def _start(state: TrainingState, records: _Records | None) -> Progress:
    from experiments._dpm_progress import begin

    progress = begin(state)
    if records is None or not records.folder.is_resumed:
        return progress
    return records.checkpoints.restore_latest(progress, fallback=progress)


def _measure_when_due(
    progress: Progress, stage: Any, records: _Records | None, config: TrainingConfig, recall_every: int
) -> tuple[Progress, float]:
    """Progress and recall after a step of registration, where it is time to measure; NaN elsewhere."""
    from dpmjax import deeppointmap as dpm
    from experiments._dpm_progress import after_measurement

    done = int(progress.state.step)
    if stage is None or (done % recall_every and done != config.registration_steps):
        return progress, math.nan
    with together():
        recall = 0.0 if records is None else records.examine(dpm.model_of(progress.state, config)).recall.recall
    return after_measurement(progress, float(from_first(np.float32(recall)))), recall


def _finish(
    records: _Records,
    progress: Progress,
    config: TrainingConfig,
    untrained: Model,
    clock: _Clock,
    scans_a_step: int,
) -> TrainRun:
    """Saves, and examines the best model."""
    from dpmjax import deeppointmap as dpm
    from experiments._dpm_progress import params_to_use

    records.save(progress)
    model = _local(dpm.Model(params_to_use(progress, config), config.model))
    return TrainRun(
        model,
        untrained,
        records.examination,
        records.examine(model),
        steps=int(progress.state.step),
        best_step=int(progress.best_step) or None,
        run_s=clock.run_s,
        compile_s=clock.compile_s,
        scans_per_s=clock.rate * scans_a_step,
    )


class _Records:
    """All that one process does for all: the table, the bar, checkpoints, and the examination.

    Args:
        folder: of the run.
        paired: held-out pairs.
        model: any one of the configuration.
    """

    def __init__(self, folder: RunFolder, paired: PairedScans, model: Model) -> None:
        from experiments._checkpoint import Checkpoints
        from experiments._dpm_recall import prepare

        self.folder = folder
        self.checkpoints = Checkpoints(Path(folder.path) / CHECKPOINTS)
        self.examination = prepare(model, paired)
        self._recall = math.nan

    def begin(self, first: int, config: TrainingConfig) -> float:
        """Opens table and bar for the steps from `first` on; returns the seconds that those before took."""
        keep_until = first if self.folder.is_resumed else None
        earlier_s = _earlier_seconds(self.folder, first)
        self._history = HistoryFile(self.folder / HISTORY, COLUMNS, keep_until=keep_until)
        self.bar = tqdm(total=config.num_steps, initial=first, desc="train", unit=" steps", dynamic_ncols=True)
        self._last_saved = time.perf_counter()
        return earlier_s

    def examine(self, model: Model) -> Examined:
        """What the model makes of the held-out pairs."""
        from experiments._dpm_recall import examine

        return examine(_local(model), self.examination)

    def write(
        self, step: int, stage: Any, run_s: float, report: Any, recall: float, scans_per_s: float, progress: Progress
    ) -> None:
        """A row, the bar, and now and then a checkpoint."""
        self._recall = recall if math.isfinite(recall) else self._recall
        self._history.append(**_row(step, _stage_name(stage), run_s, report, recall))
        _tell(self.bar, stage, report, self._recall, scans_per_s)
        if time.perf_counter() - self._last_saved > _SAVE_EVERY_S:
            self.save(progress)
            self._last_saved = time.perf_counter()

    def save(self, progress: Progress) -> None:
        """A checkpoint."""
        self.checkpoints.save(int(progress.state.step), progress)

    def __enter__(self) -> Self:
        self._history.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._history.__exit__(*error)
        self.bar.close()


class _Clock:
    """Seconds of stepping and of compiling, apart."""

    def __init__(self, earlier_s: float) -> None:
        self.run_s, self.compile_s = earlier_s, 0.0
        self._here_s, self._num = 0.0, 0

    def add(self, seconds: float, *, is_compiling: bool) -> None:
        if is_compiling:
            self.compile_s += seconds
            return
        self.run_s += seconds
        self._here_s += seconds
        self._num += 1

    @property
    def rate(self) -> float:
        """Steps a second."""
        return self._num / self._here_s if self._here_s > 0 else 0.0


def _local(tree: Any) -> Any:
    """What every device holds alike, as arrays of one device."""
    import jax

    return jax.tree.map(lambda x: jax.numpy.asarray(np.asarray(x)), tree)


def _stage_name(stage: Any) -> str:
    return "overlap" if stage is None else f"K={stage.max_group}"


def _row(step: int, stage: str, run_s: float, report: Any, recall: float) -> dict[str, Any]:
    values = {
        "loss": report.loss,
        "pairing": report.terms.pairing,
        "coarse": report.terms.coarse,
        "offset": report.terms.offset,
        "top1_accuracy": report.terms.top1_accuracy,
        "overlap_accuracy": report.overlap_accuracy,
        "gradient_norm": report.gradient_norm,
        "learning_rate": report.learning_rate,
        "recall": recall,
    }
    known = {name: f"{float(value):.7g}" for name, value in values.items() if math.isfinite(value)}
    return {"step": step, "stage": stage, "run_s": round(run_s, 3), **known}


def _tell(progress: tqdm, stage: Any, report: Any, recall: float, scans_per_s: float) -> None:
    parts = [_stage_name(stage), f"loss {float(report.loss):.3f}"]
    if stage is None:
        parts.append(f"accuracy {float(report.overlap_accuracy):.2f}")
    else:
        parts += [f"pairing {float(report.terms.pairing):.3f}", f"offset {float(report.terms.offset):.3f}"]
        parts.append(f"top-1 {float(report.terms.top1_accuracy):.2f}")
    if math.isfinite(recall):
        parts.append(f"recall {recall:.2f}")
    progress.set_postfix_str(", ".join([*parts, f"{scans_per_s:.1f} scans/s"]), refresh=False)
    progress.update(1)


def _earlier_seconds(folder: RunFolder, step: int) -> float:
    """Run time of the steps that an earlier run has done."""
    if not folder.is_resumed or not (folder / HISTORY).exists():
        return 0.0
    return max((float(row["run_s"]) for row in read_history(folder / HISTORY) if int(row["step"]) <= step), default=0.0)
