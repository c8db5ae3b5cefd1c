"""Saved maps that a command reads, checked against its weights before any work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpmjax.scans.compact import expand_elements

if TYPE_CHECKING:
    from dpmjax.slam import KeyframeMap, SlamMethods


def open_map(path: Path, methods: SlamMethods) -> KeyframeMap:
    """Reads a saved map.

    Args:
        path: a file of `save_map`.
        methods: of the weights that must have made it.

    Returns:
        The map.

    Raises:
        ValueError: no such file, no map, or a map of other weights.
    """
    from dpmjax.saved_maps import load_map

    slam_map, origin = load_map(path), methods.origin
    if slam_map.origin is not None and slam_map.origin.fingerprint != origin.fingerprint:
        found = f"made with weights {slam_map.origin}, these are {origin}"
        raise ValueError(f"{path}: {found}; name the weights that made it with --weights")
    return slam_map


def keyframe_points(slam_map: KeyframeMap, row: int) -> np.ndarray:
    """Returns the surface elements of a keyframe.

    Args:
        slam_map: the map.
        row: of the keyframe.

    Returns:
        (n, 3) metres, in the frame of the keyframe's lidar.
    """
    elements = expand_elements(slam_map.keyframes[row].compact.elements)
    return np.asarray(elements.positions)[np.asarray(elements.mask)]
