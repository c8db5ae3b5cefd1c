"""Refinement of a SLAM trajectory by DeepMapping: keyframes are fitted window by window, and one graph joins them.

`dpm_evaluate --slam --refine` measures it beside Open3D's multiway registration, which begins with the same poses.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import deepmapping
from dpmjax.cli.slam_input import read_points
from dpmjax.cli.slam_run import run_alone
from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam import KeyframeMap, SlamMethods
from dpmjax.slam.keyframes import as_pose_graph, with_edges
from dpmjax.slam.system import place_scans
from experiments._slam_evaluation import Drive, StoppedError, common_numbers

WINDOW, OVERLAP = 32, 8
"""Keyframes of a window, and those that it shares with the next one."""

REFINED, MULTIWAY = "DeepPointMap refined", "multiway registration"


class Refined(NamedTuple):
    """A refined trajectory.

    Attributes:
        T_world_keyframe: (k, 4, 4).
        numbers: what `metrics.json` says of it.
    """

    T_world_keyframe: np.ndarray
    numbers: dict[str, Any]


def windows(num: int) -> list[range]:
    """Returns the rows of each window; all rows are in one, and neighbours overlap."""
    starts = range(0, max(num - OVERLAP, 1), WINDOW - OVERLAP)
    return [range(start, min(start + WINDOW, num)) for start in starts]


def refine_keyframes(
    slam_map: KeyframeMap, read_points: Callable[[int], np.ndarray], *, seed: int, is_stopped: Callable[[], bool]
) -> Refined:
    """Fits the keyframes of each window by DeepMapping, from the poses of SLAM; loops hold the windows together.

    Of each window, the fit is taken only where planes meet better than before.

    Args:
        slam_map: the map after SLAM.
        read_points: reads the points of a keyframe by its row.
        seed: of the fits.
        is_stopped: whether to leave further windows as they are.

    Returns:
        The poses after.
    """
    T = np.array(slam_map.T_world_keyframe)
    motions: dict[int, np.ndarray] = {}
    kept: list[str] = []
    parts = windows(len(slam_map))
    for number, rows in enumerate(tqdm(parts, desc="refine", unit=" windows", dynamic_ncols=True)):
        if is_stopped() or len(rows) < 2:
            kept.append("not tried")
            continue
        clouds = [read_points(row) for row in rows]
        fitted = deepmapping.register_clouds(
            clouds, key=jax.random.fold_in(jax.random.key(seed), number), start=T[list(rows)]
        )
        kept.append(fitted.kept)
        if fitted.kept == "fit":
            fresh = fitted.T_world_scan
            motions |= {
                row: rigid.inverse(fresh[place - 1]) @ fresh[place]
                for place, row in enumerate(rows)
                if place and (row not in motions or place >= OVERLAP // 2)
            }
    numbers = {"refine_windows": len(parts), "refine_windows_improved": kept.count("fit")}
    return Refined(_joined(slam_map, motions) if motions else T, numbers)


def _joined(slam_map: KeyframeMap, motions: dict[int, np.ndarray]) -> np.ndarray:
    """The poses that agree best with refined motions between neighbours and with the loops."""
    edges = []
    for edge in slam_map.edges:
        is_next = edge.kind == "odometry" and edge.target == edge.source - 1
        if is_next and edge.source in motions:
            edge = edge._replace(T_target_source=motions[edge.source])
        edges.append(edge)
    graph = as_pose_graph(with_edges(slam_map, edges))
    return np.asarray(optimize_pose_graph(graph, PoseGraphConfig(is_chordal_start=False)).graph.poses)


def evaluate_refinement(drive: Drive, methods: SlamMethods, method: str, seed: int) -> dict[str, Any]:
    """Polishes the keyframes of our run, which is read from its journal, and measures the poses of all scans."""
    run, result = run_alone(drive.folder, drive.sequence, methods, drive.is_stopped)
    if len(run.reports) < len(drive.sequence):
        raise StoppedError
    slam_map, numbers = result.state.slam_map, {}
    T = slam_map.T_world_keyframe

    def read_keyframe(row: int) -> np.ndarray:
        return read_points(drive.sequence, slam_map.keyframes[row].scan)

    clock = time.perf_counter()
    if method == REFINED:
        T, numbers = refine_keyframes(slam_map, read_keyframe, seed=seed, is_stopped=drive.is_stopped)
    elif len(slam_map) > 1:
        from experiments.baselines.multiway import multiway_clouds

        T = multiway_clouds([read_keyframe(row) for row in range(len(slam_map))], T)
    seconds = time.perf_counter() - clock
    if drive.is_stopped():
        raise StoppedError
    row = common_numbers(drive, method, place_scans(T, run.reports), [])
    return {**row, **numbers, "num_keyframes": len(slam_map), "scan_s": seconds / len(drive.sequence)}
