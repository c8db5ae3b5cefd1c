"""Compares SLAM on drives: our settings, several agents, and other programs on the same scans.

    python -m experiments.dpm_slam_table path/to/drive another/drive --methods whole KISS-ICP KISS-SLAM small_gicp
    python -m experiments.dpm_slam_table path/to/drive kitti_00.txt kitti_07.txt       towns along real routes
    python -m experiments.dpm_slam_table path/to/drive --methods whole paper "paper, errors up to 2.5 m"
    python -m experiments.dpm_slam_table path/to/drive --methods agents
    python -m experiments.dpm_slam_table path/to/drive --localize 50
    python -m experiments.dpm_slam_table --resume                       go on where the last run stopped

A path is any folder of scans with poses, or a file of poses (TUM, KITTI), along which a town is simulated; scans are
kept in results/simulated. Methods are our settings ("whole", "paper" and parts left out, DeepPointMap Table 2), other
programs (extra `peers`), and "agents". For "agents", the drive is cut into three parts. Three agents map one part each
and join their maps (section 5.3). With --localize, random scans are localized in the saved map of each drive's first
half.

The file rows.csv has ATE, KITTI's t_rel, loops, bytes of the map and mean seconds a scan without compilation. The means
of the first and the last tenth of the scans show the growth of these seconds. A loop is wrong beyond 2 m or 5 degrees.
A scan is a revisit if it is within 5 m (indoors 2 m) of an earlier one after 50 m (15 m) of way. The recall of loops is
the share of revisits with a right loop whose newer end is within 10 m (3 m) along the path. KISS-SLAM joins local maps
of 100 m, and each of its loops counts for all scans of the newer map. The folder drives/ has the trajectory of every
method.
"""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import jax
import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from dpmjax import Model, cli, io, load_map, load_model, metrics, save_map, slam
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from experiments._slam_peers import PEERS, FoundLoop

WHOLE, NETWORK, PAPER, AGENTS = "whole", "network proposes every pose", "paper", "agents"
PAPER_WIDE, WIDE_M = "paper, errors up to 2.5 m", 2.5
NO_OFFSETS = ", without the offset head"
# Our settings; "paper" is section 4 by its own method, with the published limits; "errors up to 2.5 m" suits the
# shipped weights.
SETTINGS = (WHOLE, PAPER, NETWORK, NETWORK + NO_OFFSETS, PAPER_WIDE, PAPER_WIDE + NO_OFFSETS)
# Parts of a drive that is cut, and the share of its length by which a part is longer at each end.
NUM_AGENTS, OVERLAP = 3, 0.05
PRECISIONS = ("float32", "int8")
# Where half of the points of the first scan are nearer, the place is indoors.
INDOORS_M = 5.0
COLUMNS = (
    "num_scans", "path_m", "ate_m", "ate_before_loops_m", "t_rel_percent", "num_loops", "num_wrong_loops",
    "loop_recall", "recall_same_way", "recall_opposite", "num_keyframes", "num_maps", "sent_mb", "map_mb",
    "map_int8_mb", "scan_s", "scan_s_first_tenth", "scan_s_last_tenth",
)  # fmt: skip
PLACE_COLUMNS = (
    "num_scans", "num_inside", "num_right", "num_wrong", "num_outside_right", "num_outside_wrong", "median_error_m",
    "map_mb", "scan_s",
)  # fmt: skip
Stop = Callable[[], bool]


@dataclass(frozen=True, kw_only=True)
class SlamTableOptions(cli.DriveOptions):
    """Options of the table."""

    may_change: ClassVar[frozenset[str]] = frozenset({"methods", "localize"})

    paths: Annotated[Positional[tuple[str, ...]], arg(metavar="PATH ...")] = ()
    """Folders of scans, or files of poses along which a town is simulated."""
    methods: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = (WHOLE, NETWORK, "small_gicp")
    """Methods to compare: settings, agents, and KISS-ICP, KISS-SLAM, small_gicp."""
    localize: Annotated[int, arg(metavar="N"), cli.Bound(0)] = 0
    """Number of scans that are looked for in the map of the first half; needs the method whole."""

    def __post_init__(self) -> None:
        """Checks bounds and names."""
        super().__post_init__()
        cli.check_names("--methods", self.methods, (*SETTINGS, AGENTS, *PEERS))
        if not self.paths and not self.resume:
            raise ValueError("give at least one folder of scans, or file of poses")
        if self.localize and WHOLE not in self.methods:
            raise ValueError(f"--localize looks for scans in the map of {WHOLE}: name it among the methods")


def main(options: SlamTableOptions, run: cli.Run) -> cli.Row:
    """Makes the rows of drives and methods that are missing, and writes the tables."""
    model = load_model(options.weights)
    for name in set(options.methods) & set(PEERS):
        cli.require_importable(PEERS[name][0], f"--methods {name}")
    drives = {drive.name: drive for drive in open_drives(options)}
    run.open()

    def work(drive: str, method: str) -> cli.Row | None:
        folder, sequence, stop = folder_of(run, drive, method), drives[drive], lambda: run.is_stopped
        row: cli.Row | None
        if method == AGENTS:
            row = map_by_agents(folder, sequence, slam.make_methods(model))
        elif method in PEERS:
            row = map_by_peer(folder, sequence, stop, method)
        else:
            row = map_by_setting(folder, sequence, stop, make_setting(model, method))
        return None if row is None else dict.fromkeys((*COLUMNS, "version")) | row

    cases = [{"drive": name, "method": method} for name in drives for method in options.methods]
    rows = cli.fill_table(run, cases, work)
    numbers = {"weights": options.weights} | cli.write_summary(run, cli.summarize(rows, ("drive", "method"), COLUMNS))
    if not options.localize or run.is_stopped:
        return numbers

    def localize(drive: str, precision: Any) -> cli.Row:
        return localize_scans(folder_of(run, drive, WHOLE), drives[drive], model, precision, options)

    mapped = [row["drive"] for row in rows if row["method"] == WHOLE and row["map_mb"] and row["ate_m"] is not None]
    places = [{"drive": name, "precision": precision} for name in mapped for precision in PRECISIONS]
    found = cli.summarize(cli.fill_table(run, places, localize, "places.csv"), ("drive", "precision"), PLACE_COLUMNS)
    return numbers | cli.write_summary(run, found, name="places")


def folder_of(run: cli.Run, drive: str, method: str) -> Path:
    """Returns the folder of a method on a drive."""
    return run / "drives" / drive.replace("/", "-") / method.replace(",", "")


def make_setting(model: Model, setting: str) -> slam.SlamMethods:
    """Returns the methods of one of `SETTINGS`."""
    if setting.endswith(NO_OFFSETS):
        decoder = replace(model.config.decoder, predicts_offsets=False)
        model = replace(model, config=replace(model.config, decoder=decoder))
    config, setting = slam.SlamConfig(), setting.removesuffix(NO_OFFSETS)
    if setting == NETWORK:
        config = replace(config, odometry=replace(config.odometry, proposer="network"))
    if setting in (PAPER, PAPER_WIDE):
        limits = slam.DescriptorConfig() if setting == PAPER else slam.DescriptorConfig(max_rmse_m=WIDE_M)
        config = replace(slam.slam_preset("paper"), descriptors=limits)
    return slam.make_methods(model, config)


def open_drives(options: SlamTableOptions) -> list[LidarSequence]:
    """Opens the drives that are compared; bad input is a `ValueError`."""
    drives: list[LidarSequence] = []
    for entry in options.paths:
        names: list[str | None] = io.list_lidar_sequences(entry) or [None]
        drives += [cli.with_reference_only(cli.open_drive(Path(entry), options, name)) for name in names]
    cli.check_names_differ(drives)
    return drives


def map_by_setting(folder: Path, drive: LidarSequence, stop: Stop, methods: slam.SlamMethods) -> cli.Row | None:
    """Maps a drive, or goes on from the state in the folder; None where a signal stops it."""
    mapped, result = cli.map_drive(folder, cli.ScanReader(drive), methods, stop)
    if len(mapped.reports) < len(drive):
        return None
    row = measure_trajectory(folder, drive, result.T_world_scan, found_loops(result.loops, result.keyframes))
    before = metrics.trajectory_errors(result.T_odometry_scan, drive.T_world_lidar)
    row |= {"ate_before_loops_m": before.get("ate_m"), "num_keyframes": len(result.keyframes)}
    for name, precision in (("map_mb", "float32"), ("map_int8_mb", "int8")) if len(result.map) else ():
        row[name] = save_map(folder / f"map_{precision}.npz", result.map, precision).stat().st_size / 1e6
    return row | mean_seconds(mapped.scan_s)


def map_by_agents(folder: Path, drive: LidarSequence, methods: slam.SlamMethods) -> cli.Row:
    """Lets agents map the parts of a drive, and joins their maps; the ATE is that in their one frame, if they met."""
    parts = cut_drive(drive, NUM_AGENTS, OVERLAP)
    found, starts = slam.run_agents(methods, parts), np.cumsum([0, *map(len, parts)])
    T_world_scan, num_maps = np.concatenate(found.T_world_scan), max(found.component) + 1
    folder.mkdir(parents=True, exist_ok=True)
    for component in range(num_maps):
        save_map(folder / f"map_{component + 1}.npz", found.joined.maps[component])
    cli.write_poses(folder, T_world_scan, frame="T_world_lidar")
    scans = np.concatenate([start + agent.keyframes for start, agent in zip(starts, found.agents, strict=False)])
    loops = found_loops(found.joined.loops, scans)
    row: cli.Row = {"num_scans": len(T_world_scan), "num_loops": len(loops), "num_keyframes": len(scans)}
    if drive.T_world_lidar is not None:
        reference = np.concatenate([part.T_world_lidar for part in parts])
        errors = metrics.trajectory_errors(T_world_scan, reference) if num_maps == 1 else {}
        row |= {"ate_m": errors.get("ate_m"), "num_wrong_loops": int((~are_right(loops, reference)).sum())}
    maps = [agent.map for agent in found.agents]
    sent = [([one.compact for one in each.keyframes], each.vectors, each.T_world_keyframe) for each in maps]
    num_bytes = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(sent))
    return row | {"num_maps": num_maps, "sent_mb": num_bytes / 1e6}


def cut_drive(drive: LidarSequence, num_agents: int, overlap: float) -> list[LidarSequence]:
    """Cuts a drive into parts of one length, each longer by a share of it at both ends (DeepPointMap section 5.3).

    Raises:
        ValueError: fewer scans than agents.
    """
    if (num := len(drive)) < num_agents:
        raise ValueError(f"{drive.name}: {num} scans are too few for {num_agents} agents")
    length, longer = num / num_agents, overlap * num / num_agents
    starts = [max(round(agent * length - longer), 0) for agent in range(num_agents)]
    ends = [min(round((agent + 1) * length + longer), num) for agent in range(num_agents)]
    return [drive.take(slice(start, end)) for start, end in zip(starts, ends, strict=True)]


def map_by_peer(folder: Path, drive: LidarSequence, stop: Stop, name: str) -> cli.Row | None:
    """Runs another program; reading is not timed. A scan without points stays where the last one was."""
    peer = PEERS[name][1](is_indoors=is_indoors(drive))
    taken, scan_s = list[int](), list[float]()
    for number in tqdm(range(len(drive)), desc=f"{drive.name}, {name}", unit=" scans", dynamic_ncols=True):
        if stop():
            return None
        points, begun = drive.read_points(number).astype(np.float64), time.perf_counter()
        if len(points):
            peer.step(points)
            taken.append(number)
        scan_s.append(time.perf_counter() - begun)
    begun = time.perf_counter()
    T_taken, found = peer.finish()
    scan_s[-1] += time.perf_counter() - begun
    rows = np.maximum(np.searchsorted(taken, np.arange(len(drive)), side="right") - 1, 0)
    numbers = np.array(taken)
    loops = [
        FoundLoop(tuple(numbers[list(one.newer)]), tuple(numbers[list(one.older)]), one.T_older_newer) for one in found
    ]
    map_bytes = peer.map_bytes(drive.read_points(number).astype(np.float64) for number in taken)
    row = measure_trajectory(folder, drive, T_taken[rows], loops) | mean_seconds(scan_s)
    map_mb = None if map_bytes is None else map_bytes / 1e6
    return row | {"map_mb": map_mb, "version": importlib.metadata.version(name)}


def is_indoors(drive: LidarSequence) -> bool:
    """Returns True for a drive whose first scan is one of a room."""
    points = drive.read_points(0)
    return bool(len(points) and np.median(np.linalg.norm(points, axis=1)) < INDOORS_M)


def found_loops(loops: Sequence[slam.Loop], scans: np.ndarray) -> list[FoundLoop]:
    """Returns the accepted loops between keyframes, by the numbers of their scans."""
    return [
        FoundLoop((scans[loop.source],) * 2, (scans[loop.target],) * 2, loop.T_target_source)
        for loop in loops
        if loop.status == "accepted" and loop.T_target_source is not None
    ]


def measure_trajectory(folder: Path, drive: LidarSequence, T_world_scan: np.ndarray, loops: list[FoundLoop]) -> cli.Row:
    """Writes a trajectory; returns its errors, how many loops are wrong, and the recall of the right ones."""
    folder.mkdir(parents=True, exist_ok=True)
    cli.write_poses(folder, T_world_scan, times=drive.times, frame="T_world_lidar")
    reference, row = drive.T_world_lidar, {"num_scans": len(T_world_scan), "num_loops": len(loops)}
    if reference is None:
        return row | {"path_m": float(metrics.path_lengths(T_world_scan)[-1])}
    distance_m, min_path_m, reach_m = (2.0, 15.0, 3.0) if is_indoors(drive) else (5.0, 50.0, 10.0)
    is_right, errors = are_right(loops, reference), metrics.trajectory_errors(T_world_scan, reference)
    newer = np.reshape([loop.newer for loop in loops], (-1, 2)).astype(int)
    revisits = metrics.find_revisits(reference, distance_m=distance_m, min_path_m=min_path_m)
    recall = metrics.loop_recall(reference, newer[is_right], revisits, reach_m=reach_m)
    return row | {
        "path_m": float(metrics.path_lengths(reference)[-1]),
        "ate_m": errors.get("ate_m"),
        "t_rel_percent": errors.get("t_rel_percent"),
        "num_wrong_loops": int((~is_right).sum()),
        "loop_recall": recall.recall,
        "recall_same_way": recall.same_way,
        "recall_opposite": recall.opposite,
    }


def are_right(loops: Sequence[FoundLoop], T_world_scan: np.ndarray) -> np.ndarray:
    """Returns True for the loops whose motion is that of the true poses, within 2 m and 5 degrees."""
    newer, older = (T_world_scan[[getattr(loop, end)[0] for loop in loops]] for end in ("newer", "older"))
    found = np.reshape([loop.T_older_newer for loop in loops], (-1, 4, 4))
    return np.asarray(metrics.registration_recall(found, rigid.inverse(older) @ newer).is_right)


def mean_seconds(scan_s: Sequence[float]) -> cli.Row:
    """Returns the mean seconds of a scan: of all, of the first tenth and of the last; none without scans."""
    if not scan_s:
        return {}
    tenths = [float(part.mean()) for part in np.array_split(np.asarray(scan_s), 10) if len(part)]
    return {"scan_s": float(np.mean(scan_s)), "scan_s_first_tenth": tenths[0], "scan_s_last_tenth": tenths[-1]}


def localize_scans(
    folder: Path, drive: LidarSequence, model: Model, precision: Any, options: SlamTableOptions
) -> cli.Row:
    """Looks for random scans of the drive in the map of its first half, saved and loaded at a precision.

    No scan is one of its keyframes. A scan is in the map where a keyframe of the first half is near; elsewhere the
    right answer is that it is not.
    """
    whole = load_map(folder / "map_float32.npz")
    num_early = sum(keyframe.scan < len(drive) / 2 for keyframe in whole.keyframes)
    half = slam.take_keyframes(whole, range(max(num_early, 1)))
    path = save_map(folder / f"first_half_{precision}.npz", half, precision)
    slam_map, taken = load_map(path), [keyframe.scan for keyframe in half.keyframes]
    # A map at int8 keeps fewer keyframes.
    kept = [keyframe.scan for keyframe in slam_map.keyframes]
    others = np.setdiff1d(np.arange(len(drive)), taken)
    rng = np.random.default_rng(options.seed)
    chosen = np.sort(rng.choice(others, min(options.localize, len(others)), replace=False))
    bar, begun = tqdm(chosen, desc=f"{drive.name}, {precision}", unit=" scans"), time.perf_counter()
    found = list(slam.localize_each(slam.make_methods(model), slam_map, (drive.read_points(int(row)) for row in bar)))
    scan_s = (time.perf_counter() - begun) / max(len(found), 1)
    T, row = drive.T_world_lidar, dict.fromkeys(PLACE_COLUMNS, 0) | {"num_scans": len(found)}
    errors_m: list[float] = []
    for one, T_scan in zip(found, T[chosen], strict=True):
        apart_m = np.linalg.norm(T[taken, :3, 3] - T_scan[:3, 3], axis=1).min()
        is_inside = apart_m <= (3.0 if is_indoors(drive) else 10.0)
        row["num_inside"] += int(is_inside)
        if one.is_in_map:
            error_m = localization_error(one, slam_map, T[kept], T_scan)
            errors_m += [] if error_m is None else [error_m]
            row[f"num_{'' if is_inside else 'outside_'}{'wrong' if error_m is None else 'right'}"] += 1
    median_m = float(np.median(errors_m)) if errors_m else None
    return row | {"median_error_m": median_m, "map_mb": path.stat().st_size / 1e6, "scan_s": scan_s}


def localization_error(
    found: slam.Localization, slam_map: slam.KeyframeMap, T_keyframe: np.ndarray, T_scan: np.ndarray
) -> float | None:
    """Returns the error of a found scan in the frame of its keyframe, metres; None beyond 2 m and 5 degrees.

    Args:
        found: the result.
        slam_map: the map.
        T_keyframe: (k, 4, 4) reference poses of all keyframes.
        T_scan: (4, 4) reference pose of the scan, in the same world.
    """
    T = rigid.inverse(slam_map.T_world_keyframe[found.keyframe]) @ found.T_world_scan
    recall = metrics.registration_recall(T[None], (rigid.inverse(T_keyframe[found.keyframe]) @ T_scan)[None])
    return float(recall.translation_errors_m[0]) if recall.is_right[0] else None


if __name__ == "__main__":
    cli.run_experiment(main)
