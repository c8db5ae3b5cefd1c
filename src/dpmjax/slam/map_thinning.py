"""Thinning of a map for localisation: keyframes that another one covers are left out, and the graph is contracted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from dpmjax.checks import require_positive
from dpmjax.geometry import rigid
from dpmjax.slam.keyframe_map import KeyframeMap, MapEdge, connected_parts, take_keyframes


def thin_map(slam_map: KeyframeMap, *, spacing_share: float = 0.8) -> KeyframeMap:
    """Leaves out keyframes near others, also of other laps, so that repeated drives of a place do not enlarge the map.

    Poses do not change. An edge between keyframes that were left out joins those that cover them; its
    information is divided by the number of steps that it replaces.

    Args:
        slam_map: map of a run.
        spacing_share: smallest distance of joined keyframes, as a share of the extent of the earlier one.

    Returns:
        The smaller map; the first keyframe stays.

    Raises:
        ValueError: if the spacing is not positive.
    """
    require_positive("spacing_share", spacing_share)
    if len(slam_map) == 0:
        return slam_map
    kept, cover = _covering(slam_map, spacing_share)
    row_of = {row: number for number, row in enumerate(kept)}
    edges: dict[tuple[int, int, str], MapEdge] = {}
    for edge in slam_map.edges:
        found = _contracted(slam_map, edge, cover, row_of)
        key = (found.source, found.target, found.kind)
        is_better = key not in edges or np.trace(found.information) > np.trace(edges[key].information)
        if found.source != found.target and is_better:
            edges[key] = found
    return take_keyframes(slam_map, kept, edges.values())


def _covering(slam_map: KeyframeMap, spacing_share: float) -> tuple[list[int], Int[np.ndarray, " k"]]:
    """Returns the rows that stay, and the nearest one of these for each row."""
    extents_m = slam_map.column("extent_m")
    # Parts of a map that no loop has joined have no known distance.
    part = connected_parts(len(slam_map), slam_map.edges_of("odometry", "loop"))

    def apart_m(row: int) -> Float[np.ndarray, " n"]:
        distances = slam_map.distances_to(slam_map.T_world_keyframe[row, :3, 3])[kept]
        return np.where(part[kept] == part[row], distances, np.inf)

    kept: list[int] = []
    for row in range(len(slam_map)):
        if not (apart_m(row) < spacing_share * extents_m[kept]).any():
            kept.append(row)
    return kept, np.array([kept[int(np.argmin(apart_m(row)))] for row in range(len(slam_map))], np.int64)


def _contracted(slam_map: KeyframeMap, edge: MapEdge, cover: Int[np.ndarray, " k"], row_of: dict[int, int]) -> MapEdge:
    """Moves both ends of an edge to the keyframes that cover them."""
    source, target = int(cover[edge.source]), int(cover[edge.target])
    T_world = slam_map.T_world_keyframe
    T_target_end = rigid.inverse(T_world[target]) @ T_world[edge.target]
    T_start_source = rigid.inverse(T_world[edge.source]) @ T_world[source]
    T = T_target_end @ edge.T_target_source @ T_start_source
    num_steps = 1 + (source != edge.source) + (target != edge.target)
    information = _moved_information(edge.information, T_start_source) / num_steps
    return MapEdge(row_of[source], row_of[target], T, information, edge.kind)


def _moved_information(information: Float[np.ndarray, "6 6"], T_old_new: Float[np.ndarray, "4 4"]) -> np.ndarray:
    """Moves an information matrix from the tangent of the old frame to that of the new one."""
    R, t = T_old_new[:3, :3], T_old_new[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    adjoint = np.block([[R, cross @ R], [np.zeros((3, 3)), R]])
    moved = adjoint.T @ information @ adjoint
    return (moved + moved.T) / 2
