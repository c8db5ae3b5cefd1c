"""Refinement of a map by DeepMapping: keyframes are fitted window by window, and one pose graph joins the windows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import Float

from dpmjax.deepmapping.mapping import register_clouds
from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.keyframes import KeyframeMap, Pose, as_pose_graph, with_edges, with_poses
from dpmjax.types import AnyArray

WINDOW, OVERLAP = 32, 8
"""Number of keyframes of a window, and of those that it shares with the next window."""

OnWindow = Callable[[int, int], None]
"""Called with the number of windows that are done and the number of all windows."""


class RefinedKeyframes(NamedTuple):
    """Keyframes after the refinement.

    Attributes:
        slam_map: the map with refined poses; its edges are those of before.
        num_windows: number of windows.
        num_improved: number of windows whose fit was taken.
    """

    slam_map: KeyframeMap
    num_windows: int
    num_improved: int


def refine_keyframes(
    slam_map: KeyframeMap,
    read_keyframe: Callable[[int], Float[AnyArray, "_n 3"]],
    *,
    key: jax.Array,
    on_window: OnWindow | None = None,
    stop: Callable[[], bool] | None = None,
) -> RefinedKeyframes:
    """Fits the keyframes of each window by DeepMapping, from the poses of SLAM; loops hold the windows together.

    The fit of a window is taken only where planes meet better than before. A fit takes a minute on two cores.

    Args:
        slam_map: the map of a run.
        read_keyframe: reads the points of a keyframe by its row, in metres, in the frame of the lidar.
        key: of the fits.
        on_window: called after each window, for progress.
        stop: called before each window; from the first True on, windows keep their poses.

    Returns:
        The map with refined poses, and the number of windows that became better.
    """
    parts = windows(len(slam_map))
    motions: dict[int, Pose] = {}
    num_improved = 0
    for number, rows in enumerate(parts):
        if len(rows) > 1 and not (stop is not None and stop()):
            found = _fitted_motions(slam_map, rows, read_keyframe, jax.random.fold_in(key, number))
            num_improved += bool(found)
            # A motion that two windows share is that of the window where it is farther from the border.
            first_new = rows.start + OVERLAP // 2
            motions |= {row: motion for row, motion in found.items() if row not in motions or row >= first_new}
        if on_window is not None:
            on_window(number + 1, len(parts))
    return RefinedKeyframes(_with_motions(slam_map, motions) if motions else slam_map, len(parts), num_improved)


def windows(num_keyframes: int) -> list[range]:
    """Divides keyframes into windows; every row is in a window, and neighbouring windows overlap.

    Args:
        num_keyframes: number of keyframes.

    Returns:
        The rows of each window.
    """
    starts = range(0, max(num_keyframes - OVERLAP, 1), WINDOW - OVERLAP)
    return [range(start, min(start + WINDOW, num_keyframes)) for start in starts]


def _fitted_motions(
    slam_map: KeyframeMap, rows: range, read_keyframe: Callable[[int], Float[AnyArray, "_n 3"]], key: jax.Array
) -> dict[int, Pose]:
    """Returns `T_before_keyframe` of each row but the first; none where the fit was not better than its start."""
    clouds = [read_keyframe(row) for row in rows]
    fitted = register_clouds(clouds, key=key, start=slam_map.T_world_keyframe[list(rows)])
    if fitted.kept != "fit":
        return {}
    T = fitted.T_world_scan
    return {row: rigid.inverse(T[place - 1]) @ T[place] for place, row in enumerate(rows) if place}


def _with_motions(slam_map: KeyframeMap, motions: dict[int, Pose]) -> KeyframeMap:
    """Finds the poses that agree best with refined motions between neighbours and with the loops."""
    edges = [
        edge._replace(T_target_source=motions[edge.source])
        if edge.kind == "odometry" and edge.target == edge.source - 1 and edge.source in motions
        else edge
        for edge in slam_map.edges
    ]
    graph = as_pose_graph(with_edges(slam_map, edges))
    return with_poses(slam_map, optimize_pose_graph(graph, PoseGraphConfig(is_chordal_start=False)).graph.poses)
