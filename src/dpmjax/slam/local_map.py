"""The local map: surface elements of the nearest keyframes and of the last scans.

A keyframe stores few elements. The last scans keep all elements, because dense surfaces around the lidar make odometry
exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.compact_scans import CompactScan, expand_elements
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import HostTree
from dpmjax.geometry.se3 import turn_rad
from dpmjax.scan.lidar.surfaces import MIN_FLATNESS, Surface
from dpmjax.slam.config import OdometryConfig
from dpmjax.slam.keyframe_map import KeyframeMap, Submap, submap_around
from dpmjax.types import AnyArray, Pose

# Smallest distance between the last scans, as a share of the extent.
RECENT_SHARE = 0.08

# Largest number of the last scans. More make a denser surface, which odometry searches more slowly.
NUM_RECENT = 8


class PlacedElements(NamedTuple):
    """Flat surface elements of a scan and its pose.

    Attributes:
        T_map_scan: pose of the scan.
        positions: (n, 3) float32, metres, in the frame of the scan.
        normals: (n, 3) unit normals, of either sign.
        planarity: (n,) above `MIN_FLATNESS`.
    """

    T_map_scan: Pose
    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    planarity: Float[np.ndarray, " n"]


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

    def nearest(self, position_map: Float[np.ndarray, " 3"]) -> int:
        """Returns the index in `keyframes` of the keyframe that is nearest to a position in metres."""
        positions = np.array([placed.T_map_scan[:3, 3] for placed in self.keyframes])
        return int(np.argmin(np.linalg.norm(positions - position_map, axis=1)))


def local_map_of(slam_map: KeyframeMap, recent: Sequence[PlacedElements], config: OdometryConfig) -> LocalMap:
    """Builds the local map of recent scans and of the nearest keyframes that the graph joins to the last one.

    Args:
        slam_map: map with at least one keyframe.
        recent: the last scans, in the frame of the last keyframe.
        config: number of keyframes.

    Returns:
        The local map.
    """
    near = submap_around(slam_map, len(slam_map) - 1, config.num_keyframes, radius_m=np.inf)
    placed = placed_keyframes(near)
    return LocalMap(placed, near.scans, joined_surface((*placed, *recent)))


def placed_keyframes(submap: Submap) -> tuple[PlacedElements, ...]:
    """Returns the flat elements of the keyframes of a submap, with their poses in its frame."""
    elements = (expand_elements(scan.elements) for scan in submap.scans)
    return tuple(
        _placed(T, one.positions, one.normals, np.where(one.mask, one.planarity, 0))
        for one, T in zip(elements, submap.T_submap_keyframe, strict=True)
    )


def placed_scan(surface: Surface, T_map_scan: Pose) -> PlacedElements:
    """Returns the flat elements of a scan with a pose, in float32, as files store them."""
    return _placed(T_map_scan, surface.points, surface.normals, surface.flatness)


def _placed(T_map_scan: Pose, *arrays: AnyArray) -> PlacedElements:
    positions, normals, planarity = (np.asarray(array, np.float32) for array in arrays)
    is_flat = planarity > MIN_FLATNESS
    return PlacedElements(T_map_scan, positions[is_flat], normals[is_flat], planarity[is_flat])


def with_scan(
    recent: tuple[PlacedElements, ...], placed: PlacedElements, extent_m: float
) -> tuple[PlacedElements, ...]:
    """Adds a scan if it is far enough from the last one. Of more than `NUM_RECENT` scans, the oldest is dropped.

    Args:
        recent: the last scans, oldest first.
        placed: the scan.
        extent_m: extent of the scan; 0 adds it at any distance.

    Returns:
        The new last scans; the same tuple if the scan is not added.
    """
    if recent:
        T_last_scan = rigid.inverse(recent[-1].T_map_scan) @ placed.T_map_scan
        # Turn above which a scan joins the local map at a smaller distance.
        if np.linalg.norm(T_last_scan[:3, 3]) < RECENT_SHARE * extent_m and turn_rad(T_last_scan) < 0.17:
            return recent
    return (*recent, placed)[-NUM_RECENT:]


def joined_surface(placed: Sequence[PlacedElements]) -> Surface:
    """Joins the flat elements of several scans.

    Args:
        placed: at least one scan.

    Returns:
        The surface in the frame of the poses; its samples are in random order.
    """
    parts = []
    for T, positions, normals, planarity in placed:
        R = T[:3, :3].T
        parts.append((positions @ R + T[:3, 3], normals @ R, planarity))
    # In columns: an alignment takes a few of them at each step.
    points, normals, planarity = (np.asfortranarray(np.concatenate(arrays)) for arrays in zip(*parts, strict=True))
    return Surface(points, normals, planarity, np.random.default_rng(0).permutation(len(points)), HostTree(points))
