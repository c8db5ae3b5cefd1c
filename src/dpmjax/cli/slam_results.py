"""Results of SLAM: files, pictures, and numbers with status and verdict. Saved maps are read here, too."""

from __future__ import annotations

import collections
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax import geometry, io, metrics, saved_maps, slam, viz
from dpmjax.cli.run import Numbers
from dpmjax.cli.run_folder import write_table
from dpmjax.sequences import LidarSequence, counted

MAP_VOXEL_M, MAX_MAP_POINTS = 0.2, 3_000_000
MAP_RANGES_M = (2.0, 60.0)
LOOP_COLUMNS = ("found_by", "status", "overlap", "probability", "rmse_m")
SCAN_COLUMNS = (
    "scan", "status", "is_keyframe", "keyframe_scan", "score", "probability", "weak_sigma_m", "num_accepted", "reason",
    "source",
)  # fmt: skip


# Of 120 scans of a sound drive up to five are guessed; 53 blind ones ended metres off.
MAX_GUESSED_SHARE = 0.1

UNSURE = {
    "network": "placed by the network: at the start, or because alignment with the scans before failed",
    "coasting": "where nothing faces the axis of a corridor: the last speed goes on there, uncertain",
    "predicted": "placed by the predicted motion only: uncertain",
    "restarted": "not placed: a new part of the map begins there",
    "empty": "without enough points",
}
"""Texts for scans that were not aligned with the scans before them, by status."""


class Cloud(NamedTuple):
    """A thinned map.

    Attributes:
        points: (n, 3) in the world, m.
        heights_m: (n,) heights above the lidar that measured the point.
        voxel_m: side of a voxel; each voxel has one point.
    """

    points: np.ndarray
    heights_m: np.ndarray
    voxel_m: float


def write_graph(folder: Path, result: slam.SlamResult) -> None:
    """Writes graph.g2o, covariances.npy and keyframes.txt (number and pose of each keyframe)."""
    if result.graph is not None:
        io.write_g2o(folder / "graph.g2o", result.graph)
        np.save(folder / "covariances.npy", result.covariances)
    poses, frame = result.map.T_world_keyframe, "T_map_keyframe; stamps are numbers of scans"
    io.write_tum(folder / "keyframes.txt", poses, times=result.keyframes, frame=frame)


def write_loops(path: Path, loops: Sequence[slam.Loop], ends: Sequence[Mapping[str, int]]) -> None:
    """Writes every candidate of a loop: its two keyframes, its source, its outcome, and the numbers behind it.

    Args:
        path: the file.
        loops: the candidates.
        ends: cells of each keyframe, in the order of the map. Columns of the target begin with `other_`.
    """
    others = [{f"other_{name}": cell for name, cell in end.items()} for end in ends]
    rows = [{**ends[loop.source], **others[loop.target], **loop._asdict(), "rmse_m": loop.rmse} for loop in loops]
    names = [*ends[0], *others[0]] if ends else ["scan", "other_scan"]
    write_table(path, [*names, *LOOP_COLUMNS], rows)


def write_scans(path: Path, result: slam.SlamResult, sources: Sequence[str]) -> None:
    """Writes the reports on the placed scans."""
    rows = []
    for report, source in zip(result.reports, sources, strict=False):
        keyframe = result.keyframes[report.keyframe] if len(result.keyframes) else ""
        named = {"is_keyframe": int(report.is_keyframe), "keyframe_scan": keyframe, "source": source}
        rows.append(report._asdict() | named)
    write_table(path, SCAN_COLUMNS, rows)


def accepted_ends(loops: Sequence[slam.Loop]) -> np.ndarray:
    """Returns (m, 2) rows of the keyframes that accepted loops join."""
    ends = [(loop.source, loop.target) for loop in loops if loop.status == "accepted"]
    return np.array(ends, np.int64).reshape(-1, 2)


def gather_map(T_world_scan: np.ndarray, read_scan: Callable[[int], np.ndarray]) -> Cloud:
    """Transforms scans to the world frame and keeps one point for each voxel; larger maps have larger voxels.

    Args:
        T_world_scan: (n, 4, 4) poses.
        read_scan: reads the points of a scan, in its own frame.

    Returns:
        The points of all scans, thinned.
    """
    from dpmjax.scans.preprocess import first_of_each_voxel

    voxel_m, whole, fresh = MAP_VOXEL_M, np.zeros((0, 4), np.float32), list[np.ndarray]()
    for row, T in enumerate(tqdm(T_world_scan, desc="map", unit=" keyframes", dynamic_ncols=True)):
        points = read_scan(row).astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        points = points[(ranges > MAP_RANGES_M[0]) & (ranges < MAP_RANGES_M[1])]
        turned = points[first_of_each_voxel(points, voxel_m)] @ T[:3, :3].T
        fresh.append(np.column_stack([turned + T[:3, 3], turned[:, 2]]).astype(np.float32))
        # Larger maps are thinned less often, so that the work is linear in the size of the map.
        if row == len(T_world_scan) - 1 or sum(map(len, fresh)) > len(whole) + 200_000:
            whole, fresh = np.concatenate([whole, *fresh]), []
            whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
            while len(whole) > MAX_MAP_POINTS:
                voxel_m *= 1.5
                whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
    return Cloud(whole[:, :3], whole[:, 3], voxel_m)


def draw_pictures(
    folder: Path, sequence: LidarSequence, result: slam.SlamResult, cloud: Cloud, num_keyframes_before: int = 0
) -> None:
    """Draws trajectory.png and map.png."""
    T, slam_map, num_old = result.T_world_scan, result.map, num_keyframes_before
    # Odometry alone begins where the drive begins, also in a map that was there before.
    odometry = T[0] @ geometry.rigid.inverse(result.T_odometry_scan[0]) @ result.T_odometry_scan
    reference, ends = sequence.T_world_lidar, accepted_ends(result.loops)
    tracks = [_track("odometry alone", viz.ODOMETRY, odometry, reference)] if len(ends) else []
    if num_old:
        tracks = [viz.Track(slam_map.T_world_keyframe[:num_old, :3, 3], viz.INK, "the map before", "--"), *tracks]
    tracks.append(_track("SLAM", viz.PATH, T, reference))
    shown, known = None, sequence.has_reference
    if reference is not None and known.any():
        positions = reference[known, :3, 3]
        T_map_reference = metrics.align_rigid(positions, T[known, :3, 3])
        shown = positions @ T_map_reference[:3, :3].T + T_map_reference[:3, 3]
    title = f"{sequence.name}: {counted(len(T), 'scan')}"
    figure = viz.trajectory_figure(title, tracks, shown, slam_map.T_world_keyframe[ends, :3, 3])
    viz.save_figure(figure, folder / "trajectory.png")
    title, num_parts = f"{sequence.name}: {counted(len(result.keyframes), 'keyframe')}", count_parts(slam_map)
    if num_parts > 1:
        title += f", {num_parts} parts at guessed relative poses"
    viz.save_figure(viz.height_map_figure(title, cloud.points, cloud.heights_m, T[:, :3, 3]), folder / "map.png")


def _track(name: str, color: str, T_world_scan: np.ndarray, reference: np.ndarray | None) -> viz.Track:
    errors = metrics.distances_to_reference(T_world_scan, reference)
    label = name if errors is None else f"{name}, ATE {np.sqrt(np.nanmean(errors**2)):.3f} m"
    return viz.Track(T_world_scan[:, :3, 3], color, label)


def open_map(path: Path, methods: slam.SlamMethods) -> slam.KeyframeMap:
    """Reads a saved map.

    Args:
        path: a file of `save_map`.
        methods: methods of the weights that must have made it.

    Returns:
        The map.

    Raises:
        ValueError: the file does not exist, is no map, or is a map of other weights.
    """
    slam_map = saved_maps.load_map(path)
    require_same_weights(path, slam_map, methods, "name the weights that made it with --weights")
    return slam_map


def require_same_weights(path: Path, slam_map: slam.KeyframeMap, methods: slam.SlamMethods, advice: str) -> None:
    """Raises a ValueError with advice if other weights than those of the methods made a map."""
    made_by, given = slam_map.origin, methods.origin
    if made_by is not None and made_by.fingerprint != given.fingerprint:
        raise ValueError(f"{path}: made with weights {made_by}, these are {given}; {advice}")


def run_numbers(result: slam.SlamResult, sequence: LidarSequence) -> Numbers:
    """Returns the numbers of a map for `metrics.json`; the sequence has the scans that were placed."""
    T, reference = result.T_world_scan, sequence.T_world_lidar
    loops = collections.Counter(loop.status for loop in result.loops)
    numbers = {
        "sequence": sequence.name,
        "num_scans": len(T),
        "path_m": float(metrics.path_lengths(T).max(initial=0.0)),
        "reference_doubt": metrics.reference_doubt(T, sequence),
        "num_keyframes": len(result.keyframes),
        "num_new_keyframes": sum(report.is_keyframe for report in result.reports),
        "num_parts": count_parts(result.map),
        "num_loops": loops["accepted"],
        **metrics.trajectory_errors(T, reference),
        **metrics.trajectory_errors(result.T_odometry_scan, reference, "_odometry"),
        "scan_statuses": dict(collections.Counter(report.status for report in result.reports)),
        "loop_statuses": dict(loops),
    }
    return {"status": status_of(numbers), "verdict": verdict_of(numbers), **numbers}


def why_failed(statuses: Mapping[str, int]) -> str | None:
    """Returns the reason why a finished run, with these numbers of scans by status, has no result; or None."""
    num_scans, num_empty = sum(statuses.values()), statuses.get("empty", 0)
    if num_scans and num_empty == num_scans:
        return f"{num_empty} of {counted(num_scans, 'scan')} without enough points, no map was made"
    if num_scans > 1 and not {"tracked", "network", "coasting"} & statuses.keys():
        return f"none of {counted(num_scans, 'scan')} could be aligned with those before, the trajectory is no result"
    return None


def status_of(numbers: Numbers) -> str:
    """Returns the status of a run that came to its end.

    Args:
        numbers: of the run.

    Returns:
        "done", "uncertain" or "failed". A run is uncertain if more than one scan and more than a tenth of all scans
        were not aligned in all directions. It is also uncertain if no loop joins all parts of the map. It failed if no
        scan was aligned.
    """
    statuses = numbers["scan_statuses"]
    if why_failed(statuses) is not None:
        return "failed"
    num_scans = sum(statuses.values())
    num_guessed = num_scans - sum(statuses.get(status, 0) for status in ("first", "tracked", "network"))
    is_sure = numbers["num_parts"] < 2 and num_guessed <= max(1, MAX_GUESSED_SHARE * num_scans)
    return "done" if is_sure else "uncertain"


def count_parts(slam_map: slam.KeyframeMap) -> int:
    """Returns the number of parts of a map that measured motions join."""
    return len(set(slam.measured_parts(slam_map).tolist()))


def verdict_of(numbers: Numbers) -> str:
    """Returns the verdict: the size of the map, and its uncertain or wrong parts."""
    if (reason := why_failed(numbers["scan_statuses"])) is not None:
        return f"{reason}: check that the scans are 3-D, in metres, and follow each other"
    text = f"{counted(numbers['num_scans'], 'scan')}, {numbers['path_m']:.1f} m driven, "
    text += counted(numbers["num_new_keyframes"], "keyframe")
    if numbers["num_keyframes"] > numbers["num_new_keyframes"]:
        text += f" ({numbers['num_keyframes']} in the map)"
    text += f", {counted(numbers['num_loops'], 'loop closure')}"
    for status, reason in UNSURE.items():
        if status in numbers["scan_statuses"]:
            text += f"; {counted(numbers['scan_statuses'][status], 'scan')} {reason} (scans.csv has the reasons)"
    if numbers["num_parts"] > 1:
        text += f"; the map has {numbers['num_parts']} parts that no loop joins; their relative pose is a guess"
    if numbers["reference_doubt"] is not None:
        text += f"; warning: {numbers['reference_doubt']}"
    for suffix, name in (("_odometry", "odometry alone"), ("", "SLAM")):
        if f"ate{suffix}_m" in numbers:
            text += f"; ATE of {name} {numbers[f'ate{suffix}_m']:.3f} m"
    return text
