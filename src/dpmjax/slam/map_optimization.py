"""Optimisation of a map: poses that agree best with odometry and loops; contradicting loops are removed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from dpmjax.geometry import rigid
from dpmjax.pose_graph.optimize import PoseGraphConfig, optimize_pose_graph
from dpmjax.slam.config import LoopClosureConfig
from dpmjax.slam.keyframes import (
    KeyframeMap,
    MapEdge,
    as_pose_graph,
    connected_parts,
    diagonal_information,
    with_edges,
    with_poses,
)
from dpmjax.slam.reports import Loop, LoopState

OUTLIER_CHI2 = 25.0
"""Cost from which on the optimisation reduces the weight of a loop edge."""

TAKEN_BACK_WEIGHT = 0.25
"""Smallest weight of a loop edge that stays after the optimisation."""

CERTAIN = 1e9
"""Number of contradicting loops that would remove an edge of odometry."""


def optimize_map(slam_map: KeyframeMap, state: LoopState, config: LoopClosureConfig) -> tuple[KeyframeMap, LoopState]:
    """Optimises all poses, and removes loops that contradict the remaining edges.

    Parts that loops join for the first time are first moved to where a loop says. A predicted motion gives way where
    measured ones join its ends.

    Args:
        slam_map: the map.
        state: its loops.
        config: robust kernel.

    Returns:
        The map and the loops after.
    """
    measured = [edge for edge in slam_map.edges if edge.kind == "odometry"]
    earlier = [edge for edge in slam_map.edges if edge.kind == "loop"]
    guesses = [edge for edge in slam_map.edges if edge.kind == "guess"]
    accepted = [number for number, loop in enumerate(state.loops) if loop.status == "accepted"]
    edges = [_loop_edge(state.loops[number], config) for number in accepted]
    parts = connected_parts(len(slam_map), [*measured, *edges])
    held = [edge for edge in guesses if parts[edge.source] != parts[edge.target]]
    apart = connected_parts(len(slam_map), [*measured, *earlier])
    slam_map = with_poses(slam_map, _joined_poses(slam_map.T_world_keyframe, apart, edges))
    graph = as_pose_graph(with_edges(slam_map, [*edges, *measured, *held]))
    trust = np.full(len(graph.edges.source), CERTAIN)
    trust[: len(edges)] = 1.0
    settings = PoseGraphConfig(outlier_chi2=OUTLIER_CHI2, is_chordal_start=False)
    solved = optimize_pose_graph(graph, settings, trust=trust)
    loops = list(state.loops)
    kept = []
    for number, edge, weight in zip(accepted, edges, solved.weights[: len(edges)], strict=True):
        if weight < TAKEN_BACK_WEIGHT:
            loops[number] = loops[number]._replace(status="taken back")
        else:
            kept.append(edge)
    slam_map = with_poses(with_edges(slam_map, [*measured, *guesses, *kept]), solved.graph.poses)
    return slam_map, LoopState(tuple(loops), len(slam_map), False)


def _joined_poses(
    T_world_keyframe: Float[np.ndarray, "k 4 4"], parts: Int[np.ndarray, " k"], edges: Sequence[MapEdge]
) -> Float[np.ndarray, "k 4 4"]:
    """Moves whole parts, so that one edge between two of them holds exactly: the optimisation starts near its end."""
    T_world, parts = T_world_keyframe.copy(), parts.copy()
    for edge in edges:
        into, moved = parts[edge.target], parts[edge.source]
        if into == moved:
            continue
        T_new_world = T_world[edge.target] @ edge.T_target_source @ rigid.inverse(T_world[edge.source])
        rows = parts == moved
        T_world[rows] = T_new_world @ T_world[rows]
        parts[rows] = into
    return T_world


def _loop_edge(loop: Loop, config: LoopClosureConfig) -> MapEdge:
    if loop.T_target_source is None:
        raise ValueError("loop: expected a registered one, got a candidate")
    information = loop.information
    if information is None:
        information = diagonal_information(config.sigma_m, config.sigma_rad)
    return MapEdge(loop.source, loop.target, loop.T_target_source, information, "loop")
