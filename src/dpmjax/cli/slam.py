"""Makes one map of a drive of 3-D lidar scans: odometry, loop closure, pose graph (DeepPointMap, section 4).

    dpmjax slam                                         a simulated town, once round and on
    dpmjax slam path/to/drive -o out                    KITTI, KITTI-360, MulRan, any folder of scans
    dpmjax slam route.txt                               a town simulated along a trajectory (poses as TUM or KITTI)
    dpmjax slam drive.bag --topic /points               a bag of ROS 1 or 2 (.bag, .mcap, a folder; extra ros)
    dpmjax slam kitti/dataset --sequence 07 -n 500      the first 500 scans of a sequence
    dpmjax slam day2 --map results/slam/latest/map.npz  extend the map of an earlier run
    dpmjax slam --resume                                continue the latest run

Results go to results/slam/<time>/ (latest links to the newest): trajectories of every scan as TUM, KITTI and npy,
graph.g2o, keyframes.txt, map.npz, map.ply, trajectory.png, map.png and metrics.json. The tables scans.csv and loops.csv
have the reason of every decision. The file map.npz can be extended, and serves `dpmjax localize`. Ctrl-C ends the run
and writes all files too.
"""

from __future__ import annotations

import time
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, io, slam, viz, weights
from dpmjax.cli import slam_files as files
from dpmjax.cli import slam_numbers as numbers
from dpmjax.sequences import InputError, LidarSequence, counted, require

NAME = "slam"


@dataclass(frozen=True, kw_only=True)
class Config(cli.DriveOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"n_scans"})

    data: Annotated[Positional[Path | None], arg(metavar="[DATA]")] = None
    """Folder of scans, a bag of ROS, or a file of poses: a town is simulated along it. Without it: any town."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Which drive, where DATA holds several."""
    map: Annotated[Path | None, arg(metavar="IN")] = None
    """A saved map (map.npz of an earlier run) that this drive extends."""
    preset: Literal["default", "paper"] = "default"
    """Settings of SLAM: the default ones, or the paper's own method, by the decoder alone."""
    odometry: Literal["prediction", "network"] | None = None
    """Source of the first guess of a pose: the motion of before, or the network for every scan; without it, the preset
    decides."""
    max_rmse: float | None = None
    """With --preset paper: largest error of an accepted registration, metres. The published 0.5 needs a decoder with
    exact offsets; 2.5 suits dpm_small."""
    no_loop: FlagCreatePairsOff[bool] = False
    """No loop closure: odometry alone."""
    deskew: FlagCreatePairsOff[bool] = False
    """Undo the motion of the lidar during its turn, by the times of the points (of .pcd .ply .npz) or their azimuth."""
    visualize: Annotated[FlagCreatePairsOff[bool], arg(aliases=["-v"])] = False
    """Show the run in the live viewer (extra viewer); without a screen, OUT gets a recording, slam.rrd."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        self.check_data(self.data, self.sequence)
        if self.preset == "paper" and self.odometry is not None:
            raise ValueError("--odometry: --preset paper has no first guess, give one of the two")
        if self.preset != "paper" and self.max_rmse is not None:
            raise ValueError("--max-rmse: give it with --preset paper")


def main(config: Config) -> None:
    """Maps a drive and writes the results."""
    from dpmjax.cli.slam_run import find_beginning, run_scans

    if config.visualize:
        cli.require_importable("rerun", "-v")
    started = time.perf_counter()
    methods = slam_methods(config)
    # A map of other weights is refused here, before the scans are opened.
    start = slam.init_slam(None if config.map is None else files.open_map(config.map, methods))
    sequence = cli.open_drive(config.data, config, config.sequence)
    reader = cli.ScanReader(sequence, is_deskewed=config.deskew, jump=config.jump)
    beginning = find_beginning(cli.find_run(NAME, config.output) if config.resume else None, methods, start)
    num_done = len(beginning.reports)
    found = f"{counted(num_done, 'scan')} done, {len(sequence)} wanted"
    require(num_done <= len(sequence), sequence.name, found, f"give -n {num_done} or more, or another folder with -o")
    folder = cli.open_run_folder(config, NAME)
    with cli.recording(folder), cli.StopFlag() as stop:
        done = f", {len(beginning.reports)} done before" if beginning.reports else ""
        cli.tell(f"{sequence.name}: {counted(len(sequence), 'scan')}{done}")
        notes = cli.report_notes(sequence.notes)
        viewer = viz.LiveViewer(sequence.name, folder / "slam.rrd") if config.visualize else None
        with nullcontext() if viewer is None else closing(viewer):
            run = run_scans(folder, reader, methods, beginning, lambda: stop.is_requested, viewer)
        result = slam.finish_slam(run.state, run.reports, methods.config)
        drive = MappedDrive(sequence.take(slice(0, len(result.reports))), start, result)
        metrics = write_results(folder, config, drive, run)
        is_interrupted = stop.is_requested or run.failure is not None
        metrics |= {
            **notes,
            "status": numbers.run_status(metrics, is_interrupted),
            "wall_s": time.perf_counter() - started,
        }
        cli.write_metrics(folder, metrics, seed=config.seed)
        cli.tell(f"{numbers.summary(metrics)}\nresults in {folder.path}")
        if run.failure is not None:
            raise run.failure
        failed = numbers.why_failed(metrics["scan_statuses"])
        if failed is not None and not stop.is_requested:
            raise InputError(sequence.name, failed, "check that the scans are 3-D, in metres, and follow each other")


class MappedDrive(NamedTuple):
    """The scans of a run and their poses.

    Attributes:
        sequence: the scans that were placed.
        start: state before the first scan, with the map that the run extends.
        result: trajectory and map.
    """

    sequence: LidarSequence
    start: slam.SlamState
    result: slam.SlamResult

    def read_keyframe(self, row: int) -> np.ndarray:
        """Reads the points of a keyframe; those of the extended map are the points of its surface."""
        if row < len(self.start.slam_map):
            return slam.keyframe_points(self.result.map, row)
        return self.sequence.read_points(self.result.map.keyframes[row].scan - self.start.front_end.num_scans)


def slam_methods(config: Config) -> slam.SlamMethods:
    """Returns the methods of the model."""
    settings = slam.slam_preset(config.preset)
    if config.odometry is not None:
        settings = replace(settings, odometry=replace(settings.odometry, proposer=config.odometry))
    if config.max_rmse is not None:
        settings = replace(settings, descriptors=replace(settings.descriptors, max_rmse_m=config.max_rmse))
    if config.no_loop:
        settings = replace(settings, loops=replace(settings.loops, is_on=False))
    return slam.make_methods(weights.load_model(config.weights), settings, weights=config.weights)


def write_results(folder: cli.RunFolder, config: Config, drive: MappedDrive, run: numbers.SlamRun) -> dict[str, Any]:
    """Writes all files but metrics.json, and returns its numbers; pictures come last."""
    sequence, result, slam_map = drive.sequence, drive.result, drive.result.map
    metrics = {"weights": config.weights, **numbers.run_numbers(run, result, sequence)}
    if not result.reports:
        return metrics
    files.write_trajectory(folder.path, result.T_world_scan, sequence.times)
    files.write_trajectory(folder.path, result.T_odometry_scan, sequence.times, "odometry")
    files.write_graph(folder.path, result)
    files.write_loops(folder / "loops.csv", result.loops, result.keyframes)
    files.write_scans(folder / "scans.csv", result.reports, result.keyframes, sequence.sources)
    if len(slam_map):
        metrics |= files.write_map_file(folder / "map.npz", slam_map)
    # Numbers first, so that they are written even if a picture fails.
    cli.write_metrics(folder, metrics | {"status": "interrupted"}, seed=config.seed)
    cloud = files.gather_map(slam_map.T_world_keyframe, drive.read_keyframe)
    io.write_ply(folder / "map.ply", cloud.points, colors=viz.height_colors(cloud.heights_m))
    files.draw_pictures(folder.path, sequence, result, cloud, len(drive.start.slam_map))
    return metrics | {"map_points": len(cloud.points), "map_voxel_m": cloud.voxel_m}
