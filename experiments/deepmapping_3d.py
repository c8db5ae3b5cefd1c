"""Registers 3-D lidar scans by optimising two small networks on these scans alone (DeepMapping, in SE(3)).

    python -m experiments.deepmapping_3d                                      a simulated room, poses 0.2 m off
    python -m experiments.deepmapping_3d drive --window 100:140 --init-noise 0.2   poses of the folder, with noise
    python -m experiments.deepmapping_3d drive --init odometry.txt -o out     from a trajectory: TUM, KITTI or npy
    python -m experiments.deepmapping_3d drive --init zero --window 0:8       a cold start
    python -m experiments.deepmapping_3d --resume                             continue the latest run

DATA is any folder of scans (KITTI, KITTI-360, MulRan, plain ...). Results go to results/deepmapping_3d/<time>/ (latest
links to the newest): metrics.json, trajectories as TUM, KITTI and npy, map.ply, map.png (from above, before and after),
loss.png. The start or the fit is kept, by the share of planes that meet, without ground truth.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax.cli import (
    FitRecorder,
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    draw_loss,
    open_run_folder,
    peak_rss_gb,
    recording,
    run_command,
    write_metrics,
)
from experiments._cloud_input import DriveWindow, FirstPoses, read_drive, starting_poses

if TYPE_CHECKING:
    from dpmjax.deepmapping import CloudScans, DeepMappingConfig, Registered
    from dpmjax.io import LidarSequence

Floats = NDArray[np.float64]

EXPERIMENT = "deepmapping_3d"
_SIMULATED_NOISE_M = 0.2
# Points on steeper surfaces than this are drawn: walls, not the ground or the ceiling.
_WALL_COSINE = 0.5


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Folder of scans. Without it: a simulated place."""
    sequence: Annotated[str | None, arg(metavar="NAME")] = None
    """Which drive, where DATA holds several."""
    scene: Literal["room", "street"] = "room"
    """Which simulated place, where no DATA is given."""
    init: Annotated[str, arg(metavar="poses|zero|FILE")] = "poses"
    """Where the poses start: those of the folder, all at one place, or a trajectory of the scans or of the window."""
    init_noise: Annotated[float | None, arg(metavar="M")] = None
    """Noise that is added to the start, metres; without it, 0.2 in a simulated place, else none."""
    window: Annotated[str, arg(metavar="A:B")] = ":"
    """Scans to use, A to B - 1; one end may be left out."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan of the window."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: a minute on two cores for some dozens of scans; paper: architecture, losses and sampling of the paper."""
    steps: Annotated[int | None, arg(metavar="N")] = None
    """Number of steps; without it, the preset decides."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, steps=1, jump=1, init_noise=0, seed=0)
        self.selection()
        if self.sequence is not None and self.data is None:
            raise ValueError("--sequence chooses a drive of DATA: give its folder too")

    def selection(self) -> slice:
        """The scans of the window."""
        found = re.fullmatch(r"(\d*):(\d*)", self.window)
        begin, end = (int(number) if number else None for number in found.groups()) if found else (0, 0)
        if end is not None and (begin or 0) >= end:
            raise ValueError(f"--window: expected A:B with A below B, such as 100:140, got {self.window}")
        return slice(begin, end, self.jump)

    def drive_window(self) -> DriveWindow:
        """The scans to register."""
        return DriveWindow(self.data, self.sequence, self.scene, self.selection(), self.seed)

    def first_poses(self) -> FirstPoses:
        """Poses to start from."""
        is_simulated = self.data is None and self.init == "poses"
        usual = _SIMULATED_NOISE_M if is_simulated else 0.0
        noise = usual if self.init_noise is None else self.init_noise
        return FirstPoses(self.init, noise, self.seed)


def main(config: Config) -> dict[str, Any]:
    """Reads, registers, writes; returns the content of `metrics.json`."""
    import jax

    from dpmjax import register_clouds

    started = time.perf_counter()
    sequence = read_drive(config.drive_window())
    start = starting_poses(config.first_poses(), sequence, config.selection())
    scans = read_scans(sequence)
    folder = open_run_folder(config, EXPERIMENT)
    with recording(folder), StopFlag() as stop:
        print(f"{sequence.name}: {len(sequence)} scans of {scans.points.shape[1]} points, from {config.init}")
        recorder = FitRecorder(folder, "m", stop=lambda _: stop.is_requested)
        key, settings = jax.random.key(config.seed), fit_settings(config)
        engine = partial(recorder, measure=_measure(sequence, scans))
        fitted = register_clouds(scans, settings, key=key, start=start, engine=engine)
        metrics = {
            "num_scans": len(sequence),
            "steps": recorder.steps,
            "start": config.init,
            "kept": fitted.kept,
            **errors(sequence, start, fitted),
            "misfit": fitted.misfit,
            "start_misfit": fitted.start_misfit,
            "unit_m": fitted.fitted.unit,
            "fit_s": recorder.run_s,
            "compile_s": recorder.compile_s,
            "peak_rss_gb": peak_rss_gb(),
            "is_interrupted": stop.is_requested,
            "wall_s": time.perf_counter() - started,
        }
        # Numbers first: a picture that fails must not cost them.
        write_results(folder, sequence, scans, fitted)
        write_metrics(folder, metrics, seed=config.seed)
        draw_map(folder, sequence, scans, start, fitted)
        draw_loss(folder, "m")
        print(report(metrics), f"results in {folder.path}", sep="\n")
    return metrics


def read_scans(sequence: LidarSequence) -> CloudScans:
    """Reads and thins the scans."""
    from dpmjax.deepmapping import as_cloud_scans

    clouds = [sequence.read_scan(number) for number in tqdm(range(len(sequence)), desc="read", unit=" scans")]
    with tqdm(total=len(clouds), desc="thin", unit=" scans") as bar:
        return as_cloud_scans(clouds, on_scan=lambda: bar.update(1))


def fit_settings(config: Config) -> DeepMappingConfig:
    """Returns the preset, with the given number of steps."""
    from dpmjax import deepmapping

    settings = deepmapping.preset(config.preset, "clouds")
    return settings if config.steps is None else deepmapping.with_steps(settings, config.steps)


def _measure(sequence: LidarSequence, scans: CloudScans) -> Callable[[Floats], float]:
    """Returns the ATE, in metres, of the poses that the fit counts in typical ranges."""
    from dpmjax.geometry import typical_range

    unit, measure = typical_range(scans.points, scans.mask), ate_of(sequence)
    return lambda T: measure(unit * T[:, :3, 3])


def ate_of(sequence: LidarSequence) -> Callable[[Floats], float]:
    """Returns the ATE of positions (n, 3) in metres; NaN without a reference."""
    from dpmjax.metrics import absolute_trajectory_error

    reference = sequence.T_world_lidar
    if reference is None:
        return lambda _: math.nan
    return lambda positions: absolute_trajectory_error(positions, reference[:, :3, 3])


def errors(sequence: LidarSequence, start: Floats | None, fitted: Registered) -> dict[str, float]:
    """Errors of the start and of the kept poses; empty without a reference."""
    from dpmjax.metrics import relative_pose_error

    if sequence.T_world_lidar is None:
        return {}
    numbers, measure = {}, ate_of(sequence)
    for name, T in (("initial_", start), ("", fitted.T_world_scan)):
        if T is not None:
            numbers[f"ate_{name}m"] = measure(T[:, :3, 3])
            relative = relative_pose_error(T, sequence.T_world_lidar)
            numbers |= {
                f"rpe_{name}m": relative.translation_rmse,
                f"rpe_{name}deg": math.degrees(relative.rotation_rmse),
            }
    return numbers


def write_results(folder: RunFolder, sequence: LidarSequence, scans: CloudScans, fitted: Registered) -> None:
    """Writes the trajectories and map.ply."""
    from dpmjax import io

    T = fitted.T_world_scan
    io.write_poses_npy(folder / "trajectory.npy", T)
    io.write_tum(folder / "trajectory_tum.txt", T, times=sequence.times)
    io.write_kitti(folder / "trajectory_kitti.txt", T)
    io.write_ply(folder / "map.ply", world_points(scans, T)[np.asarray(scans.mask)])


def world_points(scans: CloudScans, T: Floats) -> Floats:
    """Returns (n, c, 3) points in the world."""
    points = np.asarray(scans.points, np.float64)
    return np.einsum("nij,ncj->nci", T[:, :3, :3], points) + T[:, None, :3, 3]


def draw_map(
    folder: RunFolder, sequence: LidarSequence, scans: CloudScans, start: Floats | None, fitted: Registered
) -> None:
    """Draws map.png: walls from above, at the start, after the fit, at the reference."""
    from dpmjax import viz

    T, measure = fitted.T_world_scan, ate_of(sequence)
    shown = [("Start", start)] if start is not None else []
    shown += [("DeepMapping" if fitted.kept == "fit" else "Kept: the start", T)]
    panels = [seen_from_above(title, scans, poses, measure(poses[:, :3, 3])) for title, poses in shown]
    if sequence.T_world_lidar is None:
        panels[-1] = replace(panels[-1], is_reference=True)
    else:
        reference = seen_from_above("Reference", scans, sequence.T_world_lidar, math.nan)
        panels.append(replace(reference, is_reference=True))
    viz.save_figure(viz.registered_scans_figure(panels, "m"), folder / "map.png")


def seen_from_above(title: str, scans: CloudScans, T: Floats, ate: float) -> Any:
    """Returns the panel of poses: walls as planar scans, positions and headings as planar poses."""
    from dpmjax import ScanSet, viz

    heading = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y, _ = np.moveaxis(world_points(scans, T) - T[:, None, :3, 3], -1, 0)
    upward = np.einsum("nj,ncj->nc", T[:, 2, :3], np.asarray(scans.normals))
    is_wall = np.asarray(scans.mask) & (np.asarray(scans.flatness) > 0.0) & (np.abs(upward) < _WALL_COSINE)
    planar = ScanSet(np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1), is_wall)
    poses = np.column_stack([T[:, :2, 3], heading])
    return viz.Panel(title, planar, poses, ate=None if math.isnan(ate) else ate)


def report(metrics: dict[str, Any]) -> str:
    """Returns the last lines on the console."""
    lines = []
    for name, word in (("initial_", "start"), ("", "result")):
        if f"ate_{name}m" in metrics:
            ate, rpe, turn = (
                metrics[f"{kind}_{name}{unit}"] for kind, unit in (("ate", "m"), ("rpe", "m"), ("rpe", "deg"))
            )
            lines.append(f"{word:6}  ATE {ate:.3f} m, RPE {rpe:.3f} m {turn:.3f} degrees")
    if metrics["start_misfit"] is not None:
        before, after = metrics["start_misfit"], metrics["misfit"]
        lines.append(f"planes that do not meet: {before:.1%} at the start, {after:.1%} after the fit")
    if metrics["kept"] == "start":
        lines.append("the fit is NOT better than the start, judged by the scans: the start is kept")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
