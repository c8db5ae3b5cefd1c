"""The local map: surface elements of the nearest keyframes and of the scans since the last one.

It is made from the map alone at each keyframe, so that the map is the state of odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import HostTree
from dpmjax.scans.compact import expand_elements
from dpmjax.scans.surfaces import MIN_FLATNESS, Surface
from dpmjax.slam.config import OdometryConfig
from dpmjax.slam.keyframes import KeyframeMap, Pose, nearest_in_graph, turn_rad
from dpmjax.types import SurfaceElements


class PlacedElements(NamedTuple):
    """Surface elements of a scan and its pose.

    Attributes:
        T_map_scan: pose of the scan.
        elements: in the frame of the scan.
    """

    T_map_scan: Pose
    elements: SurfaceElements


class LocalMap(NamedTuple):
    """Surface elements around the last keyframe, in its frame.

    Attributes:
        keyframes: the last keyframe and the nearest others, nearest first.
        compact: descriptors of these keyframes.
        recent: scans since the last keyframe, oldest first.
        surface: the planes of all of them.
    """

    keyframes: tuple[PlacedElements, ...]
    compact: tuple[CompactScan, ...]
    recent: tuple[PlacedElements, ...]
    surface: Surface


def local_map_of(slam_map: KeyframeMap, config: OdometryConfig) -> LocalMap:
    """Gathers the keyframes around the last one, among those that the graph joins to it.

    Args:
        slam_map: with at least one keyframe.
        config: number of keyframes.

    Returns:
        The local map, without any scan since the last keyframe.
    """
    rows = nearest_in_graph(slam_map, len(slam_map) - 1, config.num_keyframes, np.inf)
    T_map_keyframe = rigid.inverse(slam_map.T_world_keyframe[-1]) @ slam_map.T_world_keyframe[rows]
    compact = tuple(slam_map.keyframes[row].compact for row in rows)
    placed = [
        PlacedElements(T, expand_elements(scan.elements)) for T, scan in zip(T_map_keyframe, compact, strict=True)
    ]
    return LocalMap(tuple(placed), compact, (), joined_surface(placed))


def with_scan(
    local_map: LocalMap, elements: SurfaceElements, T_map_scan: Pose, spacing_m: float, config: OdometryConfig
) -> LocalMap:
    """Adds a scan that is far enough from the last one, and drops the oldest scan beyond the number that is kept.

    Args:
        local_map: the local map.
        elements: of the scan, in its frame.
        T_map_scan: pose of the scan.
        spacing_m: smallest distance from the last scan, unless the scan is turned.
        config: number of scans, and turn.

    Returns:
        The local map after.
    """
    T_map_last = (local_map.recent or local_map.keyframes[:1])[-1].T_map_scan
    T_last_scan = rigid.inverse(T_map_last) @ T_map_scan
    if np.linalg.norm(T_last_scan[:3, 3]) < spacing_m and turn_rad(T_last_scan) < config.recent_rad:
        return local_map
    recent = (*local_map.recent, PlacedElements(T_map_scan, elements))[-config.num_recent :]
    placed = (*local_map.keyframes, *recent)
    return local_map._replace(recent=recent, surface=joined_surface(placed)) if config.num_recent else local_map


def nearest_keyframe(local_map: LocalMap, position_map: Float[np.ndarray, " 3"]) -> int:
    """Returns the place of the keyframe that is nearest to a position.

    Args:
        local_map: the local map.
        position_map: metres.

    Returns:
        Place in `keyframes`.
    """
    positions = np.array([placed.T_map_scan[:3, 3] for placed in local_map.keyframes])
    return int(np.argmin(np.linalg.norm(positions - position_map, axis=1)))


def joined_surface(placed: Sequence[PlacedElements]) -> Surface:
    """Joins the flat elements of several scans.

    Args:
        placed: at least one scan.

    Returns:
        The surface in the frame of the poses; its samples are in random order.
    """
    parts = []
    for T, elements in placed:
        is_flat = elements.mask & (elements.planarity > MIN_FLATNESS)
        R = T[:3, :3].T
        parts.append(
            (elements.positions[is_flat] @ R + T[:3, 3], elements.normals[is_flat] @ R, elements.planarity[is_flat])
        )
    points, normals, planarity = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Surface(points, normals, planarity, np.random.default_rng(0).permutation(len(points)), HostTree(points))
