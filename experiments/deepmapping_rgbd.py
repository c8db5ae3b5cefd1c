"""Registers depth images by DeepMapping, many short trajectories at low overlap (DeepMapping section 4.2, figure 9).

    python -m experiments.deepmapping_rgbd                        105 walks through simulated apartments
    python -m experiments.deepmapping_rgbd --limit 7 -o out
    python -m experiments.deepmapping_rgbd Home_001_1             walks through a scene of the Active Vision Dataset
    python -m experiments.deepmapping_rgbd rgbd_folder            depth PNG + pose files + intrinsics, in SE(3)
    python -m experiments.deepmapping_rgbd --resume -o out

The simulated apartments follow the dataset's protocol: places 300 mm apart, views every 30 degrees, 8 or 16 views. Each
trajectory is written to rows/ as soon as all methods have done it; metrics.json has the success rates (ATE below
450 mm, the paper's threshold, and below 100 mm, for the first is met by not moving at all on most walks),
errors.png the box plots, map_K.png some trajectories from above.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional, arg

from experiments._command import StopFlag, run_command
from experiments._machine import peak_rss_gb
from experiments._result_files import do_rows
from experiments._rgbd_methods import METHODS, errors_of, run_method
from experiments._run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics

if TYPE_CHECKING:
    from dpmjax.deepmapping import DepthMappingConfig
    from dpmjax.io import DepthSequence

EXPERIMENT = "deepmapping_rgbd"
_SUCCESS_MM = 450.0
_CLOSE_MM = 100.0


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the comparison."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "pictures"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """A scene of the Active Vision Dataset, or a folder of NAME.depth.png; without it, simulated apartments."""
    limit: Annotated[int, arg(metavar="N")] = 105
    """Trajectories."""
    methods: tuple[str, ...] = ("zero", "placed", "deepmapping", "deepmapping-cold", "direct")
    """What to compare; also icp and deepmapping-icp."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: seconds a trajectory; paper: its networks and sampling, for a GPU."""
    motion: Literal["auto", "planar", "full"] = "auto"
    """planar: x, z and an angle, as in the paper; full: SE(3); auto: as the data say."""
    views: Annotated[int, arg(metavar="N")] = 0
    """Images a trajectory; 0: 8 and 16 in turn."""
    depth_noise_m: Annotated[float, arg(metavar="M")] = 0.0
    """Depth noise of the simulated camera at one metre."""
    pictures: Annotated[int, arg(metavar="N")] = 4
    """Trajectories to draw from above."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        if self.limit < 1:
            raise ValueError(f"--limit: expected at least 1, got {self.limit}")
        if self.views != 0 and self.views < 2:
            raise ValueError(f"--views: expected 0 or at least 2, got {self.views}")
        if not self.depth_noise_m >= 0.0:
            raise ValueError(f"--depth-noise-m: expected zero or more, got {self.depth_noise_m}")
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise ValueError(f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")


def main(config: Config) -> dict[str, Any]:
    """Runs what is missing, then writes the table and the pictures."""
    settings = fit_settings(config, read_trajectory(config, 0))
    cases = [{"trajectory": index} for index in range(num_trajectories(config))]
    folder = open_run_folder(config, EXPERIMENT)
    with recording(folder), StopFlag() as stop:
        begun = time.perf_counter()
        work = partial(run_one, folder=folder, config=config, settings=settings)
        rows = do_rows(folder.path, cases, work, seed=config.seed, is_stopped=lambda: stop.is_requested)
        if rows:
            metrics = summarise(rows, config.methods)
            metrics |= {"wall_s": time.perf_counter() - begun, "peak_rss_gb": peak_rss_gb()}
            write_metrics(folder, {**metrics, "is_interrupted": stop.is_requested}, seed=config.seed, rows=rows)
            draw_errors(folder, rows, config.methods)
            tell(folder, metrics)
            return metrics
    return {}


def num_trajectories(config: Config) -> int:
    """As many as asked for; of a folder of images no more than there are windows."""
    from dpmjax import io

    if config.data is None or io.is_active_vision(config.data):
        return config.limit
    count, views = len(io.read_pose_folder(config.data)), config.views or 8
    return min(config.limit, max(1, (count - views) // (views // 2) + 1))


def read_trajectory(config: Config, index: int) -> DepthSequence:
    """One trajectory; of a folder of images windows that overlap by half."""
    from dpmjax import io, simulation

    views = config.views or (8 if index % 2 == 0 else 16)
    seed = 1000 * config.seed + index
    if config.data is None:
        walk = simulation.GridWalkConfig(depth_noise_m=config.depth_noise_m)
        return simulation.simulate_depth_sequence(seed % 15, views, seed=seed, config=walk)
    if io.is_active_vision(config.data):
        return io.read_active_vision(config.data, views, seed=seed)
    sequence, views = io.read_pose_folder(config.data), config.views or 8
    if sequence.T_world_camera is None:
        raise ValueError(f"{config.data}: has no pose files, so nothing to compare to")
    begin = index * (views // 2)
    window = sequence.take(slice(begin, begin + views))
    return replace(window, name=f"{sequence.name}, images {begin} to {begin + len(window) - 1}")


def fit_settings(config: Config, sequence: DepthSequence) -> DepthMappingConfig:
    """The preset, with the motion of the data."""
    from dpmjax.deepmapping import depth_preset

    is_planar = sequence.is_planar if config.motion == "auto" else config.motion == "planar"
    return depth_preset(config.preset, motion="planar" if is_planar else "full")


def run_one(trajectory: int, *, folder: RunFolder, config: Config, settings: DepthMappingConfig) -> dict[str, Any]:
    """All methods on one trajectory; a fit from the result of another method is timed without that method.

    The first `run_s` of each number of images contains its compilation.

    Args:
        trajectory: its number.
        folder: of the run; gets the pictures.
        config: options.
        settings: of DeepMapping.

    Returns:
        The rest of the row.
    """
    sequence = read_trajectory(config, trajectory)
    found: dict[str, NDArray[np.float64]] = {}
    row: dict[str, Any] = {"name": sequence.name, "views": len(sequence)}
    for name in config.methods:
        begun = time.perf_counter()
        found[name] = run_method(name, sequence, settings, found, seed=config.seed)
        row[name] = {**errors_of(found[name], sequence), "run_s": time.perf_counter() - begun}
    if trajectory < config.pictures:
        from dpmjax import viz

        panels = [(f"{name}, ATE {row[name]['ate_mm']:.0f} mm", T) for name, T in found.items() if name != "zero"]
        figure = viz.from_above_figure(
            [*panels, ("reference", sequence.T_world_camera)], sequence.points, sequence.mask
        )
        viz.save_figure(figure, folder / f"map_{trajectory}.png", dpi=110)
    return row


def summarise(rows: list[dict[str, Any]], methods: tuple[str, ...]) -> dict[str, Any]:
    """Success rates and medians by method."""
    table = {}
    for name in methods:
        values = {key: np.array([row[name][key] for row in rows]) for key in rows[0][name]}
        table[name] = {
            "success": float((values["ate_mm"] < _SUCCESS_MM).mean()),
            "success_100_mm": float((values["ate_mm"] < _CLOSE_MM).mean()),
            "median_ate_mm": float(np.median(values["ate_mm"])),
            "median_point_distance_mm": float(np.median(values["point_distance_mm"])),
            "median_run_s": float(np.median(values["run_s"])),
        }
    return {"num_trajectories": len(rows), "methods": table}


def draw_errors(folder: RunFolder, rows: list[dict[str, Any]], methods: tuple[str, ...]) -> None:
    """errors.png."""
    from dpmjax import viz

    panels = {
        title: {name: [row[name][key] for row in rows] for name in methods}
        for title, key in (("ATE, mm", "ate_mm"), ("point distance, mm", "point_distance_mm"))
    }
    viz.save_figure(viz.error_boxes_figure(panels, threshold=_SUCCESS_MM), folder / "errors.png")


def tell(folder: RunFolder, metrics: dict[str, Any]) -> None:
    """The table."""
    print(f"{metrics['num_trajectories']} trajectories; success is an ATE below 450 mm (the paper's), below 100 mm")
    for name, row in metrics["methods"].items():
        print(
            f"{name:17} {100 * row['success']:5.1f} %  {100 * row['success_100_mm']:5.1f} %  median ATE "
            f"{row['median_ate_mm']:7.1f} mm, point distance {row['median_point_distance_mm']:7.1f} mm, "
            f"{row['median_run_s']:.1f} s"
        )
    print(f"results in {folder.path}")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
