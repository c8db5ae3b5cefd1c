"""Makes one map of a drive of 3-D lidar scans: odometry, loop closure, pose graph (DeepPointMap, section 4).

    python -m experiments.dpm_slam                                    a simulated town, once round and on
    python -m experiments.dpm_slam path/to/drive -o out               KITTI, KITTI-360, MulRan, any folder of scans
    python -m experiments.dpm_slam kitti/dataset --sequence 07 -n 500 the first 500 scans of a sequence
    python -m experiments.dpm_slam --resume                           go on where the last run stopped, or was killed

Results go to results/dpm_slam/<time>/ (latest links to the newest): trajectories of every scan as TUM, KITTI and npy,
scans.csv and loops.csv with the reason of every decision, graph.g2o, keyframes.txt, map.ply, trajectory.png, map.png
and metrics.json. Ctrl-C writes all of it. docs/slam.md explains the stages and the files.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import FlagCreatePairsOff, Positional, arg

from experiments._command import StopFlag, check_least, run_command
from experiments._machine import peak_rss_gb
from experiments._run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence
    from dpmjax.slam import JournalContent, SlamMethods, SlamResult
    from experiments._slam_run import SlamRun

EXPERIMENT = "dpm_slam"


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"n_scans"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Folder of scans. Without it: a simulated town of the seed."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Which drive, where DATA holds several."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """Name of a shipped model, or a .safetensors file."""
    no_loop: FlagCreatePairsOff[bool] = False
    """Odometry alone."""
    deskew: FlagCreatePairsOff[bool] = False
    """Undo the motion of the lidar during its turn; for raw scans of a spinning lidar."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Number of scans; a resumed run may take more."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="N")] = 1
    """Use every Nth scan."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, n_scans=1, jump=1, seed=0)
        if self.sequence is not None and self.data is None:
            raise ValueError("--sequence chooses a drive of DATA: give its folder too")


def main(config: Config) -> dict[str, Any]:
    """Reads, maps, writes; returns the content of `metrics.json`."""
    from dpmjax.slam import finish_slam
    from experiments._slam_input import ScanReader, open_drive
    from experiments._slam_run import run_scans

    started = time.perf_counter()
    methods = slam_methods(config)
    sequence = open_drive(config)
    reader = ScanReader(sequence, is_deskewed=config.deskew, jump=config.jump)
    folder = open_run_folder(config, EXPERIMENT)
    earlier = earlier_run(folder, methods, reader)
    with recording(folder), StopFlag() as stop:
        print(f"{sequence.name}: {len(sequence)} scans" + (f", {len(earlier.reports)} done before" if earlier else ""))
        run = run_scans(folder, sequence, reader, methods, earlier, lambda: stop.is_requested)
        result = finish_slam(run.state, run.reports, methods.config)
        metrics = write_results(folder, config, sequence, run, result)
        metrics |= {"is_interrupted": stop.is_requested or run.failure is not None, "peak_rss_gb": peak_rss_gb()}
        metrics["wall_s"] = time.perf_counter() - started
        write_metrics(folder, metrics, seed=config.seed)
        print(summary_of(metrics, folder))
        if run.failure is not None:
            raise run.failure
    return metrics


def slam_methods(config: Config) -> SlamMethods:
    """Returns the methods of the model."""
    from dpmjax import SlamConfig, load_model
    from dpmjax.slam import make_methods

    settings = SlamConfig()
    if config.no_loop:
        settings = replace(settings, loops=replace(settings.loops, is_on=False))
    return make_methods(load_model(config.weights), settings)


def earlier_run(folder: RunFolder, methods: SlamMethods, reader: Any) -> JournalContent | None:
    """Reads what a run has done that is resumed; None for a new one."""
    from dpmjax.slam import read_journal
    from experiments._slam_run import JOURNAL

    if not folder.is_resumed or not (folder / JOURNAL).is_file():
        return None
    return read_journal(folder / JOURNAL, methods, reader)


def write_results(
    folder: RunFolder, config: Config, sequence: LidarSequence, run: SlamRun, result: SlamResult
) -> dict[str, Any]:
    """Writes all files but metrics.json, and returns its numbers; pictures come last."""
    from experiments import _slam_files as files
    from experiments._slam_input import read_points
    from experiments._slam_numbers import run_numbers

    num = len(result.reports)
    times = None if sequence.times is None else sequence.times[:num]
    metrics = {"weights": config.weights, **run_numbers(run, result, sequence)}
    if not num:
        return metrics
    files.write_trajectory(folder.path, result.T_world_scan, times)
    files.write_trajectory(folder.path, result.T_odometry_scan, times, "odometry")
    files.write_graph(folder.path, result)
    files.write_loops(folder / "loops.csv", result.loops, result.keyframes)
    files.write_scans(folder / "scans.csv", result.reports, result.keyframes, sequence.sources)
    write_metrics(folder, metrics, seed=config.seed)  # numbers first: a picture that fails must not cost them
    cloud = files.gather_map(result.keyframes, result.T_world_scan, lambda scan: read_points(sequence, scan))
    files.write_map(folder / "map.ply", cloud)
    files.draw_pictures(folder.path, sequence, result, cloud)
    return metrics | {"map_points": len(cloud.points), "map_voxel_m": cloud.voxel_m}


def summary_of(metrics: dict[str, Any], folder: RunFolder) -> str:
    """Returns the last lines on the console."""
    from experiments._slam_numbers import summary

    return f"{summary(metrics)}\nresults in {folder.path}"


if __name__ == "__main__":
    raise SystemExit(run_command(main, Config, experiment=EXPERIMENT, description=__doc__))
