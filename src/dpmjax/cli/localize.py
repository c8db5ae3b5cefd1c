"""Finds single scans in a saved map without a first guess, or says that they are not in it.

    dpmjax localize map.npz path/to/scans
    dpmjax localize map.npz path/to/scans --map-poses poses.txt    compare with a reference
    dpmjax localize --resume                                       go on where the last run stopped

The map is a file of `dpmjax.save_map`, such as a run of dpm_slam writes. Each scan is looked for by itself. Results go
to results/localize/<time>/: localizations.csv (a row a scan: status, pose, probability, reason), trajectory_tum.txt
(the scans that were found), map.png, metrics.json. Where the scans have reference poses, and --map-poses gives those of
the drive that made the map in the same world, the errors are measured too.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from tqdm import tqdm
from tyro.conf import FlagCreatePairsOff, Positional, arg

from dpmjax.cli.command import StopFlag, check_least, run_command
from dpmjax.cli.result_files import HistoryFile, read_history
from dpmjax.cli.run_folder import RunFolder, RunOptions, open_run_folder, recording, write_metrics

if TYPE_CHECKING:
    from dpmjax import KeyframeMap, Localization
    from dpmjax.io import LidarSequence
    from dpmjax.slam.config import MapOrigin

NAME = "localize"
TABLE = "localizations.csv"
POSE = [f"T_map_scan_{row}{column}" for row in range(3) for column in range(4)]
COLUMNS = ["scan", "source", "status", "probability", "keyframe", "keyframe_scan", "seconds", *POSE, "reason"]
MAX_ERROR_M, MAX_ERROR_DEG = 2.0, 5.0
# Scans farther from all keyframes are not expected in the map.
REACH_M = 15.0
NUM_MAP_POINTS = 200_000


@dataclass(frozen=True, kw_only=True)
class Config(RunOptions):
    """Options of the run."""

    map: Annotated[Positional[Path], arg(metavar="MAP", help_behavior_hint="required")] = Path()
    """Map, a file of dpmjax.save_map."""
    scans: Annotated[Positional[Path], arg(metavar="SCANS", help_behavior_hint="required")] = Path()
    """Folder of scans."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Which drive of a folder that holds several."""
    weights: Annotated[str, arg(metavar="NAME|FILE")] = "dpm_small"
    """The weights that made the map: a shipped name or a .safetensors file."""
    kitti_angle_correction: FlagCreatePairsOff[bool] = False
    """Raise the beams by 0.205 degrees, as KITTI's HDL-64E needs."""
    n_scans: Annotated[int | None, arg(aliases=["-n"], metavar="N")] = None
    """Use the first N scans."""
    jump: Annotated[int, arg(aliases=["-j"], metavar="J")] = 1
    """Use every J-th scan."""
    map_poses: Annotated[Path | None, arg(metavar="FILE")] = None
    """Reference poses of all scans of the drive that made the map, in the world of the scans' reference."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        check_least(self, n_scans=1, jump=1, seed=0)
        if not self.resume and Path() in (self.map, self.scans):
            raise ValueError("give a map and a folder of scans")


class Errors(NamedTuple):
    """Errors against the reference.

    Attributes:
        is_inside: (n,) whether a keyframe is near the scan.
        is_found: (n,) whether it was found.
        is_right: (n,) whether it was found within 2 m and 5 degrees.
        translation_m: (n,) NaN where it was not found.
        rotation_deg: (n,) the same.
    """

    is_inside: np.ndarray
    is_found: np.ndarray
    is_right: np.ndarray
    translation_m: np.ndarray
    rotation_deg: np.ndarray


def main(config: Config) -> list[dict[str, str]]:
    """Looks for the scans that are missing, and writes table, trajectory, numbers and picture."""
    from dpmjax import load_map, load_model
    from dpmjax.slam import localize_each, make_methods

    map_ = load_map(config.map)
    drive = open_scans(config)
    T_reference_keyframe = reference_of(config, map_, drive)
    methods = make_methods(load_model(config.weights), map_.origin.config, weights=config.weights)
    check_weights(config, map_, methods.origin)
    folder = open_run_folder(config, NAME)
    path = folder / TABLE
    earlier = read_history(path) if folder.is_resumed and path.exists() else []
    rows: list[dict[str, str]] = list(earlier)
    found = localize_each(map_, (drive.read_scan(i) for i in range(len(rows), len(drive))), methods)
    with (
        recording(folder),
        StopFlag() as stop,
        HistoryFile(path, COLUMNS, keep_until=len(drive) if earlier else None) as table,
        tqdm(total=len(drive), initial=len(rows), unit=" scans", dynamic_ncols=True) as bar,
    ):
        clock = time.perf_counter()
        while len(rows) < len(drive) and not stop.is_requested:
            result = next(found)
            row = as_row(len(rows), drive, map_, result, time.perf_counter() - clock)
            clock = time.perf_counter()
            table.append(**row)
            rows.append(row)
            bar.update(1)
            bar.set_postfix(found=sum(row["status"] == "found" for row in rows))
        print(write_results(folder, config, Case(map_, drive, T_reference_keyframe), rows))
    print(f"results in {folder.path}")
    return rows


class Case(NamedTuple):
    """What was compared.

    Attributes:
        map_: the map.
        drive: the scans.
        T_reference_keyframe: (k, 4, 4) reference poses of the keyframes; None without a reference.
    """

    map_: KeyframeMap
    drive: LidarSequence
    T_reference_keyframe: np.ndarray | None


def open_scans(config: Config) -> LidarSequence:
    """Opens the scans that are asked for, and reads the first one."""
    from dpmjax.cli.slam_input import corrected
    from dpmjax.io import open_lidar_sequence

    drive = open_lidar_sequence(config.scans, sequence=config.sequence, selection=slice(None, None, config.jump))
    drive = corrected(drive.take(slice(0, config.n_scans)), config.kitti_angle_correction)
    drive.read_scan(0)
    return drive


def reference_of(config: Config, map_: KeyframeMap, drive: LidarSequence) -> np.ndarray | None:
    """Returns the reference poses of the keyframes; a `ValueError` says where they cannot be used."""
    from dpmjax.io import read_poses

    if config.map_poses is None:
        return None
    if drive.T_world_lidar is None:
        raise ValueError(f"--map-poses: {config.scans} has no reference poses to compare with")
    poses, numbers = read_poses(config.map_poses), [keyframe.scan for keyframe in map_.keyframes]
    if max(numbers) >= len(poses):
        raise ValueError(f"{config.map_poses}: {len(poses)} poses, the map has a keyframe of scan {max(numbers)}")
    return poses[numbers]


def check_weights(config: Config, map_: KeyframeMap, origin: MapOrigin) -> None:
    """Raises a `ValueError` where other weights made the map."""
    if map_.origin.fingerprint != origin.fingerprint:
        found = f"made with weights {map_.origin}, these are {origin}"
        raise ValueError(f"{config.map}: {found}; name the weights that made it with --weights")


def as_row(
    number: int, drive: LidarSequence, map_: KeyframeMap, result: Localization, seconds: float
) -> dict[str, str]:
    """Returns the row of a scan as text."""
    row = {"scan": str(number), "source": drive.sources[number], "status": result.status, "reason": result.reason}
    row |= {"probability": f"{result.probability:.4f}", "seconds": f"{seconds:.3f}"}
    if result.T_world_scan is None or result.keyframe is None:
        return row | dict.fromkeys((*POSE, "keyframe", "keyframe_scan"), "")
    row |= {"keyframe": str(result.keyframe), "keyframe_scan": str(map_.keyframes[result.keyframe].scan)}
    return row | dict(zip(POSE, (f"{value:.9f}" for value in result.T_world_scan[:3].ravel()), strict=True))


def poses_of(rows: list[dict[str, str]]) -> np.ndarray:
    """Returns (f, 4, 4) poses of the rows that were found."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = np.reshape([[float(row[name]) for name in POSE] for row in rows], (-1, 3, 4))
    return T


def measure_errors(case: Case, rows: list[dict[str, str]]) -> Errors:
    """Compares the pose of each scan in the frame of its keyframe with the reference."""
    from dpmjax.geometry import rigid
    from dpmjax.metrics import registration_recall

    reference = case.T_reference_keyframe
    T_reference_scan = case.drive.T_world_lidar[: len(rows)]
    apart = np.linalg.norm(T_reference_scan[:, None, :3, 3] - reference[None, :, :3, 3], axis=2)
    is_found = np.array([row["status"] == "found" for row in rows])
    is_right, errors = np.zeros(len(rows), bool), np.full((2, len(rows)), np.nan)
    if is_found.any():
        found = [row for row in rows if row["status"] == "found"]
        keyframes = [int(row["keyframe"]) for row in found]
        T = rigid.inverse(case.map_.T_world_keyframe[keyframes]) @ poses_of(found)
        true = rigid.inverse(reference[keyframes]) @ T_reference_scan[is_found]
        recall = registration_recall(T, true, max_translation_m=MAX_ERROR_M, max_rotation_deg=MAX_ERROR_DEG)
        is_right[is_found] = recall.is_right
        errors[:, is_found] = recall.translation_errors_m, recall.rotation_errors_deg
    return Errors(apart.min(axis=1) <= REACH_M, is_found, is_right, *errors)


def write_results(folder: RunFolder, config: Config, case: Case, rows: list[dict[str, str]]) -> str:
    """Writes trajectory, metrics and picture; returns a summary."""
    from dpmjax import io, viz

    found = [row for row in rows if row["status"] == "found"]
    T, numbers = poses_of(found), [int(row["scan"]) for row in found]
    times = case.drive.times
    stamps = numbers if times is None else times[numbers]
    io.write_tum(folder / "trajectory_tum.txt", T, times=np.asarray(stamps, float), frame="T_map_scan")
    metrics: dict[str, Any] = {
        "num_scans": len(rows),
        "num_found": len(found),
        "num_empty": sum(row["status"] == "empty" for row in rows),
        "num_keyframes": len(case.map_),
        "map_bytes": config.map.stat().st_size,
        "scan_s": float(np.median([float(row["seconds"]) for row in rows])) if rows else None,
    }
    text, is_wrong = f"{len(found)} of {len(rows)} scans found", None
    if case.T_reference_keyframe is not None and rows:
        errors = measure_errors(case, rows)
        is_wrong = (errors.is_found & ~errors.is_right)[errors.is_found]
        num_inside, num_right = int(errors.is_inside.sum()), int(errors.is_right.sum())
        metrics |= {"num_inside": num_inside, "num_right": num_right, "num_wrong": int(is_wrong.sum())}
        if num_right:
            metrics["median_error_m"] = float(np.median(errors.translation_m[errors.is_right]))
            metrics["median_error_deg"] = float(np.median(errors.rotation_deg[errors.is_right]))
        text += f"; {num_inside} are within {REACH_M:g} m of a keyframe; {num_right} right, {is_wrong.sum()} wrong"
    write_metrics(folder, metrics, seed=config.seed)
    title = f"{case.drive.name} in {config.map.name}: {text.partition(';')[0]}"
    figure = viz.localization_figure(
        map_points(case.map_), case.map_.T_world_keyframe, T, is_wrong=is_wrong, title=title
    )
    viz.save_figure(figure, folder / "map.png")
    return text


def map_points(map_: KeyframeMap) -> np.ndarray:
    """Returns surface points of the map, thinned at random."""
    clouds = []
    for keyframe, T in zip(map_.keyframes, map_.T_world_keyframe, strict=True):
        surface = keyframe.description.surface
        clouds.append(surface.points * surface.unit_m @ T[:3, :3].T + T[:3, 3])
    points = np.concatenate(clouds)
    return points[np.random.default_rng(0).permutation(len(points))[:NUM_MAP_POINTS]]


def run(args: Sequence[str] | None = None) -> int:
    """Runs the subcommand; returns the exit code."""
    return run_command(main, Config, name=NAME, description=__doc__, args=args)
