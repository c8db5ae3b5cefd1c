"""Poses of a whole map: those that agree best with odometry and loops, and their refinement by DeepMapping."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from dpmjax.deepmapping.mapping import register_clouds
from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.keyframe_map import KeyframeMap, MapEdge, as_pose_graph, measured_parts
from dpmjax.slam.loops import LoopState
from dpmjax.types import AnyArray, Pose, Poses

# Cost above which the optimisation reduces the weight of a loop edge.
OUTLIER_CHI2 = 25.0

# Smallest weight of a loop edge that stays after the optimisation.
MIN_LOOP_WEIGHT = 0.25

# Number of contradicting loops that would remove an edge of odometry.
CERTAIN = 1e9

# Number of keyframes of a window of the refinement, and of those that it shares with the next window.
WINDOW, OVERLAP = 32, 8

# Called with the number of windows that are done and the number of all windows.
OnWindow = Callable[[int, int], None]


def optimize_map(slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Optimises all poses, and removes loops that contradict the remaining edges.

    Parts that loops join for the first time are first moved to the pose that a loop gives. A predicted motion is
    dropped where measured edges join its ends.

    Args:
        slam_map: the map.
        state: its loops.

    Returns:
        The map and the loops after.
    """
    measured, guesses = slam_map.edges_of("odometry"), slam_map.edges_of("guess")
    accepted = [number for number, loop in enumerate(state.loops) if loop.status == "accepted"]
    edges = [state.loops[number].edge for number in accepted]
    T_world_keyframe = join_parts(slam_map.T_world_keyframe, measured_parts(slam_map), edges)
    graph = as_pose_graph(replace(slam_map, T_world_keyframe=T_world_keyframe, edges=(*edges, *measured, *guesses)))
    trust = np.full(len(graph.edges.source), CERTAIN)
    trust[: len(edges)] = 1.0
    settings = PoseGraphConfig(outlier_chi2=OUTLIER_CHI2, is_chordal_start=False)
    solved = optimize_pose_graph(graph, settings, trust=trust)
    loops, is_kept = list(state.loops), solved.weights[: len(edges)] >= MIN_LOOP_WEIGHT
    for number in np.array(accepted, int)[~is_kept]:
        loops[number] = loops[number]._replace(status="taken back")
    kept = [edge for edge, stays in zip(edges, is_kept, strict=True) if stays]
    slam_map = replace(slam_map, T_world_keyframe=solved.graph.poses, edges=(*measured, *guesses, *kept))
    return slam_map, LoopState(tuple(loops), len(slam_map))


def join_parts(T_world_keyframe: Poses, parts: Int[np.ndarray, " k"], edges: Sequence[MapEdge]) -> Poses:
    """Moves whole parts, so that one edge between two parts holds exactly: a start near the solution.

    Args:
        T_world_keyframe: poses of the keyframes.
        parts: number of the part of each keyframe.
        edges: edges of which some join parts.

    Returns:
        The poses after.
    """
    T_world, parts = T_world_keyframe.copy(), parts.copy()
    for edge in edges:
        into, moved = parts[edge.target], parts[edge.source]
        if into != moved:
            T_new_world = T_world[edge.target] @ edge.T_target_source @ rigid.inverse(T_world[edge.source])
            rows = parts == moved
            T_world[rows] = T_new_world @ T_world[rows]
            parts[rows] = into
    return T_world


class RefinedKeyframes(NamedTuple):
    """Keyframes after the refinement.

    Attributes:
        slam_map: the map with refined poses; its edges are unchanged.
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
    on_window: OnWindow = lambda done, total: None,
    stop: Callable[[], bool] = lambda: False,
) -> RefinedKeyframes:
    """Fits the keyframes of each window by DeepMapping, from the poses of SLAM; loops hold the windows together.

    The fit of a window is taken only where planes meet better than before. A fit takes a minute on two cores.

    Args:
        slam_map: the map of a run.
        read_keyframe: reads the points of a keyframe by its row, in metres, in the frame of the lidar.
        key: key of the fits.
        on_window: called after each window, for progress.
        stop: called before each window; where it returns True, a window keeps its poses.

    Returns:
        The map with refined poses, and the number of windows that became better.
    """
    parts = _windows_of_parts(slam_map)
    motions: dict[int, Pose] = {}
    num_improved = 0
    for number, rows in enumerate(parts):
        if len(rows) > 1 and not stop():
            clouds = [read_keyframe(row) for row in rows]
            found = _fitted_motions(slam_map, rows, clouds, jax.random.fold_in(key, number))
            num_improved += bool(found)
            # Fits are worst at borders: a motion that two windows share comes from the one where it is farther inside.
            first_new = rows.start + OVERLAP // 2
            motions |= {row: motion for row, motion in found.items() if row not in motions or row >= first_new}
        on_window(number + 1, len(parts))
    return RefinedKeyframes(with_motions(slam_map, motions) if motions else slam_map, len(parts), num_improved)


def _windows_of_parts(slam_map: KeyframeMap) -> list[range]:
    """Divides each run of keyframes whose relative poses are measured; no window has keyframes of two parts."""
    borders = np.flatnonzero(np.diff(measured_parts(slam_map))) + 1
    runs = itertools.pairwise([0, *borders.tolist(), len(slam_map)])
    return [range(start + rows.start, start + rows.stop) for start, end in runs for rows in windows(end - start)]


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
    slam_map: KeyframeMap, rows: range, clouds: Sequence[Float[AnyArray, "_n 3"]], key: jax.Array
) -> dict[int, Pose]:
    """Returns `T_before_keyframe` of each row but the first; none if the fit was not better than its start."""
    fitted = register_clouds(clouds, key=key, start=slam_map.T_world_keyframe[list(rows)])
    if fitted.kept != "fit":
        return {}
    T = fitted.T_world_scan
    return {row: rigid.inverse(T[place - 1]) @ T[place] for place, row in enumerate(rows) if place}


def with_motions(slam_map: KeyframeMap, motions: dict[int, Pose]) -> KeyframeMap:
    """Finds the poses that agree best with refined motions between neighbours and with the loops.

    Args:
        slam_map: the map.
        motions: `T_before_keyframe` of some rows.

    Returns:
        The map with new poses; its edges are unchanged.
    """
    edges = [
        edge._replace(T_target_source=motions[edge.source])
        if edge.kind == "odometry" and edge.target == edge.source - 1 and edge.source in motions
        else edge
        for edge in slam_map.edges
    ]
    graph = as_pose_graph(replace(slam_map, edges=tuple(edges)))
    solved = optimize_pose_graph(graph, PoseGraphConfig(is_chordal_start=False))
    return replace(slam_map, T_world_keyframe=solved.graph.poses)
