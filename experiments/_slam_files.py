"""The files of a SLAM run: trajectories, graph, tables of scans and loops, the thinned map, the pictures."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from tqdm import tqdm

from dpmjax.io.files import write_atomically

if TYPE_CHECKING:
    from dpmjax.sequences import LidarSequence
    from dpmjax.slam import Loop, ScanReport, SlamResult

MAP_VOXEL_M, MAX_MAP_POINTS = 0.2, 3_000_000
MAP_RANGES_M = (2.0, 60.0)


class Cloud(NamedTuple):
    """A thinned map.

    Attributes:
        points: (n, 3) in the world, m.
        heights_m: (n,) above the lidar that saw the point.
        voxel_m: one point was kept in each voxel of this side.
    """

    points: np.ndarray
    heights_m: np.ndarray
    voxel_m: float


def write_trajectory(
    folder: Path, T_world_scan: np.ndarray, times: np.ndarray | None, name: str = "trajectory"
) -> None:
    """Writes a trajectory as TUM, KITTI and npy."""
    from dpmjax import io as dpm_io

    dpm_io.write_poses_npy(folder / f"{name}.npy", T_world_scan)
    dpm_io.write_tum(folder / f"{name}_tum.txt", T_world_scan, times=times, frame="T_world_lidar")
    dpm_io.write_kitti(folder / f"{name}_kitti.txt", T_world_scan)


def write_graph(folder: Path, result: SlamResult) -> None:
    """Writes graph.g2o and keyframes.txt (number and pose of each keyframe)."""
    import dpmjax
    from dpmjax import io as dpm_io

    if result.graph is not None:
        dpmjax.write_g2o(folder / "graph.g2o", result.graph)
    poses = result.state.slam_map.T_world_keyframe
    dpm_io.write_tum(
        folder / "keyframes.txt", poses, times=result.keyframes, frame="T_map_keyframe; stamps are numbers of scans"
    )


def write_loops(path: Path, loops: Sequence[Loop], keyframes: Sequence[int]) -> None:
    """Writes every candidate of a loop, and what became of it."""
    rows = [
        {
            "scan": int(keyframes[loop.source]),
            "other_scan": int(keyframes[loop.target]),
            "found_by": loop.found_by,
            "status": loop.status,
            "overlap": _number(loop.overlap),
            "probability": _number(loop.probability),
            "rmse_m": _number(loop.rmse_m),
        }
        for loop in loops
    ]
    write_table(path, ("scan", "other_scan", "found_by", "status", "overlap", "probability", "rmse_m"), rows)


def write_scans(path: Path, reports: Sequence[ScanReport], keyframes: Sequence[int], sources: Sequence[str]) -> None:
    """Writes how each scan was placed."""
    rows = [
        {
            "scan": report.scan,
            "status": report.status,
            "is_keyframe": int(report.is_keyframe),
            "keyframe_scan": int(keyframes[report.keyframe]) if len(keyframes) else "",
            "score": _number(report.score),
            "probability": _number(report.probability),
            "num_accepted": report.num_accepted,
            "reason": report.reason,
            "source": source,
        }
        for report, source in zip(reports, sources, strict=False)
    ]
    names = (
        "scan",
        "status",
        "is_keyframe",
        "keyframe_scan",
        "score",
        "probability",
        "num_accepted",
        "reason",
        "source",
    )
    write_table(path, names, rows)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[dict[str, Any]]) -> None:
    """Writes a CSV file; it appears whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue())


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def gather_map(scans: Sequence[int], T_world_scan: np.ndarray, read_points: Callable[[int], np.ndarray]) -> Cloud:
    """Reads scans again and puts them into the world, one point a voxel; larger voxels where the map gets too large.

    Args:
        scans: numbers of the scans.
        T_world_scan: (n, 4, 4) poses of all scans.
        read_points: reads a scan by its number.
    """
    from dpmjax.scans.preprocess import first_of_each_voxel

    voxel_m, kept, num_thinned = MAP_VOXEL_M, [np.zeros((0, 4), np.float32)], 0
    for number, scan in enumerate(tqdm(scans, desc="map", unit=" keyframes", dynamic_ncols=True)):
        points, T = read_points(scan).astype(np.float64), T_world_scan[scan]
        ranges = np.linalg.norm(points, axis=1)
        points = points[(ranges > MAP_RANGES_M[0]) & (ranges < MAP_RANGES_M[1])]
        turned = points[first_of_each_voxel(points, voxel_m)] @ T[:3, :3].T
        kept.append(np.column_stack([turned + T[:3, 3], turned[:, 2]]).astype(np.float32))
        # The larger the map, the rarer it is thinned: the work grows with the map only.
        if sum(map(len, kept)) > 2 * num_thinned + 200_000 or number == len(scans) - 1:
            whole = np.concatenate(kept)
            whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
            while len(whole) > MAX_MAP_POINTS:
                voxel_m *= 1.5
                whole = whole[first_of_each_voxel(whole[:, :3], voxel_m)]
            kept, num_thinned = [whole], len(whole)
    whole = np.concatenate(kept)
    return Cloud(whole[:, :3], whole[:, 3], voxel_m)


def write_map(path: Path, cloud: Cloud) -> None:
    """Writes the thinned map, coloured by height."""
    from dpmjax import io as dpm_io
    from dpmjax import viz

    dpm_io.write_ply(path, cloud.points, colors=viz.height_colors(cloud.heights_m))


def draw_pictures(folder: Path, sequence: LidarSequence, result: SlamResult, cloud: Cloud) -> None:
    """Draws trajectory.png and map.png."""
    from dpmjax import viz
    from dpmjax.metrics import align_rigid
    from experiments._slam_numbers import distances_to_reference

    T, odometry = result.T_world_scan, result.T_odometry_scan
    reference = None if sequence.T_world_lidar is None else sequence.T_world_lidar[: len(T)]
    errors = [distances_to_reference(poses, reference) for poses in (T, odometry)]
    labels = [
        name if distance is None else f"{name}, ATE {np.sqrt(np.mean(distance**2)):.2f} m"
        for name, distance in zip(("SLAM", "odometry alone"), errors, strict=True)
    ]
    shown = None
    if reference is not None:
        T_map_reference = align_rigid(reference[:, :3, 3], T[:, :3, 3])
        shown = reference[:, :3, 3] @ T_map_reference[:3, :3].T + T_map_reference[:3, 3]
    accepted = [loop for loop in result.loops if loop.status == "accepted"]
    ends = np.array([result.keyframes[[loop.source, loop.target]] for loop in accepted], np.int64).reshape(-1, 2)
    figure = viz.trajectory_figure(
        f"{sequence.name}: {len(T)} scans",
        viz.Track(labels[0], T[:, :3, 3], errors[0]),
        viz.Track(labels[1], odometry[:, :3, 3], errors[1]) if len(ends) else None,
        shown,
        T[ends, :3, 3],
    )
    viz.save_figure(figure, folder / "trajectory.png")
    title = f"{sequence.name}: {len(result.keyframes)} keyframes"
    viz.save_figure(viz.height_map_figure(title, cloud.points, cloud.heights_m, T[:, :3, 3]), folder / "map.png")
