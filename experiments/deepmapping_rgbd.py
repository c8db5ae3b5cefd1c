"""Registers depth images by DeepMapping, many short trajectories at low overlap (DeepMapping section 4.2, figure 9).

    python -m experiments.deepmapping_rgbd                        105 walks through simulated apartments
    python -m experiments.deepmapping_rgbd --walks hard --limit 60
    python -m experiments.deepmapping_rgbd --limit 7 -o out
    python -m experiments.deepmapping_rgbd Home_001_1             walks through a scene of the Active Vision Dataset
    python -m experiments.deepmapping_rgbd rgbd_folder            depth PNG + pose files + intrinsics, in SE(3)
    python -m experiments.deepmapping_rgbd --resume -o out

The simulated apartments follow the dataset's protocol: places 300 mm apart, views every 30 degrees, 8 or 16 views. With
--walks hard, each walk has 16 views of an apartment of its own: moves and turns at once with jitter, depth noise and
missing pixels. Walks on which no motion at all has an ATE below 450 mm are left out. No setting was chosen on them.

Each trajectory is written to rows/ as soon as all methods have done it. The file metrics.json has the share of walks
with an ATE below 450 mm, and of right walks. The paper's threshold is 450 mm; no motion at all meets it on most of its
walks. Right is an ATE below a tenth of the spread of the cameras, turns between neighbours within 2 degrees, and points
within 100 mm. Images of bare walls leave the motion along them open. For hard walks the table also has the share of
right walks among those that the surfaces hold to a tenth of the spread (`_rgbd_methods.surface_spread`). The file
errors.png has the box plots, map_K.png some trajectories from above.
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

from dpmjax.cli import (
    RunFolder,
    RunOptions,
    StopFlag,
    check_least,
    do_rows,
    open_run_folder,
    peak_rss_gb,
    recording,
    require_importable,
    run_command,
    write_metrics,
)
from experiments._rgbd_methods import METHODS, errors_of, run_method, spread_of

if TYPE_CHECKING:
    from dpmjax.deepmapping import DeepMappingConfig
    from dpmjax.io import DepthSequence
    from dpmjax.simulation import DepthWalkConfig

EXPERIMENT = "deepmapping_rgbd"
_SUCCESS_MM = 450.0
# What is right: ATE as a share of the spread, turns, distance of points.
_RIGHT_SHARE, _RIGHT_DEG, _RIGHT_MM = 0.1, 2.0, 100.0
# Settings were chosen on apartments below 15; each hard walk has an apartment of its own.
_NUM_APARTMENTS, _FIRST_HELD_OUT = 15, 1000
_HARD_VIEWS = 16


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the comparison."""

    may_change: ClassVar[frozenset[str]] = frozenset({"limit", "pictures"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """A scene of the Active Vision Dataset, or a folder of NAME.depth.png; without it, simulated apartments."""
    walks: Literal["paper", "hard"] = "paper"
    """Which simulated walks."""
    limit: Annotated[int, arg(metavar="N")] = 105
    """Trajectories."""
    methods: tuple[str, ...] = ("zero", "placed", "deepmapping", "deepmapping-cold", "direct")
    """What to compare; also placed-no-prior, icp, deepmapping-icp and multiway (Open3D, extra `baselines`)."""
    preset: Literal["fast", "paper"] = "fast"
    """fast: seconds a trajectory; paper: its networks and sampling, for a GPU."""
    motion: Literal["auto", "planar", "full"] = "auto"
    """planar: x, z and an angle, as in the paper; full: SE(3); auto: as the data say."""
    views: Annotated[int, arg(metavar="N")] = 0
    """Images a trajectory; 0: 8 and 16 in turn, 16 of hard walks."""
    window_step: Annotated[int, arg(metavar="N")] = 0
    """Windows of a folder begin so many images apart; 0: half their length."""
    pictures: Annotated[int, arg(metavar="N")] = 4
    """Trajectories to draw from above."""

    @property
    def is_hard(self) -> bool:
        """Returns whether the walks are the hard ones."""
        return self.data is None and self.walks == "hard"

    def __post_init__(self) -> None:
        """Checks ranges."""
        if self.limit < 1:
            raise ValueError(f"--limit: expected at least 1, got {self.limit}")
        if self.views != 0 and self.views < 2:
            raise ValueError(f"--views: expected 0 or at least 2, got {self.views}")
        check_least(self, window_step=0)
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise ValueError(f"--methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")


def main(config: Config) -> dict[str, Any]:
    """Runs the missing cases, then writes the table and the pictures."""
    if "multiway" in config.methods:
        require_importable("open3d", "--methods multiway")
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
    """The requested number, and of a folder of images at most the number of windows."""
    from dpmjax import io

    if config.data is None or io.is_active_vision(config.data):
        return config.limit
    count, views = len(io.read_pose_folder(config.data)), config.views or 8
    return min(config.limit, max(1, (count - views) // _window_step(config, views) + 1))


def _window_step(config: Config, views: int) -> int:
    return config.window_step or views // 2


def read_trajectory(config: Config, index: int) -> DepthSequence:
    """One trajectory; of a folder of images a window."""
    from dpmjax import io, simulation

    views = config.views or (8 if index % 2 == 0 else 16)
    seed = 1000 * config.seed + index
    if config.is_hard:
        return _hard_walk(config, index, simulation.HARD_WALK)
    if config.data is None:
        return simulation.simulate_depth_sequence(seed % _NUM_APARTMENTS, views, seed=seed)
    if io.is_active_vision(config.data):
        return io.read_active_vision(config.data, views, seed=seed)
    sequence, views = io.read_pose_folder(config.data), config.views or 8
    if sequence.T_world_camera is None:
        raise ValueError(f"{config.data}: has no pose files, so nothing to compare to")
    begin = index * _window_step(config, views)
    window = sequence.take(slice(begin, begin + views))
    return replace(window, name=f"{sequence.name}, images {begin} to {begin + len(window) - 1}")


def walk_surface_spread(config: Config, index: int) -> float:
    """Returns the spread of a hard walk that the surfaces leave, mm; its images without noise are those of the same
    seed.
    """
    from dpmjax import simulation
    from experiments._rgbd_methods import surface_spread

    hard = simulation.HARD_WALK
    clean = replace(hard, depth_noise_m=0.0, dropout_share=0.0)
    return surface_spread(_hard_walk(config, index, clean), hard.depth_noise_m)


def _hard_walk(config: Config, index: int, walk: DepthWalkConfig) -> DepthSequence:
    from dpmjax import simulation

    seed = 1000 * config.seed + index
    apartment, views = _FIRST_HELD_OUT + seed, config.views or _HARD_VIEWS
    return simulation.simulate_depth_sequence(apartment, views, seed=seed, config=walk)


def fit_settings(config: Config, sequence: DepthSequence) -> DeepMappingConfig:
    """The preset, with the motion of the data."""
    from dpmjax.deepmapping import preset

    is_planar = sequence.is_planar if config.motion == "auto" else config.motion == "planar"
    return preset(config.preset, "depth", motion="planar" if is_planar else "full")


def run_one(trajectory: int, *, folder: RunFolder, config: Config, settings: DeepMappingConfig) -> dict[str, Any]:
    """All methods on one trajectory; a fit from the result of another method is timed without that method.

    The first `run_s` of each number of images contains its compilation.

    Args:
        trajectory: its number.
        folder: folder of the run; gets the pictures.
        config: options.
        settings: settings of DeepMapping.

    Returns:
        The rest of the row.
    """
    sequence = read_trajectory(config, trajectory)
    found: dict[str, NDArray[np.float64]] = {}
    row: dict[str, Any] = {"name": sequence.name, "views": len(sequence), "spread_mm": spread_of(sequence)}
    if config.is_hard:
        row["surface_spread_mm"] = walk_surface_spread(config, trajectory)
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
    table: dict[str, dict[str, float | None]] = {}
    spread_mm = np.array([row["spread_mm"] for row in rows])
    is_held = None
    if "surface_spread_mm" in rows[0]:
        is_held = np.array([row["surface_spread_mm"] for row in rows]) < _RIGHT_SHARE * spread_mm
    for name in methods:
        values = {key: np.array([row[name][key] for row in rows]) for key in rows[0][name]}
        is_right = (values["ate_mm"] < _RIGHT_SHARE * spread_mm) & (values["point_distance_mm"] < _RIGHT_MM)
        is_right &= values["largest_turn_error_deg"] < _RIGHT_DEG
        table[name] = {
            "success": float((values["ate_mm"] < _SUCCESS_MM).mean()),
            "right": float(is_right.mean()),
            "median_ate_mm": float(np.median(values["ate_mm"])),
            "median_point_distance_mm": float(np.median(values["point_distance_mm"])),
            "median_run_s": float(np.median(values["run_s"])),
        }
        if is_held is not None:
            table[name]["right_of_held"] = float(is_right[is_held].mean()) if is_held.any() else None
    held = {} if is_held is None else {"num_held_by_surfaces": int(is_held.sum())}
    return {"num_trajectories": len(rows), **held, "methods": table}


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
    right = f"below {_RIGHT_SHARE:.0%} of the spread, turns {_RIGHT_DEG:g} degrees, points {_RIGHT_MM:g} mm"
    print(f"{metrics['num_trajectories']} trajectories; ATE below 450 mm (the paper's); right: ATE {right}")
    if "num_held_by_surfaces" in metrics:
        print(f"the surfaces hold {metrics['num_held_by_surfaces']} of them to a tenth of the spread")
    for name, row in metrics["methods"].items():
        of_held = row.get("right_of_held")
        print(
            f"{name:17} {100 * row['success']:5.1f} %  right {100 * row['right']:5.1f} %  "
            f"{'' if of_held is None else f'({100 * of_held:.0f} % of the held)  '}median ATE "
            f"{row['median_ate_mm']:7.1f} mm, point distance {row['median_point_distance_mm']:7.1f} mm, "
            f"{row['median_run_s']:.1f} s"
        )
    print(f"results in {folder.path}")


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, name=EXPERIMENT, description=__doc__))
