"""Errors of localised scans against reference poses of the scans and of the map's keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from dpmjax.slam import KeyframeMap, Localization

MAX_ERROR_M, MAX_ERROR_DEG = 2.0, 5.0
"""Errors up to which a localisation is right."""


class LocalizationErrors(NamedTuple):
    """Errors of n scans against the reference.

    Attributes:
        is_found: (n,) bool.
        is_right: (n,) True where the scan was found within 2 m and 5 degrees.
        translation_m: (n,) NaN where it was not found.
        rotation_deg: (n,) NaN where it was not found.
    """

    is_found: np.ndarray
    is_right: np.ndarray
    translation_m: np.ndarray
    rotation_deg: np.ndarray


def localization_errors(
    found: Sequence[Localization],
    slam_map: KeyframeMap,
    T_reference_keyframe: np.ndarray,
    T_reference_scan: np.ndarray,
) -> LocalizationErrors:
    """Compares the pose of each scan in the frame of its keyframe with the reference.

    Args:
        found: of n scans.
        slam_map: the map that they were looked for in.
        T_reference_keyframe: (k, 4, 4) reference poses of all keyframes.
        T_reference_scan: (n, 4, 4) reference poses of the scans, in the same world.

    Returns:
        The errors.
    """
    from dpmjax.geometry import rigid
    from dpmjax.metrics import registration_recall

    is_found = np.array([one.is_in_map for one in found], bool)
    is_right, errors = np.zeros(len(found), bool), np.full((2, len(found)), np.nan)
    if is_found.any():
        keyframes = np.array([one.keyframe for one in found if one.is_in_map], np.int64)
        T_world_scan = np.array([one.T_world_scan for one in found if one.is_in_map])
        T = rigid.inverse(slam_map.T_world_keyframe[keyframes]) @ T_world_scan
        true = rigid.inverse(T_reference_keyframe[keyframes]) @ T_reference_scan[is_found]
        recall = registration_recall(T, true, max_translation_m=MAX_ERROR_M, max_rotation_deg=MAX_ERROR_DEG)
        is_right[is_found] = recall.is_right
        errors[:, is_found] = recall.translation_errors_m, recall.rotation_errors_deg
    return LocalizationErrors(is_found, is_right, *errors)
