"""The local map: surface elements of the nearest keyframes and of the last scans.

Keyframes keep few elements, the last scans all of theirs: density around the lidar makes odometry exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.prepared_scans import CompactScan
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import HostTree
from dpmjax.scans.compact import expand_elements
from dpmjax.scans.surfaces import MIN_FLATNESS, Surface
from dpmjax.slam.config import OdometryConfig
from dpmjax.slam.keyframes import KeyframeMap, Pose, nearest_in_graph, turn_rad
from dpmjax.types import SurfaceElements

RECENT_SHARE = 0.08
"""Smallest distance between the last scans, as a share of the extent."""

RECENT_RAD = 0.17
"""Turn from which on a scan joins the local map at a smaller distance."""


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
        surface: the planes of these keyframes and of the last scans.
    """

    keyframes: tuple[PlacedElements, ...]
    compact: tuple[CompactScan, ...]
    surface: Surface


def local_map_of(slam_map: KeyframeMap, recent: Sequence[PlacedElements], config: OdometryConfig) -> LocalMap:
    """Gathers the keyframes around the last one, among those that the graph joins to it.

    Args:
        slam_map: with at least one keyframe.
        recent: the last scans, in the frame of the last keyframe.
        config: number of keyframes.

    Returns:
        The local map.
    """
    rows = nearest_in_graph(slam_map, len(slam_map) - 1, config.num_keyframes, np.inf)
    T_map_keyframe = rigid.inverse(slam_map.T_world_keyframe[-1]) @ slam_map.T_world_keyframe[rows]
    compact = tuple(slam_map.keyframes[row].compact for row in rows)
    placed = tuple(
        PlacedElements(T, expand_elements(scan.elements)) for T, scan in zip(T_map_keyframe, compact, strict=True)
    )
    return LocalMap(placed, compact, joined_surface((*placed, *recent)))


def placed_scan(surface: Surface, T_map_scan: Pose) -> PlacedElements:
    """Keeps the flat elements of a scan, in float32 as a file has them.

    Args:
        surface: of the scan.
        T_map_scan: pose of the scan.

    Returns:
        The placed elements.
    """
    is_flat = surface.flatness > MIN_FLATNESS
    positions, normals, planarity = (
        array[is_flat].astype(np.float32) for array in (surface.points, surface.normals, surface.flatness)
    )
    return PlacedElements(T_map_scan, SurfaceElements(positions, normals, planarity, np.ones(is_flat.sum(), bool)))


def with_scan(
    recent: tuple[PlacedElements, ...],
    placed: PlacedElements,
    extent_m: float,
    config: OdometryConfig,
    *,
    is_changed: bool = False,
) -> tuple[PlacedElements, ...]:
    """Adds a scan that is far enough from the last one, and drops the oldest scan beyond the number that is kept.

    Args:
        recent: the last scans, oldest first.
        placed: the scan.
        extent_m: of the scan; a share of it is the smallest distance from the last scan, unless the scan is turned.
        config: number of scans.
        is_changed: True for a scan that agrees less with the local map than usual; it joins at any distance.

    Returns:
        The last scans after; the same tuple where the scan does not join.
    """
    if recent and not is_changed:
        T_last_scan = rigid.inverse(recent[-1].T_map_scan) @ placed.T_map_scan
        if np.linalg.norm(T_last_scan[:3, 3]) < RECENT_SHARE * extent_m and turn_rad(T_last_scan) < RECENT_RAD:
            return recent
    return (*recent, placed)[-config.num_recent :] if config.num_recent else recent


def nearest_keyframe(local_map: LocalMap, position_map: Float[np.ndarray, " 3"]) -> int:
    """Returns the index of the keyframe that is nearest to a position.

    Args:
        local_map: the local map.
        position_map: metres.

    Returns:
        Index in `keyframes`.
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
