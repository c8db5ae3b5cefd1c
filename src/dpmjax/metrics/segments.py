"""The errors of KITTI's odometry benchmark: drift over segments of 100 to 800 m (Geiger et al. 2012)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid
from dpmjax.metrics.inputs import checked_poses, require_same_shape
from dpmjax.metrics.poses import rotation_angle
from dpmjax.types import AnyArray

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


class SegmentError(NamedTuple):
    """Mean errors of segments, relative to their lengths.

    Attributes:
        translation_percent: of the length; NaN without any segment.
        rotation_deg_per_100m: degrees a hundred metres; NaN without any segment.
        num_segments: how many were compared.
    """

    translation_percent: float
    rotation_deg_per_100m: float
    num_segments: int


def segment_error(
    estimated: Float[AnyArray, "n 4 4"],
    reference: Float[AnyArray, "n 4 4"],
    *,
    lengths_m: Sequence[float] = KITTI_LENGTHS_M,
    stride: int = 10,
) -> SegmentError:
    """Compares the motion over segments of the reference's path with the reference.

    A segment begins at every `stride`-th pose and ends at the first pose whose way along the reference is longer than
    its length. Neither trajectory's frame matters.

    Args:
        estimated: (n, 4, 4) `T_world_scan`, metres.
        reference: the same poses in another frame.
        lengths_m: lengths of segments.
        stride: poses between two segments' beginnings; KITTI takes 10.

    Returns:
        Means over all segments of all lengths.

    Raises:
        ValueError: the shapes differ or are not (n, 4, 4), or a number is not finite, or `stride` is below 1.
    """
    estimated, reference = checked_poses("estimated", estimated), checked_poses("reference", reference)
    require_same_shape("reference", reference, estimated)
    if stride < 1 or estimated.shape[1:] != (4, 4):
        raise ValueError(f"expected poses (n, 4, 4) and a stride from 1, got {estimated.shape} and {stride}")
    steps = np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    first, last, lengths = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
    for length in lengths_m:
        begins = np.arange(0, len(way), stride)
        ends = np.searchsorted(way, way[begins] + length, side="right")
        is_whole = ends < len(way)
        first.append(begins[is_whole])
        last.append(ends[is_whole])
        lengths.append(np.full(int(is_whole.sum()), float(length)))
    a, b, length_m = np.concatenate(first), np.concatenate(last), np.concatenate(lengths)
    if not len(a):
        return SegmentError(float("nan"), float("nan"), 0)
    moved, true = (rigid.inverse(poses[a]) @ poses[b] for poses in (estimated, reference))
    error = rigid.inverse(moved) @ true
    translations = np.linalg.norm(error[:, :3, 3], axis=1) / length_m
    rotations = np.degrees(rotation_angle(error[:, :3, :3])) / length_m
    return SegmentError(100 * float(translations.mean()), 100 * float(rotations.mean()), len(a))
