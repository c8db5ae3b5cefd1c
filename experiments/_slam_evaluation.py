"""The rows of `dpm_evaluate --slam`: ours, its odometry, and other programs on the same scans, one row each.

A loop is wrong beyond 2 m or 5 degrees. A scan comes back where it is within 5 m (indoors 2 m) of an earlier one after
50 m (15 m) of way. The recall of loops is the share of these scans that have a right loop whose newer end is within
10 m (3 m) along the path. It is the recall at 100 % precision if no loop is wrong. KISS-SLAM joins local maps of
100 m, and each of its loops counts for all scans of the newer one.
"""

from __future__ import annotations

import collections
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax import cli, metrics, save_map
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from dpmjax.saved_maps import Precision
from dpmjax.slam import KeyframeMap, SlamMethods, SlamResult, take_keyframes
from experiments._slam_peers import PEERS, POINT_BYTES, FoundLoop, Peer, is_indoors, peer_version

# Both align with the map of surface elements; the first guess is the motion of before, or the decoder's for every scan.
OURS, NETWORK = "ours, odometry and loops", "ours, the network proposes every pose"
ODOMETRY = "ours, before loops"
PRECISIONS: tuple[Precision, ...] = ("float32", "int8")
# Sizes of maps are measured this number of times during a drive.
NUM_SIZES = 8
# Stages of a run that no other program's time has.
_FILE_STAGES = ("write", "viewer")
# Those, and what odometry alone does without.
_BEYOND_ODOMETRY = (*_FILE_STAGES, "loops")


class Scale(NamedTuple):
    """Lengths of the recall of loops, metres; see the module."""

    distance_m: float = 5.0
    min_path_m: float = 50.0
    reach_m: float = 10.0


INDOOR_SCALE = Scale(2.0, 15.0, 3.0)


class Drive(NamedTuple):
    """A drive and the folder of its results.

    Attributes:
        sequence: the scans.
        run: the open table, in the folder of this drive.
        is_indoors: True if its first scan is one of a room.
    """

    sequence: LidarSequence
    run: cli.TableRun
    is_indoors: bool

    @property
    def folder(self) -> cli.RunFolder:
        """Returns the folder of this drive."""
        return self.run.folder

    @property
    def reference(self) -> np.ndarray | None:
        """Returns the reference poses."""
        return self.sequence.T_world_lidar

    @property
    def scale(self) -> Scale:
        """Returns the lengths of the recall of loops."""
        return INDOOR_SCALE if self.is_indoors else Scale()

    def save_trajectory(self, method: str, T_world_scan: np.ndarray) -> None:
        """Writes the trajectory of a method."""
        cli.write_trajectory(self.folder.path, T_world_scan, self.sequence.times, file_name(method))

    def trajectory(self, method: str) -> np.ndarray:
        """Reads what a method has written."""
        return np.load(self.folder / f"{file_name(method)}.npy")


def open_folder(run: cli.TableRun, sequence: LidarSequence) -> Drive:
    """Makes the folder of a drive."""
    folder = run.folder.part("drives", sequence.name.replace("/", "-"))
    return Drive(sequence, run._replace(folder=folder), is_indoors(sequence.read_points(0)))


def file_name(method: str) -> str:
    """Returns the name of the files of a method."""
    return method.lower().replace(",", "").replace(" ", "_").replace("-", "_")


def evaluate_ours(drive: Drive, methods: SlamMethods) -> cli.Row:
    """Runs the whole system, and writes its files."""
    result, row = map_row(drive, drive.folder, OURS, methods)
    cli.write_loops(drive.folder / "loops.csv", result.loops, result.keyframes)
    cli.write_scans(drive.folder / "scans.csv", result.reports, result.keyframes, drive.sequence.sources)
    drive.save_trajectory(ODOMETRY, result.T_odometry_scan)
    return {**row, **map_sizes(drive.folder.path, result)}


def evaluate_network(drive: Drive, methods: SlamMethods) -> cli.Row:
    """Runs the whole system with the decoder as the source of every first guess (DeepPointMap section 4)."""
    return map_row(drive, drive.folder.part("methods", "network"), NETWORK, with_network(methods))[1]


def with_network(methods: SlamMethods) -> SlamMethods:
    """Returns methods whose decoder is the source of every first guess."""
    odometry = replace(methods.config.odometry, proposer="network")
    return methods._replace(config=replace(methods.config, odometry=odometry))


def map_row(drive: Drive, folder: cli.RunFolder, method: str, methods: SlamMethods) -> tuple[SlamResult, cli.Row]:
    """Maps a drive, or goes on from the state in the folder, and measures trajectory, loops and seconds."""
    run, result = cli.map_drive(folder, drive.sequence, methods, drive.run.is_stopped)
    if len(run.reports) < len(drive.sequence):
        raise cli.RowStopped
    ends = result.keyframes
    found = [
        FoundLoop((ends[loop.source],) * 2, (ends[loop.target],) * 2, loop.T_target_source)
        for loop in result.loops
        if loop.status == "accepted" and loop.T_target_source is not None
    ]
    return result, {
        **common_numbers(drive, method, result.T_world_scan, found),
        "num_keyframes": len(result.keyframes),
        "scan_statuses": dict(collections.Counter(report.status for report in result.reports)),
        "scan_s": _per_scan(run, _FILE_STAGES),
        "scan_odometry_s": _per_scan(run, _BEYOND_ODOMETRY),
        "scan_s_tenths": tenths(run.scan_s) if len(run.scan_s) == len(run.reports) else None,
    }


def _per_scan(run: cli.SlamRun, left_out: tuple[str, ...]) -> float | None:
    """Returns the seconds a scan without those of some stages; None for a run that was resumed at its end."""
    seconds = run.run_s - sum(run.stages_s.get(stage, 0.0) for stage in left_out)
    return seconds / run.num_done if run.num_done else None


def tenths(scan_s: list[float]) -> list[float]:
    """Returns the mean seconds of a scan in each tenth of a drive, which must not grow with the map."""
    return [float(part.mean()) for part in np.array_split(np.asarray(scan_s), 10) if len(part)]


def odometry_row(drive: Drive, ours: cli.Row) -> cli.Row:
    """Measures our odometry in the same run, before loops: its time is that of the run without loops."""
    return common_numbers(drive, ODOMETRY, drive.trajectory(ODOMETRY), []) | {"scan_s": ours["scan_odometry_s"]}


def evaluate_peer(drive: Drive, name: str) -> cli.Row:
    """Runs another program; reading is not timed. A scan without points stays where the last one was."""
    peer: Peer = PEERS[name][1](is_indoors=drive.is_indoors)
    taken: list[int] = []
    seconds: list[float] = []
    num_scans = len(drive.sequence)
    sizes: dict[int, int] = {}
    at = set(size_marks(num_scans))
    bar = tqdm(range(num_scans), desc=f"{drive.sequence.name}, {name}", unit=" scans", dynamic_ncols=True)
    for number in drive.run.until_stopped(bar):
        points = drive.sequence.read_points(number).astype(np.float64)
        clock = time.perf_counter()
        if len(points):
            peer.step(points)
            taken.append(number)
        seconds.append(time.perf_counter() - clock)
        if len(points):
            peer.grow_map(points)
        if number + 1 in at:
            sizes[number + 1] = peer.map_bytes()
    clock = time.perf_counter()
    T, loops = peer.finish()
    finish_s = time.perf_counter() - clock
    rows = np.maximum(np.searchsorted(taken, np.arange(num_scans), side="right") - 1, 0)
    numbers = np.array(taken)
    loops = [
        FoundLoop(tuple(numbers[list(loop.newer)]), tuple(numbers[list(loop.older)]), loop.T_older_newer)
        for loop in loops
    ]
    return {
        **common_numbers(drive, name, T[rows], loops),
        "scan_s": (sum(seconds) + finish_s) / num_scans,
        "scan_s_tenths": tenths(seconds),
        "peer_version": peer_version(name),
        "map_scans": list(sizes),
        f"map_bytes_{peer.map_name}": list(sizes.values()),
    }


def common_numbers(drive: Drive, method: str, T_world_scan: np.ndarray, loops: list[FoundLoop]) -> cli.Row:
    """Writes the trajectory of a method, and returns its errors and those of its loops."""
    drive.save_trajectory(method, T_world_scan)
    known = T_world_scan if drive.reference is None else drive.reference
    return {
        "num_scans": len(T_world_scan),
        "path_m": float(metrics.path_lengths(known)[-1]),
        **cli.trajectory_errors(T_world_scan, drive.reference),
        "num_loops": len(loops),
        **(loop_numbers(drive, loops) if drive.reference is not None else {}),
    }


def loop_numbers(drive: Drive, loops: list[FoundLoop]) -> cli.Row:
    """Returns how many loops are wrong, and the recall of the right ones."""
    poses, scale = drive.reference, drive.scale
    ends = np.reshape([(loop.newer, loop.older) for loop in loops], (-1, 2, 2)).astype(int)
    newer, older = ends[:, 0], ends[:, 1]
    found = np.reshape([loop.T_older_newer for loop in loops], (-1, 4, 4))
    is_right = metrics.registration_recall(found, rigid.inverse(poses[older[:, 0]]) @ poses[newer[:, 0]]).is_right
    revisits = metrics.find_revisits(poses, distance_m=scale.distance_m, min_path_m=scale.min_path_m)
    recall = metrics.loop_recall(poses, newer[is_right], revisits, reach_m=scale.reach_m)
    return {
        "num_wrong_loops": int((~is_right).sum()),
        "loop_recall": recall.recall,
        "loop_recall_same_way": recall.same_way,
        "loop_recall_opposite": recall.opposite,
        "num_revisits": recall.num_revisits,
        "num_revisits_opposite": recall.num_opposite,
    }


def size_marks(num: int) -> np.ndarray:
    """Returns at which counts the size of a map is taken."""
    return np.unique(np.linspace(0, num, NUM_SIZES + 1).round().astype(int)[1:])


def map_sizes(folder: Path, result: SlamResult) -> cli.Row:
    """Returns the bytes of all points and of map files at each precision, on the way; the whole maps stay as files."""
    whole = result.map
    points = np.cumsum([report.num_points for report in result.reports])
    marks = [int(mark) for mark in size_marks(len(whole)) if mark]
    scans = [int(whole.keyframes[mark - 1].scan) + 1 for mark in marks[:-1]] + ([len(points)] if marks else [])
    sizes = {"map_scans": scans, "map_bytes_points": [POINT_BYTES * int(points[s - 1]) for s in scans]}
    for precision in PRECISIONS:
        parts = (first_keyframes(whole, mark) for mark in marks)
        sizes[f"map_bytes_{precision}"] = [map_bytes(folder, part, precision) for part in parts]
    return sizes


def map_bytes(folder: Path, slam_map: KeyframeMap, precision: Precision) -> int:
    """Writes the map at a precision, and returns the size of its file."""
    return save_map(map_path(folder, precision), slam_map, precision).stat().st_size


def map_path(folder: Path, precision: Precision) -> Path:
    """Returns the file of the map at a precision."""
    return folder / f"map_{precision}.npz"


def first_keyframes(slam_map: KeyframeMap, num: int) -> KeyframeMap:
    """Returns the map as it was: the first keyframes, and the edges between them."""
    return take_keyframes(slam_map, range(min(num, len(slam_map))))
