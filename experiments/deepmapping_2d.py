"""Registers 2-D laser scans into one map by optimising two small networks on these scans alone (DeepMapping).

    python -m experiments.deepmapping_2d                              the built-in world
    python -m experiments.deepmapping_2d scans.tar -o out             a folder or .tar of .pcd + gt_pose.mat
    python -m experiments.deepmapping_2d robot.log.gz --init odometry a CARMEN log
    python -m experiments.deepmapping_2d scans.npz --seconds 60       arrays (n, b, 2)
    python -m experiments.deepmapping_2d --jump 8 --init global       large steps: no first guess is needed
    python -m experiments.deepmapping_2d --resume                     continue the latest run

Results go to results/deepmapping_2d/<time>/ (latest links to the newest): metrics.json, trajectories as TUM, KITTI and
npy, and pictures: map.png, occupancy.png, loss.png. Without --init the start is incremental point-to-line ICP; the
result is the one of start, fit and polish whose map describes the beams best, so it does not get worse.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import FlagCreatePairsOff, Positional, arg

from experiments._command import run_command
from experiments._deepmapping_fit import FitRun, run_fit
from experiments._history import read_history
from experiments._machine import peak_rss_gb, select_device
from experiments._run_folder import HISTORY, RunFolder, open_run_folder, recording, write_metrics
from experiments._stop import StopFlag

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.registration import PlanarScans
    from dpmjax.sequences import ScanSequence

EXPERIMENT = "deepmapping_2d"
LOGGER = logging.getLogger("dpmjax.deepmapping_2d")
INITS = ("icp-plane", "icp-point", "global", "odometry", "zero")


@dataclass(frozen=True)
class Config:
    """Options of the run."""

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Scans: a folder or .tar of .pcd, a CARMEN log, .npy or .npz. Without it: the built-in world."""
    output: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT")] = None
    """Folder for the results, instead of results/deepmapping_2d/<time>."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: minutes on two cores; paper: architecture, losses and sampling of the paper."""
    init: Annotated[str, arg(metavar="icp-plane|icp-point|global|odometry|zero|FILE")] = "icp-plane"
    """Where the poses start; global: an exhaustive search of scan pairs, needs no guess; FILE is a trajectory."""
    ordered: bool = True
    """Scans lie in the order of time; --no-ordered makes no use of it, and needs --init global."""
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
        if not self.ordered and self.init != "global":
            raise ValueError(f"--no-ordered: only --init global needs no order, got --init {self.init}")
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


def main(config: Config) -> Result:
    """Reads, starts warm, fits, polishes, keeps the best, writes."""
    from dpmjax.registration import assess_trajectory, choose_trajectory

    started = time.perf_counter()
    select_device(config.device)
    sequence = read_scans(config)
    start = warm_start(config, sequence)
    settings = fit_settings(config, sequence)
    folder = open_run_folder(
        config,
        EXPERIMENT,
        output=config.output,
        resume=config.resume,
        force=config.force,
        may_change=frozenset({"seconds"}),
    )
    with recording(folder), StopFlag() as stop:
        print(f"{sequence.name}: {len(sequence)} scans of {sequence.points.shape[1]} beams, from {config.init}")
        fitted = _fit(folder, sequence, settings, start, config, stop)
        lines = line_scans(sequence)
        candidates = {"start": start, "fit": fitted.poses}
        if config.polish and not stop.is_requested:
            candidates |= _polish(lines, candidates, config.init)
        chosen, scores = choose_trajectory(lines, candidates)
        poses = candidates[chosen]
        confidence = assess_trajectory(lines, poses)
        metrics = {
            "num_scans": len(sequence),
            "steps": fitted.steps,
            **compare_to_reference(sequence, start, poses),
            "chosen": chosen,
            "scores": {name: score._asdict() for name, score in scores.items()},
            "confidence": confidence._asdict(),
            "fit_s": fitted.run_s,
            "compile_s": fitted.compile_s,
            "wall_s": time.perf_counter() - started,
            "peak_rss_gb": peak_rss_gb(),
            "is_interrupted": stop.is_requested,
        }
        # Numbers first: a picture that fails must not cost them.
        write_trajectories(folder, sequence, poses)
        write_metrics(folder, metrics, seed=config.seed)
        draw(folder, sequence, start, poses, metrics)
        draw_occupancy(folder, sequence, fitted, settings)
        tell(folder, sequence, metrics)
    return Result(folder.path, poses, metrics)


def _fit(
    folder: RunFolder,
    sequence: ScanSequence,
    settings: DeepMappingConfig,
    start: NDArray[np.float64],
    config: Config,
    stop: StopFlag,
) -> FitRun:
    """DeepMapping; its losses compare each scan with the next ones, so these must be near: in time they are."""
    from dpmjax.registration import nearest_tour

    order = np.arange(len(sequence)) if config.ordered else nearest_tour(start)
    fitted = run_fit(
        folder,
        sequence.take(order),
        settings,
        start=None if config.init == "zero" else start[order],
        seed=config.seed,
        seconds=config.seconds,
        stop=stop,
    )
    return replace(fitted, poses=fitted.poses[np.argsort(order)])


def _polish(
    lines: PlanarScans, candidates: dict[str, NDArray[np.float64]], init: str
) -> dict[str, NDArray[np.float64]]:
    """Both polished: the fit is sharper near a good start, the start keeps what a robot's odometry knows."""
    from dpmjax.registration import refine

    polished = {}
    for name in ("fit",) if init == "zero" else ("start", "fit"):
        result = refine(lines.replace(is_ordered=init != "global"), candidates[name])
        LOGGER.info("polished the %s: %d pairs, %d loops", name, result.num_pairs, result.num_loops)
        polished[f"polished {name}"] = result.poses
    return polished


def read_scans(config: Config) -> ScanSequence:
    """The scans of DATA or of the built-in world, sub-range and stride applied."""
    from dpmjax.io import read_sequence
    from dpmjax.simulation import simulate_sequence

    stop = None if config.n_scans is None else config.start + config.n_scans * config.jump
    if config.data is not None:
        return read_sequence(config.data, start=config.start, stop=stop, stride=config.jump)
    sequence = simulate_sequence(
        config.world, stop or 256, range_noise_px=config.range_noise_px, seed=config.seed, with_odometry=True
    )
    return sequence.take(slice(config.start, stop, config.jump))


def warm_start(config: Config, sequence: ScanSequence) -> NDArray[np.float64]:
    """(n, 3) poses to start from; what is no word of `INITS` names a trajectory file."""
    if config.init == "zero":
        return np.zeros((len(sequence), 3))
    if config.init == "global":
        from dpmjax.registration import register_globally

        return register_globally(line_scans(sequence).replace(is_ordered=config.ordered)).poses
    if config.init == "odometry":
        if sequence.odometry_poses is None:
            raise ValueError(
                f"{sequence.name}: has no odometry of its own (its odometry column repeats the corrected pose, or is "
                "missing); use --init icp-plane"
            )
        return sequence.odometry_poses
    if config.init not in INITS:
        from dpmjax.io import read_planar_poses

        if not Path(config.init).exists():
            raise ValueError(f"--init {config.init}: no such file, and none of {', '.join(INITS)}")
        return read_planar_poses(config.init, len(sequence), sequence.unit)

    from dpmjax.registration import IncrementalConfig, incremental_icp

    metric: Literal["point", "plane"] = "point" if config.init == "icp-point" else "plane"
    return incremental_icp(line_scans(sequence), IncrementalConfig(metric=metric)).poses


def line_scans(sequence: ScanSequence) -> PlanarScans:
    """The scans with a line at every beam; beams without an order are sorted by angle first."""
    from dpmjax.registration import planar_scans

    return planar_scans(sequence.points, sequence.mask)


def fit_settings(config: Config, sequence: ScanSequence) -> DeepMappingConfig:
    """The preset, with the number of steps asked for in its last phase."""
    from dpmjax.deepmapping import preset, with_steps

    settings = preset(config.preset, is_organised=sequence.is_organised)
    return settings if config.steps is None else with_steps(settings, config.steps)


def compare_to_reference(
    sequence: ScanSequence, start: NDArray[np.float64], poses: NDArray[np.float64]
) -> dict[str, Any]:
    """Errors before and after, in the unit of the scans; `success` is unknown where there is no reference."""
    from dpmjax.geometry import se2
    from dpmjax.metrics import absolute_trajectory_error, point_distance

    reference, unit = sequence.reference_poses, sequence.unit
    if reference is None:
        return {"success": None}
    T_reference = se2.to_matrix(reference)
    errors: dict[str, Any] = {}
    for which, some in (("", poses), ("initial_", start)):
        errors[f"ate_{which}{unit}"] = absolute_trajectory_error(some[:, :2], reference[:, :2])
        distance = point_distance(sequence.points, sequence.mask, se2.to_matrix(some), T_reference)
        errors[f"point_distance_{which}{unit}"] = distance
    # The paper's threshold is 20 pixels, 2 % of its world; of a real place, 2 % of what its trajectory spans.
    threshold = 20.0 if unit == "px" else 0.02 * float(np.linalg.norm(np.ptp(reference[:, :2], axis=0)))
    return {**errors, f"success_threshold_{unit}": threshold, "success": errors[f"ate_{unit}"] < threshold}


def write_trajectories(folder: RunFolder, sequence: ScanSequence, poses: NDArray[np.float64]) -> None:
    """trajectory.npy, trajectory_tum.txt, trajectory_kitti.txt: T_world_scan of every scan."""
    from dpmjax.io import write_kitti, write_poses_npy, write_tum

    write_poses_npy(folder / "trajectory.npy", poses)
    write_tum(folder / "trajectory_tum.txt", poses, times=sequence.times, unit=sequence.unit)
    write_kitti(folder / "trajectory_kitti.txt", poses)


def draw_occupancy(folder: RunFolder, sequence: ScanSequence, fitted: FitRun, settings: DeepMappingConfig) -> None:
    """occupancy.png: what M-Net learned, black, white, and grey where no beam has been."""
    if not fitted.has_map:
        return
    from dpmjax import viz
    from dpmjax.deepmapping import draw_map

    picture = draw_map(fitted.state, settings, sequence.points, sequence.mask, fitted.poses, reach=fitted.reach)
    figure = viz.occupancy_figure(
        picture.probability, picture.explored, picture.extent, fitted.poses[:, :2], sequence.unit
    )
    viz.save_figure(figure, folder / "occupancy.png")


def draw(
    folder: RunFolder,
    sequence: ScanSequence,
    start: NDArray[np.float64],
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

    panels = [panel(f"Start: {sequence.name}", start, "initial_"), panel("DeepMapping", poses, "")]
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


def tell(folder: RunFolder, sequence: ScanSequence, metrics: dict[str, Any]) -> None:
    """The last lines on the console: the error before and after, and where to look."""
    unit = sequence.unit
    if f"ate_{unit}" in metrics:
        print(f"ATE {metrics[f'ate_initial_{unit}']:.3g} {unit} -> {metrics[f'ate_{unit}']:.3g} {unit}")
    print(f"kept: the {metrics['chosen']} (judged by the scans alone)")
    print(f"results in {folder.path}")
    confidence = metrics["confidence"]
    verdict = "can be trusted" if confidence["is_trusted"] else "DO NOT TRUST this map"
    print(
        f"{verdict}: weakest connection {confidence['weakest_connection']:.0%} of the beams, "
        f"{confidence['contradiction']:.1%} contradict others"
    )


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
