"""Makes one map of a drive of 3-D lidar scans: odometry, loop closure, pose graph (DeepPointMap, section 4).

    dpmjax slam                                         a simulated town, once round and on
    dpmjax slam path/to/drive -o out                    KITTI, KITTI-360, MulRan, any folder of scans
    dpmjax slam route.txt                               a town simulated along a trajectory (poses as TUM or KITTI)
    dpmjax slam drive.bag --topic /points               a bag of ROS 1 or 2 (.bag, .mcap, a folder; extra ros)
    dpmjax slam kitti/dataset --sequence 07 -n 500      the first 500 scans of a sequence
    dpmjax slam day2 --map results/slam/latest/map.npz  extend the map of an earlier run
    dpmjax slam monday tuesday --cluster local          several drives or agents at once, their maps merged
    dpmjax slam --resume                                continue the latest run

Results go to results/slam/<time>/ (latest links to the newest): trajectories of every scan as TUM, KITTI and npy,
graph.g2o, covariances.npy, keyframes.txt, map.npz, map.ply, trajectory.png, map.png and metrics.json. The tables
scans.csv and loops.csv have the reason of every decision. The file map.npz can be extended, and serves `dpmjax
localize`. Ctrl-C ends the run and writes all files too.
"""

from __future__ import annotations

from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax import cli, geometry, io, saved_maps, slam, viz, weights
from dpmjax.cli import slam_run
from dpmjax.sequences import LidarSequence, Note, counted, homogeneous, require

PROPOSERS = ("prediction", "network")


@dataclass(frozen=True, kw_only=True)
class SlamOptions(cli.DriveOptions):
    """Options of the run."""

    may_change: ClassVar[frozenset[str]] = frozenset({"n_scans"})

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="[DATA ...]")] = ()
    """Folder of scans, a bag of ROS, or a file of poses: a town is simulated along it. Several with --cluster."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Name of the drive, if DATA holds several."""
    map: Annotated[Path | None, arg(metavar="IN")] = None
    """A saved map (map.npz of an earlier run) that this drive extends."""
    preset: Literal["default", "paper"] = "default"
    """Settings of SLAM: the default, or the method of the paper, by the decoder alone."""
    odometry: Annotated[str | None, arg(metavar="prediction|network|FILE")] = None
    """First guess of a pose: the previous motion, the network, or a file of odometry, by time (TUM) or one pose a scan.
    Poses of the robot's frame need --base-from-lidar."""
    max_rmse: float | None = None
    """With --preset paper: largest error of an accepted registration, m; the published 0.5, or 2.5 for dpm_small."""
    no_loop: FlagCreatePairsOff[bool] = False
    """No loop closure: odometry alone."""
    deskew: FlagCreatePairsOff[bool] = False
    """Undo the motion of the lidar during its turn, by the times of the points (of .pcd .ply .npz) or their azimuth."""
    base_from_lidar: Annotated[tuple[float, ...], arg(metavar="X Y Z QX QY QZ QW")] = ()
    """Pose of the lidar in the robot's frame, metres and quaternion; the run writes the robot's trajectory, too."""
    points_in_base: FlagCreatePairsOff[bool] = False
    """Points and reference poses of DATA are in the robot's frame (Argoverse), not in that of the lidar."""
    cluster: Annotated[str | None, arg(metavar="local|HOST:PORT")] = None
    """Map several drives on workers of this Dask cluster, and merge their maps. local: processes here, one a drive."""
    visualize: Annotated[FlagCreatePairsOff[bool], arg(aliases=["-v"])] = False
    """Show the run in the live viewer (extra viewer). Without a screen, OUT gets a recording, slam.rrd."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        self.check_data(self.data, self.sequence)
        if (len(self.data) > 1) != (self.cluster is not None):
            raise ValueError(f"--cluster: give it with two or more DATA, got {len(self.data)}")
        of_one = self.map, self.sequence, self.base_from_lidar, self.visualize, self.odometry not in (None, *PROPOSERS)
        if self.cluster is not None and any(of_one):
            raise ValueError("--cluster: leave --map, --sequence, --base-from-lidar, -v and --odometry FILE out")
        if self.preset == "paper" and self.odometry in PROPOSERS:
            raise ValueError("--odometry: --preset paper has no first guess, give one of the two")
        if self.preset != "paper" and self.max_rmse is not None:
            raise ValueError("--max-rmse: give it with --preset paper")
        given, norm = self.base_from_lidar, np.linalg.norm(self.base_from_lidar[3:])
        if given and (len(given) != 7 or abs(norm - 1.0) > 0.01):
            raise ValueError(f"--base-from-lidar: expected 3 + 4 numbers, a unit quaternion, got {given}")

        if self.points_in_base and not given:
            raise ValueError("--points-in-base: give --base-from-lidar, too; beams begin at the lidar")

    @property
    def T_base_lidar(self) -> np.ndarray | None:
        """Pose of the lidar in the frame of the robot; None if it was not given."""
        if not self.base_from_lidar:
            return None
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_quat(self.base_from_lidar[3:]).as_matrix()
        return homogeneous(turn, np.array(self.base_from_lidar[:3]))


def main(options: SlamOptions, run: cli.Run) -> cli.Numbers:
    """Maps a drive and writes the results."""
    if options.cluster is not None:
        return map_on_cluster(options, run)
    if options.visualize:
        cli.require_importable("rerun", "-v")
    methods = slam_methods(options)
    # A map of other weights is refused here, before the scans are opened.
    start = slam.init_slam(None if options.map is None else slam_run.open_map(options.map, methods))
    sequence = cli.open_drive(next(iter(options.data), None), options, options.sequence)
    if options.points_in_base and options.T_base_lidar is not None:
        sequence = sequence.from_base(options.T_base_lidar)
    odometry, notes = odometry_of(options, sequence)
    reader = cli.ScanReader(sequence, is_deskewed=options.deskew, jump=options.jump, odometry=odometry)
    beginning = slam_run.find_beginning(run.path if run.is_resumed else None, methods, start)
    num_done = len(beginning.reports)
    found = f"{counted(num_done, 'scan')} done, {len(sequence)} wanted"
    require(num_done <= len(sequence), sequence.name, found, f"give -n {num_done} or more, or another folder with -o")
    run.open((*sequence.notes, *notes))
    run.say(f"{sequence.name}: {counted(len(sequence), 'scan')}" + (f", {num_done} done before" if num_done else ""))
    viewer = viz.LiveViewer(sequence.name, run / "slam.rrd") if options.visualize else None
    with nullcontext() if viewer is None else closing(viewer):
        stop = lambda: run.is_stopped  # noqa: E731
        mapped = slam_run.run_scans(run.path, reader, methods, beginning, stop=stop, viewer=viewer)
    if mapped.error is not None:
        run.fail(mapped.error)
    result = slam.finish_slam(mapped.state, mapped.reports, methods.config)
    placed = sequence.take(slice(0, len(result.reports)))
    scans_per_s = len(mapped.scan_s) / mapped.run_s if mapped.scan_s else None
    numbers = {"weights": options.weights, **slam_run.run_numbers(result, placed), "scans_per_s": scans_per_s}
    numbers |= {"run_s": mapped.run_s, "compile_s": mapped.compile_s}
    if odometry is not None and len(result.reports) > 2:
        numbers |= cli.odometry_numbers(run, odometry[: len(result.reports)], result.T_world_scan, placed)
    if result.reports:
        if options.T_base_lidar is not None:
            poses = options.T_base_lidar @ result.T_world_scan @ geometry.rigid.inverse(options.T_base_lidar)
            cli.write_poses(run.path, poses, "trajectory_base", times=placed.times, frame="T_world_base")
        numbers = write_map_results(run, placed, start, result, numbers)
    if scans_per_s is not None:
        run.say(f"{scans_per_s:.1f} scans/s; compilation took {mapped.compile_s:.0f} s more")
    return numbers


def map_on_cluster(options: SlamOptions, run: cli.Run) -> cli.Numbers:
    """Maps several drives on a cluster, and merges their maps."""
    cli.require_importable("distributed", "--cluster")
    from distributed import Client, LocalCluster

    from dpmjax.cli.fleet import map_drives

    for data in options.data:  # bad input is refused here, before any work
        cli.open_drive(data, options)
    settings = slam_methods(options).config
    run.open()
    with ExitStack() as stack:
        place: Any = options.cluster
        if options.cluster == "local":
            num = min(len(options.data), cli.environment()["num_cores"])
            alone = {"threads_per_worker": 1, "memory_limit": None, "dashboard_address": None}
            place = stack.enter_context(LocalCluster(n_workers=num, **alone))
        client = stack.enter_context(Client(place))
        return map_drives(client, options.data, options, settings, run, is_deskewed=options.deskew)


def slam_methods(options: SlamOptions) -> slam.SlamMethods:
    """Returns the methods of the model."""
    settings = slam.slam_preset(options.preset)
    if options.odometry == "network":
        settings = replace(settings, odometry=replace(settings.odometry, proposer="network"))
    if options.max_rmse is not None:
        settings = replace(settings, descriptors=replace(settings.descriptors, max_rmse_m=options.max_rmse))
    if options.no_loop:
        settings = replace(settings, loops=replace(settings.loops, is_on=False))
    return slam.make_methods(weights.load_model(options.weights), settings, weights=options.weights)


def odometry_of(options: SlamOptions, sequence: LidarSequence) -> tuple[np.ndarray | None, tuple[Note, ...]]:
    """Returns poses of the lidar from --odometry FILE (None without a file), and notes."""
    if options.odometry is None or options.odometry in PROPOSERS:
        return None, ()
    poses, notes = io.read_odometry(options.odometry, sequence)
    return poses if options.T_base_lidar is None else poses @ options.T_base_lidar, notes


def write_map_results(
    run: cli.Run, sequence: LidarSequence, start: slam.SlamState, result: slam.SlamResult, numbers: cli.Numbers
) -> cli.Numbers:
    """Writes all files except metrics.json, pictures last, and returns further numbers for it."""
    slam_map, num_before = result.map, len(start.slam_map)

    def read_keyframe(row: int) -> np.ndarray:
        """Reads the points of a keyframe; a keyframe of the extended map has only the points of its surface."""
        if row < num_before:
            return slam.keyframe_points(slam_map, row)
        return sequence.read_points(slam_map.keyframes[row].scan - start.front_end.num_scans)

    for name, poses in (("trajectory", result.T_world_scan), ("odometry", result.T_odometry_scan)):
        cli.write_poses(run.path, poses, name, times=sequence.times, frame="T_world_lidar")
    if result.graph is not None:
        io.write_g2o(run / "graph.g2o", result.graph)
        np.save(run / "covariances.npy", result.covariances)
    frame = "T_map_keyframe; stamps are numbers of scans"
    io.write_tum(run / "keyframes.txt", slam_map.T_world_keyframe, times=result.keyframes, frame=frame)
    slam_run.write_loops(run / "loops.csv", result.loops, [{"scan": int(scan)} for scan in result.keyframes])
    slam_run.write_scans(run / "scans.csv", result, sequence.sources)
    if len(slam_map):
        numbers = {**numbers, "map_bytes": saved_maps.save_map(run / "map.npz", slam_map).stat().st_size}
    run.write_numbers(numbers)  # also where a picture fails
    cloud = slam_run.gather_map(slam_map.T_world_keyframe, read_keyframe)
    io.write_ply(run / "map.ply", cloud.points, colors=viz.height_colors(cloud.heights_m))
    slam_run.draw_pictures(run, sequence, result, cloud, numbers)
    return {**numbers, "map_points": len(cloud.points), "map_voxel_m": cloud.voxel_m}
