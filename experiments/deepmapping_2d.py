"""Registers 2-D laser scans into one map by optimising two small networks on these scans alone (DeepMapping).

    python -m experiments.deepmapping_2d                              the built-in world
    python -m experiments.deepmapping_2d scans.tar -o out             a folder or .tar of .pcd + gt_pose.mat
    python -m experiments.deepmapping_2d robot.log.gz --init odometry a CARMEN log
    python -m experiments.deepmapping_2d scans.npz --seconds 60       arrays (n, b, 2)
    python -m experiments.deepmapping_2d --resume                     continue the latest run

Results go to results/deepmapping_2d/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI and
npy, and pictures: map.png, occupancy.png, loss.png.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, Positional, arg

from experiments._command import run_command
from experiments._history import HistoryFile, read_history
from experiments._machine import peak_rss_gb, select_device
from experiments._run_folder import HISTORY, RunFolder, open_run_folder, recording, write_metrics
from experiments._stop import StopFlag

if TYPE_CHECKING:
    from dpmjax.data.sequence import ScanSequence

EXPERIMENT = "deepmapping_2d"
INITS = ("icp-plane", "icp-point", "odometry", "zero")


@dataclass(frozen=True)
class Config:
    """Options of the run."""

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Scans: a folder or .tar of .pcd, a CARMEN log, .npy or .npz. Without it: the built-in world."""
    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/deepmapping_2d/<time>."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: architecture, losses and sampling of the paper."""
    init: Annotated[str, arg(metavar="icp-plane|icp-point|odometry|zero|FILE")] = "icp-plane"
    """Where the poses start; FILE is a trajectory."""
    polish: bool = True
    """Finish with a multi-view point-to-line alignment."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Stop after N steps; without it, the preset decides."""
    seconds: Annotated[float | None, arg(metavar="S")] = None
    """Stop the fit after S seconds of run time, compile time not counted."""
    start: Annotated[int, arg(metavar="N")] = 0
    """First scan to use."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Use N scans; without it, all."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""
    world: Literal[0, 1, 2] = 0
    """Which built-in world, where no DATA is given."""
    range_noise_px: Annotated[float, arg(metavar="PX")] = 0.0
    """Standard deviation of the range noise in the built-in world."""
    seed: int = 0
    """Seed of everything random."""
    device: Annotated[Literal["cpu", "gpu"] | None, arg(metavar="cpu|gpu")] = None
    """Where to compute; without it, JAX chooses."""
    resume: FlagCreatePairsOff[bool] = False
    """Continue an interrupted run, the latest or that in OUT; options not given are the same as then."""
    force: FlagCreatePairsOff[bool] = False
    """Replace an earlier run in OUT."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        for name, least in (("steps", 1), ("n_scans", 1), ("jump", 1), ("start", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"--{name.replace('_', '-')}: expected at least {least}, got {value}")
        if self.seconds is not None and not self.seconds > 0.0:
            raise ValueError(f"--seconds: expected a positive time, got {self.seconds}")
        if not (math.isfinite(self.range_noise_px) and self.range_noise_px >= 0.0):
            raise ValueError(f"--range-noise-px: expected zero or more, got {self.range_noise_px}")


@dataclass(frozen=True)
class Result:
    """What a run found.

    Attributes:
        folder: where it was written.
        poses: (n, 3) float64 x, y, heading of each scan in the world.
        metrics: what `metrics.json` says.
    """

    folder: Path
    poses: NDArray[np.float64]
    metrics: dict[str, Any]


@dataclass(frozen=True)
class FitResult:
    """What the fit hands on.

    Attributes:
        poses: (n, 3) poses that it kept.
        steps: steps done.
        compile_s: seconds until the step was compiled.
    """

    poses: NDArray[np.float64]
    steps: int
    compile_s: float


def main(config: Config) -> Result:
    """Reads, starts warm, fits, polishes, writes."""
    started = time.perf_counter()
    select_device(config.device)
    sequence = read_scans(config)
    initial_poses = warm_start(config, sequence)
    folder = open_run_folder(
        config,
        EXPERIMENT,
        output=config.output,
        resume=config.resume,
        force=config.force,
        may_change=frozenset({"seconds"}),
    )
    with recording(folder), StopFlag() as stop:
        fitted = fit(config, sequence, initial_poses, folder, stop)
        poses = fitted.poses
        if config.polish and not stop.is_requested:
            poses = polish(sequence, poses)
        metrics = {
            "num_scans": len(sequence),
            "steps": fitted.steps,
            **score(sequence, initial_poses, poses),
            "wall_s": time.perf_counter() - started,
            "compile_s": fitted.compile_s,
            "peak_rss_gb": peak_rss_gb(),
            "is_interrupted": stop.is_requested,
        }
        # Numbers first: a picture that fails must not cost them.
        write_trajectories(folder, sequence, poses)
        write_metrics(folder, metrics, seed=config.seed)
        draw(folder, sequence, initial_poses, poses, metrics)
        tell(folder, sequence, metrics)
    return Result(folder.path, poses, metrics)


def read_scans(config: Config) -> ScanSequence:
    """The scans of DATA or of the built-in world, sub-range and stride applied."""
    raise NotImplementedError  # SEAM: dpmjax.data readers


def warm_start(config: Config, sequence: ScanSequence) -> NDArray[np.float64]:
    """(n, 3) poses to start from; what is no word of `INITS` names a trajectory file."""
    if config.init == "zero":
        return np.zeros((len(sequence), 3))
    raise NotImplementedError  # SEAM: dpmjax.registration, sequence.odometry_poses, dpmjax.data.trajectory_files


def fit(
    config: Config, sequence: ScanSequence, initial_poses: NDArray[np.float64], folder: RunFolder, stop: StopFlag
) -> FitResult:
    """Optimises L-Net and M-Net until the steps or the seconds are used up, or a stop is asked for."""
    first_step, num_steps = 0, config.steps or 1  # SEAM: init or restore the state; the preset's number of steps
    compile_s = 0.0  # SEAM: compile the step ahead (`lower().compile()`) and time that
    columns = ["step", "phase", "run_s", "loss", f"ate_{sequence.unit}"]
    keep_until = first_step - 1 if folder.is_resumed else None
    progress = tqdm(total=1.0, bar_format="{desc} {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]", desc="fit")
    step, started = first_step, time.perf_counter()
    with HistoryFile(folder / HISTORY, columns, keep_until=keep_until) as history, progress:
        while step < num_steps and not stop.is_requested:
            # SEAM: state, report = step_fn(state, batch, key=fold_in(key, step)); a checkpoint now and then
            loss, phase, ate = math.nan, "L-Net", math.nan
            step += 1
            run_s = time.perf_counter() - started
            history.append(step=step, phase=phase, run_s=run_s, loss=loss, **{f"ate_{sequence.unit}": ate})
            done = max(step / num_steps, run_s / config.seconds if config.seconds else 0.0)
            show_progress(progress, done, run_s, loss, ate, sequence.unit)
            if done >= 1.0:
                break
    return FitResult(initial_poses, step, compile_s)  # SEAM: keep the fit only where it scores better than its start


def show_progress(progress: tqdm, done: float, run_s: float, loss: float, ate: float, unit: str) -> None:
    """Moves the bar to the share that is done and tells loss, error and seconds left."""
    done = min(1.0, done)
    ate_text = f", ATE {ate:.3g} {unit}" if math.isfinite(ate) else ""
    progress.set_postfix_str(f"loss {loss:.4f}{ate_text}, {run_s * (1.0 - done) / done:.0f} s left", refresh=False)
    progress.update(done - progress.n)


def polish(sequence: ScanSequence, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multi-view point-to-line alignment of all scans."""
    raise NotImplementedError  # SEAM: dpmjax.registration


def score(sequence: ScanSequence, initial_poses: NDArray[np.float64], poses: NDArray[np.float64]) -> dict[str, Any]:
    """Errors before and after, in the unit of the scans; nothing where there is no reference."""
    if sequence.reference_poses is None:
        return {"success": None}
    raise NotImplementedError  # SEAM: ate_*, ate_initial_*, point_distance_*, success from dpmjax.metrics


def write_trajectories(folder: RunFolder, sequence: ScanSequence, poses: NDArray[np.float64]) -> None:
    """trajectory.npy, trajectory_tum.txt, trajectory_kitti.txt."""
    np.save(folder / "trajectory.npy", poses)
    # SEAM: dpmjax.data.trajectory_files


def draw(
    folder: RunFolder,
    sequence: ScanSequence,
    initial_poses: NDArray[np.float64],
    poses: NDArray[np.float64],
    metrics: dict[str, Any],
) -> None:
    """map.png and loss.png."""
    from dpmjax import viz

    unit = sequence.unit
    scans = sequence.points, sequence.mask

    def panel(title: str, of_poses: NDArray[np.float64], which: str) -> viz.Panel:
        ate, distance = metrics.get(f"ate_{which}{unit}"), metrics.get(f"point_distance_{which}{unit}")
        return viz.make_panel(title, *scans, of_poses, ate=ate, point_distance=distance)

    panels = [panel(f"Start: {sequence.name}", initial_poses, "initial_"), panel("DeepMapping", poses, "")]
    if sequence.reference_poses is not None:
        panels.append(viz.make_panel("Reference", *scans, sequence.reference_poses, is_reference=True))
    viz.save_figure(viz.registered_scans_figure(panels, unit), folder / "map.png")
    rows = read_history(folder / HISTORY)
    if rows:
        columns = {
            name: np.array([float(row[name] or "nan") for row in rows]) for name in ("run_s", "loss", f"ate_{unit}")
        }
        phases = [row["phase"] for row in rows]
        history = viz.History(columns["run_s"], columns["loss"], phases, columns[f"ate_{unit}"])
        viz.save_figure(viz.history_figure(history, unit), folder / "loss.png")
    # SEAM: viz.occupancy_figure of what M-Net learned -> occupancy.png


def tell(folder: RunFolder, sequence: ScanSequence, metrics: dict[str, Any]) -> None:
    """The last lines on the console: the error before and after, and where to look."""
    unit = sequence.unit
    if f"ate_{unit}" in metrics:
        print(f"ATE {metrics[f'ate_initial_{unit}']:.3f} {unit} -> {metrics[f'ate_{unit}']:.3f} {unit}")
    print(f"results in {folder.path}")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
