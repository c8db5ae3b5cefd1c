"""Finds single scans in a saved map without a first guess, or reports that they are not in it.

    dpmjax localize map.npz path/to/scans
    dpmjax localize --resume                 go on where the last run stopped

The map is a file of `dpmjax.save_map`, such as map.npz of `dpmjax slam`. Each scan is searched by itself. Results go to
results/localize/<time>/: localizations.csv (a row for each scan: status, pose, probability, reason), trajectory_tum.txt
(the scans that were found), map.png, metrics.json.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from dpmjax import cli, io, slam, viz, weights

TABLE = "localizations.csv"
POSE = [f"T_map_scan_{row}{column}" for row in range(3) for column in range(4)]
COLUMNS = ("status", "probability", "keyframe", "keyframe_scan", "part", "seconds", *POSE, "reason")
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

    def __post_init__(self) -> None:
        """Checks ranges."""
        super().__post_init__()
        if not self.resume and Path() in (self.map, self.scans):
            raise ValueError("give a map and a folder of scans")


def main(options: LocalizeOptions, run: cli.Run) -> cli.Numbers:
    """Localises the remaining scans, and writes table, trajectory, numbers and picture."""
    model = weights.load_model(options.weights)
    slam_map = cli.open_map(options.map, slam.make_methods(model, weights=options.weights))
    drive = cli.open_drive(options.scans, options, options.sequence)
    run.open(drive.notes)
    num_done = len(run.continue_table(TABLE))
    results = slam.localize_each(model, slam_map, (drive.read_points(i) for i in range(num_done, len(drive))))

    def work(scan: int, source: str) -> cli.Row | None:
        begun = time.perf_counter()
        try:
            return as_row(slam_map, next(results), time.perf_counter() - begun)
        except Exception as error:  # such as a scan that cannot be read
            run.fail(error)
            return None

    cases = [{"scan": number, "source": source} for number, source in enumerate(drive.sources)]
    rows = cli.fill_table(run, cases, work, TABLE)
    found = [row for row in rows if row["status"] == "found"]
    T = np.tile(np.eye(4), (len(found), 1, 1))
    T[:, :3] = np.reshape([[row[name] for name in POSE] for row in found], (-1, 3, 4))
    numbers_found = [row["scan"] for row in found]
    stamps = numbers_found if drive.times is None else drive.times[numbers_found]
    io.write_tum(run / "trajectory_tum.txt", T, times=np.asarray(stamps, float), frame="T_map_scan")
    num_empty, is_calibrated = sum(row["status"] == "empty" for row in rows), model.config.calibration is not None
    text = f"{len(found)} of {len(rows)} scans found"
    if any(row["part"] for row in found):
        text += "; poses in parts of the map that no loop joins to the first have no common frame (column part)"
    text += "" if is_calibrated else "; the probabilities are scores (these weights are not calibrated)"
    if is_failed := bool(rows) and num_empty == len(rows):
        text = f"{num_empty} of {len(rows)} scans without enough points: check that the scans are 3-D and in metres"
    numbers = {
        "status": "failed" if is_failed else "done",
        "verdict": text,
        "num_scans": len(rows),
        "num_found": len(found),
        "num_empty": num_empty,
        "num_keyframes": len(slam_map),
        "is_calibrated": is_calibrated,
        "map_bytes": options.map.stat().st_size,
        "scan_s": float(np.median([row["seconds"] for row in rows])) if rows else None,
    }
    run.write_numbers(numbers)  # also where a picture fails
    title = f"{drive.name} in {options.map.name}: {len(found)} of {len(rows)} scans found"
    figure = viz.localization_figure(map_points(slam_map), slam_map.T_world_keyframe, T, title=title)
    viz.save_figure(figure, run / "map.png")
    return numbers


def as_row(slam_map: slam.KeyframeMap, result: slam.Localization, seconds: float) -> cli.Row:
    """Returns the cells of a scan; the cells of the pose are empty if the scan was not found."""
    row = dict.fromkeys(COLUMNS) | {name: getattr(result, name) for name in ("status", "probability", "reason")}
    row["seconds"] = seconds
    if result.T_world_scan is None or result.keyframe is None:
        return row
    keyframe_scan = slam_map.keyframes[result.keyframe].scan
    row |= {"keyframe": result.keyframe, "keyframe_scan": keyframe_scan, "part": result.part}
    return row | dict(zip(POSE, result.T_world_scan[:3].ravel().tolist(), strict=True))


def map_points(slam_map: slam.KeyframeMap) -> np.ndarray:
    """Returns surface points of the map, thinned at random."""
    poses = enumerate(slam_map.T_world_keyframe)
    points = np.concatenate([slam.keyframe_points(slam_map, row) @ T[:3, :3].T + T[:3, 3] for row, T in poses])
    return points[np.random.default_rng(0).permutation(len(points))[:NUM_MAP_POINTS]]
