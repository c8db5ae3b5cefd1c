"""The loop around DeepMapping's step: compile, run, tell, record, save, stop, resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from experiments._history import HistoryFile, read_history
from experiments._run_folder import CHECKPOINTS, HISTORY, RunFolder
from experiments._stop import StopFlag

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.sequences import ScanSequence
    from dpmjax.types import ScanSet

# Of the table; the error, named with its unit, comes last.
_COLUMNS = ("step", "phase", "run_s", "loss", "occupancy", "chamfer")
# A checkpoint so often; Ctrl-C and the end write one too.
_SAVE_EVERY_S = 20.0


@dataclass(frozen=True)
class FitRun:
    """What the fit hands on.

    Attributes:
        poses: (n, 3) poses of the last step, unit of the scans.
        state: of DeepMapping, to draw the map from.
        reach: the length that the state counts in.
        steps: steps done in all.
        run_s: seconds of stepping, compile time apart.
        compile_s: seconds of compiling.
        has_map: M-Net has been trained.
    """

    poses: NDArray[np.float64]
    state: Any
    reach: float
    steps: int
    run_s: float
    compile_s: float
    has_map: bool


def run_fit(
    folder: RunFolder,
    sequence: ScanSequence,
    settings: DeepMappingConfig,
    *,
    start: NDArray[np.float64] | None,
    seed: int,
    seconds: float | None,
    stop: StopFlag,
) -> FitRun:
    """Fits, or continues where the checkpoints of the folder end.

    Args:
        folder: of the run; gets `history.csv` and checkpoints.
        sequence: the scans.
        settings: of DeepMapping.
        start: (n, 3) poses, or None for a cold start.
        seed: of the run.
        seconds: run time after which the fit stops, or None.
        stop: asked between calls of the step.

    Returns:
        FitRun.
    """
    import jax

    from dpmjax import deepmapping as dm
    from experiments._checkpoint import Checkpoints

    scans, reach = _scaled(sequence)
    unit = np.array([reach, reach, 1.0])
    is_warm = start is not None
    phases = settings.phases(is_warm=is_warm)
    key = jax.random.key(seed)
    state = dm.init(key, scans, settings, start_poses=None if start is None else start / unit)
    checkpoints = Checkpoints(Path(folder.path) / CHECKPOINTS)
    if folder.is_resumed:
        state = checkpoints.restore_latest(state, fallback=state)
    ate_column = f"ate_{sequence.unit}"
    run_s, compile_s = _earlier_seconds(folder, int(state.step)), 0.0
    measure = _ate_of(sequence)
    poses = np.asarray(dm.current_poses(state, scans, settings, phases[int(state.phase)]), np.float64) * unit
    total = sum(phase.num_steps for phase in phases)
    progress = tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]", desc="fit")
    last_saved = time.perf_counter()
    keep_until = int(state.step) if folder.is_resumed else None
    with HistoryFile(folder / HISTORY, (*_COLUMNS, ate_column), keep_until=keep_until) as history:
        while True:
            phase = phases[int(state.phase)]
            begun = time.perf_counter()
            progress.set_postfix_str(f"compiling {phase.name}")
            step = dm.make_step(scans, settings, phase).lower(state, key=key).compile()
            compile_s += time.perf_counter() - begun
            while int(state.phase_step) < phase.num_steps and not _is_over(stop, seconds, run_s):
                begun = time.perf_counter()
                state, report = step(state, key=key)
                poses = np.asarray(report.poses, np.float64) * unit
                run_s += time.perf_counter() - begun
                ate = measure(poses)
                row = {"step": int(state.step), "phase": phase.name, "run_s": round(run_s, 4), ate_column: ate}
                history.append(**row, **_losses(report))
                done = max(int(state.step) / total, run_s / seconds if seconds else 0.0)
                show_progress(progress, phase.name, done, run_s, float(report.loss), ate, sequence.unit)
                if time.perf_counter() - last_saved > _SAVE_EVERY_S:
                    checkpoints.save(int(state.step), state)
                    last_saved = time.perf_counter()
            if _is_over(stop, seconds, run_s) or int(state.phase) + 1 == len(phases):
                break
            state = dm.next_phase(state, scans, settings, is_warm=is_warm)
    progress.close()
    checkpoints.save(int(state.step), state)
    return FitRun(
        poses, state, reach, int(state.step), run_s, compile_s, phases[int(state.phase)].occupancy_weight > 0.0
    )


def _scaled(sequence: ScanSequence) -> tuple[ScanSet, float]:
    """The scans with their reach as unit, and the reach."""
    from dpmjax import deepmapping as dm
    from dpmjax.types import ScanSet

    scans = dm.as_scan_set(ScanSet(sequence.points, sequence.mask))
    reach = dm.measure_reach(scans)
    return replace(scans, points=scans.points / reach), reach


def _losses(report: Any) -> dict[str, float]:
    """The loss of a step and its terms, by the names of the table."""
    terms = report.terms
    return {"loss": float(report.loss), "occupancy": float(terms.occupancy), "chamfer": float(terms.chamfer)}


def _is_over(stop: StopFlag, seconds: float | None, run_s: float) -> bool:
    return stop.is_requested or (seconds is not None and run_s >= seconds)


def _earlier_seconds(folder: RunFolder, step: int) -> float:
    """Run time of the steps that an earlier run has done."""
    if not folder.is_resumed or not (folder / HISTORY).exists():
        return 0.0
    return max((float(row["run_s"]) for row in read_history(folder / HISTORY) if int(row["step"]) <= step), default=0.0)


def _ate_of(sequence: ScanSequence) -> Callable[[NDArray[np.float64]], float]:
    from dpmjax.metrics import absolute_trajectory_error

    reference = sequence.reference_poses
    if reference is None:
        return lambda _: math.nan
    return lambda poses: absolute_trajectory_error(poses[:, :2], reference[:, :2])


def show_progress(progress: tqdm, phase: str, done: float, run_s: float, loss: float, ate: float, unit: str) -> None:
    """Moves the bar to the share that is done and tells phase, loss, error and seconds left."""
    done = min(1.0, done)
    ate_text = f", ATE {ate:.3g} {unit}" if math.isfinite(ate) else ""
    left = run_s * (1.0 - done) / max(done, 1e-9)
    progress.set_postfix_str(f"{phase}, loss {loss:.4f}{ate_text}, {left:.0f} s left", refresh=False)
    progress.update(done - progress.n)
