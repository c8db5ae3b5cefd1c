"""How often a registration is right: the share of pairs within a distance and an angle of the truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.types import AnyArray


class RegistrationRecall(NamedTuple):
    """Errors of registrations of pairs of scans.

    Attributes:
        recall: share of pairs with both errors within the limits.
        translation_errors_m: (n,) of each pair.
        rotation_errors_deg: (n,) of each pair, in [0, 180].
        is_right: (n,) which pairs count; those with a pose that is not finite do not.
    """

    recall: float
    translation_errors_m: Float[np.ndarray, " n"]
    rotation_errors_deg: Float[np.ndarray, " n"]
    is_right: Bool[np.ndarray, " n"]


def registration_recall(
    T_estimated: Float[AnyArray, "n 4 4"],
    T_true: Float[AnyArray, "n 4 4"],
    *,
    max_translation_m: float = 2.0,
    max_rotation_deg: float = 5.0,
) -> RegistrationRecall:
    """The share of motions that are right, and how wrong each is.

    Args:
        T_estimated: (n, 4, 4) `T_target_source`, metres.
        T_true: the same, true.
        max_translation_m: how far the translations may differ.
        max_rotation_deg: how far the rotations may.

    Returns:
        The recall is 0 without any pair.

    Raises:
        ValueError: the shapes differ or are not (n, 4, 4).
    """
    estimated, true = np.asarray(T_estimated, np.float64), np.asarray(T_true, np.float64)
    for name, value in (("T_estimated", estimated), ("T_true", true)):
        if value.ndim != 3 or value.shape[1:] != (4, 4) or len(value) != len(true):
            raise ValueError(f"{name}: expected shape ({len(true)}, 4, 4), got {value.shape}")
    translation = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    difference = np.swapaxes(true[:, :3, :3], 1, 2) @ estimated[:, :3, :3]
    # Of sine and cosine: the arc cosine alone has no digits left at small angles.
    axis = np.stack([difference[:, i, j] - difference[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1) / 2
    cosine = (np.trace(difference, axis1=1, axis2=2) - 1) / 2
    rotation = np.degrees(np.arctan2(np.linalg.norm(axis, axis=1), cosine))
    with np.errstate(invalid="ignore"):
        is_right = (translation <= max_translation_m) & (rotation <= max_rotation_deg)
    return RegistrationRecall(float(is_right.mean()) if len(true) > 0 else 0.0, translation, rotation, is_right)
