"""The loop around the step of DeepPointMap's training: batches ahead, step, record, measure, save, stop, resume."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from experiments._history import HistoryFile, read_history
from experiments._run_folder import CHECKPOINTS, HISTORY, RunFolder
from experiments._stop import StopFlag

if TYPE_CHECKING:
    from dpmjax.deeppointmap import Model, TrainingConfig
    from experiments._dpm_data import ScanStore
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
        model: as it is at the end.
        untrained: as it was at the beginning.
        examination: the held-out pairs.
        examined: what the model makes of them.
        steps: steps done in all.
        run_s: seconds of stepping, compile time apart; with those before a resume.
        compile_s: seconds of the first call of each stage, this time.
        scans_per_s: that the steps of this time took in.
    """

    model: Model
    untrained: Model
    examination: Examination
    examined: Examined
    steps: int
    run_s: float
    compile_s: float
    scans_per_s: float


def run_training(
    folder: RunFolder,
    store: ScanStore,
    config: TrainingConfig,
    paired: PairedScans,
    *,
    seed: int,
    recall_every: int,
    stop: StopFlag,
) -> TrainRun:
    """Trains, or continues where the checkpoints of the folder end.

    Args:
        folder: of the run; gets `metrics.csv` and checkpoints.
        store: the scans.
        config: of training.
        paired: held-out pairs.
        seed: of the run.
        recall_every: steps from one measurement of recall to the next.
        stop: asked between steps.

    Raises:
        TrainingLostError: the loss is not finite.
    """
    import jax

    from dpmjax import deeppointmap as dpm
    from experiments._checkpoint import Checkpoints
    from experiments._dpm_data import SampleMaker, made_ahead
    from experiments._dpm_recall import examine, prepare

    state = dpm.init(jax.random.key(seed), config)
    untrained = dpm.model_of(state, config)
    examination = prepare(untrained, paired)
    checkpoints = Checkpoints(Path(folder.path) / CHECKPOINTS)
    if folder.is_resumed:
        state = checkpoints.restore_latest(state, fallback=state)
    first = int(state.step)
    clock = _Clock(_earlier_seconds(folder, first))
    mesh, num_local = dpm.device_mesh(), jax.local_device_count()
    state, step = dpm.replicate(state, mesh), dpm.make_step(config)
    maker = SampleMaker(store, config, seed=seed, num_samples=num_local, first_sample=jax.process_index() * num_local)
    progress = tqdm(total=config.num_steps, initial=first, desc="train", unit=" steps", dynamic_ncols=True)
    seen: set[Any] = set()
    recall = math.nan
    last_saved = time.perf_counter()
    keep_until = first if folder.is_resumed else None
    with (
        HistoryFile(folder / HISTORY, COLUMNS, keep_until=keep_until) as history,
        made_ahead(maker, first, config.num_steps) as batches,
    ):
        for number in range(first, config.num_steps):
            if stop.is_requested:
                break
            stage = config.stage_at(number)
            if stage not in seen:
                progress.set_postfix_str(f"compiling {_stage_name(stage)}")
            begun = time.perf_counter()
            state, report = step(state, dpm.shard_batch(next(batches), mesh))
            report = jax.device_get(report)
            clock.add(time.perf_counter() - begun, is_compiling=stage not in seen)
            seen.add(stage)
            if not math.isfinite(report.loss):
                raise TrainingLostError(f"the loss of step {number + 1} is {report.loss}; --resume goes on before it")
            is_last_registration = number + 1 == config.registration_steps
            is_due = stage is not None and ((number + 1) % recall_every == 0 or is_last_registration)
            measured = examine(_local(dpm.model_of(state, config)), examination).recall.recall if is_due else math.nan
            recall = measured if is_due else recall
            history.append(**_row(number + 1, _stage_name(stage), clock.run_s, report, measured))
            _tell(progress, stage, report, recall, clock.rate * config.sampling.num_scans * jax.device_count())
            if time.perf_counter() - last_saved > _SAVE_EVERY_S:
                checkpoints.save(int(state.step), state)
                last_saved = time.perf_counter()
    progress.close()
    maker.close()
    checkpoints.save(int(state.step), state)
    model = _local(dpm.model_of(state, config))
    return TrainRun(
        model,
        untrained,
        examination,
        examine(model, examination),
        steps=int(state.step),
        run_s=clock.run_s,
        compile_s=clock.compile_s,
        scans_per_s=clock.rate * config.sampling.num_scans * jax.device_count(),
    )


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
    import numpy as np

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
