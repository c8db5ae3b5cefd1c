"""Finds single scans in a saved map without a first guess, or reports that they are not in it.

    dpmjax localize map.npz path/to/scans
    dpmjax localize map.npz path/to/scans --map-poses poses.txt    compare with a reference
    dpmjax localize --resume                                       go on where the last run stopped

The map is a file of `dpmjax.save_map`, such as map.npz of `dpmjax slam`. Each scan is searched by itself. Results go to
results/localize/<time>/: localizations.csv (a row for each scan: status, pose, probability, reason), trajectory_tum.txt
(the scans that were found), map.png, metrics.json. To measure errors, the scans need reference poses, and --map-poses
must give the reference poses of the drive that made the map. Both must be in the same world.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, geometry, io, slam, viz, weights
from dpmjax.sequences import LidarSequence

TABLE = "localizations.csv"
POSE = [f"T_map_scan_{row}{column}" for row in range(3) for column in range(4)]
COLUMNS = ("status", "probability", "keyframe", "keyframe_scan", "part", "seconds", *POSE, "reason")
# Largest distance from a keyframe at which a scan is expected in the map.
REACH_M = 15.0
# Motions between keyframes differ by less than this share of their length from those of the right reference.
WRONG_SHARE = 0.5
NUM_MAP_POINTS = 200_000


@dataclass(frozen=True, kw_only=True)
class LocalizeOptions(cli.DriveOptions):
    """Options of the run."""

    map: Annotated[Positional[Path], arg(metavar="MAP", help_behavior_hint="required")] = Path()
    """Map, a file of dpmjax.save_map."""
    scans: Annotated[Positional[Path], arg(metavar="SCANS", help_behavior_hint="required")] = Path()
    """Folder of scans, a bag of ROS, or a file of poses: a town is simulated along it."""
    sequence: Annotated[str | None, arg(aliases=["-s"], metavar="NAME")] = None
    """Name of the drive, if the folder holds several."""
    map_poses: Annotated[Path | None, arg(metavar="FILE")] = None
    """Reference poses of all scans of the drive that made the map, in the world of the scans' reference."""

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        if not self.resume and Path() in (self.map, self.scans):
            raise ValueError("give a map and a folder of scans")


class Case(NamedTuple):
    """Inputs of the comparison.

    Attributes:
        slam_map: the map.
        drive: the scans.
        T_reference_keyframe: (k, 4, 4) reference poses of the keyframes; None without a reference.
        is_calibrated: True for calibrated probabilities; False for scores of the matches.
    """

    slam_map: slam.KeyframeMap
    drive: LidarSequence
    T_reference_keyframe: np.ndarray | None
    is_calibrated: bool


def main(options: LocalizeOptions, run: cli.Run) -> cli.Numbers:
    """Localises the remaining scans, and writes table, trajectory, numbers and picture."""
    model = weights.load_model(options.weights)
    slam_map = cli.open_map(options.map, slam.make_methods(model, weights=options.weights))
    drive = cli.open_drive(options.scans, options, options.sequence)
    case = Case(slam_map, drive, reference_of(options, slam_map, drive), model.config.calibration is not None)
    run.open(drive.notes)
    num_done = len(run.continue_table(TABLE))
    results = slam.localize_each(model, slam_map, (drive.read_points(i) for i in range(num_done, len(drive))))

    def work(scan: int, source: str) -> cli.Row | None:
        begun = time.perf_counter()
        try:
            return as_row(case, next(results), time.perf_counter() - begun)
        except Exception as error:  # such as a scan that cannot be read
            run.fail(error)
            return None

    cases = [{"scan": number, "source": source} for number, source in enumerate(drive.sources)]
    return write_found(run, options, case, cli.fill_table(run, cases, work, TABLE))


def reference_of(options: LocalizeOptions, slam_map: slam.KeyframeMap, drive: LidarSequence) -> np.ndarray | None:
    """Returns the reference poses of the keyframes; raises a `ValueError` if they cannot be used."""
    if options.map_poses is None:
        return None
    if drive.T_world_lidar is None:
        raise ValueError(f"--map-poses: {options.scans} has no reference poses to compare with")
    poses, numbers = io.read_poses(options.map_poses), [keyframe.scan for keyframe in slam_map.keyframes]
    if max(numbers) >= len(poses):
        raise ValueError(f"{options.map_poses}: {len(poses)} poses, the map has a keyframe of scan {max(numbers)}")
    _check_map_poses(options.map_poses, poses[numbers], slam_map)
    return poses[numbers]


def _check_map_poses(path: Path, reference: np.ndarray, slam_map: slam.KeyframeMap) -> None:
    """Raises a `ValueError` if the motions between keyframes are not those of the map."""
    edges = slam_map.edges_of("odometry")
    if not edges:
        return
    source, target = [edge.source for edge in edges], [edge.target for edge in edges]
    moved = geometry.rigid.inverse(reference[target]) @ reference[source]
    measured = np.array([edge.T_target_source for edge in edges])
    errors = geometry.rigid.inverse(moved) @ measured
    errors_m, steps_m = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (errors, measured))
    if np.median(errors_m) > WRONG_SHARE * np.median(steps_m):
        found = f"motions between keyframes differ by {np.median(errors_m):.2g} m from those of the map"
        raise ValueError(f"--map-poses {path}: {found}; give T_world_lidar of each scan that the run has used (--jump)")


def as_row(case: Case, result: slam.Localization, seconds: float) -> cli.Row:
    """Returns the cells of a scan; the cells of the pose are empty if the scan was not found."""
    row = dict.fromkeys(COLUMNS) | {name: getattr(result, name) for name in ("status", "probability", "reason")}
    row["seconds"] = seconds
    if result.T_world_scan is None or result.keyframe is None:
        return row
    keyframe_scan = case.slam_map.keyframes[result.keyframe].scan
    row |= {"keyframe": result.keyframe, "keyframe_scan": keyframe_scan, "part": result.part}
    return row | dict(zip(POSE, result.T_world_scan[:3].ravel().tolist(), strict=True))


def as_localization(row: cli.Row) -> slam.Localization:
    """Returns the result of a row of the table."""
    if row["status"] != "found":
        return slam.Localization(row["status"], None, 0.0, None, "")
    T = np.eye(4)
    T[:3] = np.reshape([row[name] for name in POSE], (3, 4))
    return slam.Localization("found", T, row["probability"], row["keyframe"], row["reason"], part=row["part"])


def write_found(run: cli.Run, options: LocalizeOptions, case: Case, rows: list[cli.Row]) -> cli.Numbers:
    """Writes trajectory and picture; returns the numbers."""
    results = [as_localization(row) for row in rows]
    rows_found = [number for number, result in enumerate(results) if result.is_in_map]
    T = np.array([results[number].T_world_scan for number in rows_found]).reshape(-1, 4, 4)
    stamps = rows_found if case.drive.times is None else case.drive.times[rows_found]
    io.write_tum(run / "trajectory_tum.txt", T, times=np.asarray(stamps, float), frame="T_map_scan")
    errors, is_wrong = error_numbers(case, results)
    found = f"{len(rows_found)} of {len(rows)} scans found"
    if errors:
        found += f"; {errors['num_inside']} are within {REACH_M:g} m of a keyframe; "
        found += f"{errors['num_right']} right, {errors['num_wrong']} wrong"
    if any(result.part for result in results):
        found += "; poses in parts of the map that no loop joins to the first have no common frame (column part)"
    found += "" if case.is_calibrated else "; the probabilities are scores (these weights are not calibrated)"
    num_empty = sum(result.status == "empty" for result in results)
    if is_failed := bool(rows) and num_empty == len(rows):
        found = f"{len(rows)} of {len(rows)} scans without enough points: check that the scans are 3-D and in metres"
    numbers = {
        "status": "failed" if is_failed else "done",
        "verdict": found,
        "num_scans": len(rows),
        "num_found": len(rows_found),
        "num_empty": num_empty,
        "num_keyframes": len(case.slam_map),
        "is_calibrated": case.is_calibrated,
        "map_bytes": options.map.stat().st_size,
        "scan_s": float(np.median([row["seconds"] for row in rows])) if rows else None,
        **errors,
    }
    run.write_numbers(numbers)  # also where a picture fails
    title = f"{case.drive.name} in {options.map.name}: {len(rows_found)} of {len(rows)} scans found"
    figure = viz.localization_figure(
        map_points(case.slam_map), case.slam_map.T_world_keyframe, T, is_wrong=is_wrong, title=title
    )
    viz.save_figure(figure, run / "map.png")
    return numbers


def error_numbers(case: Case, results: list[slam.Localization]) -> tuple[cli.Numbers, np.ndarray | None]:
    """Returns the numbers of right and wrong scans, and True for each found scan with a wrong pose.

    Without a reference there are no numbers, and None.
    """
    reference, drive = case.T_reference_keyframe, case.drive.take(slice(0, len(results)))
    if reference is None or drive.T_world_lidar is None or not results:
        return {}, None
    errors = cli.localization_errors(results, case.slam_map, reference, drive.T_world_lidar)
    is_wrong = (~errors.is_right & drive.has_reference)[errors.is_found]
    num_inside, num_right = int((errors.keyframe_distance_m <= REACH_M).sum()), int(errors.is_right.sum())
    numbers: cli.Numbers = {"num_inside": num_inside, "num_right": num_right, "num_wrong": int(is_wrong.sum())}
    if num_right:
        numbers["median_error_m"] = float(np.median(errors.translation_m[errors.is_right]))
        numbers["median_error_deg"] = float(np.median(errors.rotation_deg[errors.is_right]))
    return numbers, is_wrong


def map_points(slam_map: slam.KeyframeMap) -> np.ndarray:
    """Returns surface points of the map, thinned at random."""
    poses = enumerate(slam_map.T_world_keyframe)
    points = np.concatenate([slam.keyframe_points(slam_map, row) @ T[:3, :3].T + T[:3, 3] for row, T in poses])
    return points[np.random.default_rng(0).permutation(len(points))[:NUM_MAP_POINTS]]
