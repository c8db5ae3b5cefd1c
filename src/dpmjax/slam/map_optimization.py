"""Poses of a whole map that agree best with odometry and loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.keyframe_map import KeyframeMap, MapEdge, as_pose_graph, measured_parts
from dpmjax.slam.loops import LoopState
from dpmjax.types import Poses

# Cost above which the optimisation reduces the weight of a loop edge.
OUTLIER_CHI2 = 25.0

# Smallest weight of a loop edge that stays after the optimisation.
MIN_LOOP_WEIGHT = 0.25

# Number of contradicting loops that would remove an edge of odometry.
CERTAIN = 1e9


def optimize_map(slam_map: KeyframeMap, state: LoopState) -> tuple[KeyframeMap, LoopState]:
    """Optimises all poses, and removes loops that contradict the remaining edges.

    If a loop joins two parts for the first time, one part first moves to the pose that the loop gives. A predicted
    motion is dropped if measured edges join its ends.

    Args:
        slam_map: the map.
        state: its loops.

    Returns:
        The map and the loops after.
    """
    measured, guesses = slam_map.edges_of("odometry"), slam_map.edges_of("guess")
    accepted = [number for number, loop in enumerate(state.loops) if loop.status == "accepted"]
    edges = [state.loops[number].edge for number in accepted]
    T_world_keyframe = move_parts(slam_map.T_world_keyframe, measured_parts(slam_map), edges)
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


def move_parts(T_world_keyframe: Poses, parts: Int[np.ndarray, " k"], edges: Sequence[MapEdge]) -> Poses:
    """Moves whole parts so that one edge between two parts holds exactly, as a start near the solution.

    Args:
        T_world_keyframe: poses of the keyframes.
        parts: number of the part of each keyframe.
        edges: edges within parts and between parts.

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
