"""Neighbours: a keyframe is also aligned with keyframes before the last one, so that the map drifts less.

The chain of odometry has one edge a keyframe, and its errors add up. Edges over two to four keyframes hold it
straighter; the pose graph weighs all of them.
"""

from __future__ import annotations

import math

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.scans.plane_information import with_least_covariance
from dpmjax.slam.alignment import Alignment
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.keyframes import KeyframeMap, MapEdge, Pose, are_near, with_edges
from dpmjax.slam.loop_consistency import shares_suffice
from dpmjax.slam.methods import SlamMethods


def join_neighbours(methods: SlamMethods, slam_map: KeyframeMap) -> KeyframeMap:
    """Aligns the newest keyframe with some before the last one, and adds the edges that are believed.

    Args:
        methods: matcher and settings.
        slam_map: with the new keyframe.

    Returns:
        The map after.
    """
    config, row = methods.config.front_end, len(slam_map) - 1
    last = slam_map.keyframes[row]
    edges = []
    for target in range(row - 2, max(row - 2 - config.num_neighbours, -1), -1):
        other = slam_map.keyframes[target]
        start = rigid.inverse(other.T_odometry_keyframe) @ last.T_odometry_keyframe
        is_near = np.linalg.norm(start[:3, 3]) <= config.neighbour_share * last.extent_m
        if other.segment != last.segment or not is_near:
            break
        found = methods.matcher.align_scans(last.description, other.description, start)
        if found is not None and _is_believed(found, start, last.path_m - other.path_m, methods.config):
            floor = methods.config.odometry.floor_m, methods.config.odometry.floor_rad
            information = with_least_covariance(found.information, *floor)
            edges.append(MapEdge(row, target, found.T_map_scan, information, "odometry"))
    return with_edges(slam_map, (*slam_map.edges, *edges)) if edges else slam_map


def _is_believed(found: Alignment, start: Pose, path_m: float, config: SlamConfig) -> bool:
    """Whether the scans agree as loop closure asks, at a motion to which odometry can have drifted."""
    loops, root_m = config.loops, math.sqrt(path_m)
    most_m = loops.consistent_sigmas * loops.drift_m * root_m
    most_rad = loops.consistent_sigmas * loops.drift_rad * root_m
    is_matched = shares_suffice(found.matched_share, found.contradicted_share, loops)
    return is_matched and are_near(start, found.T_map_scan, most_m, most_rad)
