"""Errors of motions: drift over segments, as in KITTI's benchmark (Geiger et al. 2012), and hand-checked relations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.geometry import rigid, se2
from dpmjax.metrics.inputs import checked_poses, require_same_shape
from dpmjax.metrics.poses import rotation_angle
from dpmjax.sequences import Relations
from dpmjax.types import AnyArray

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


class SegmentError(NamedTuple):
    """Mean errors of segments, relative to their lengths.

    Attributes:
        translation_percent: error of the translation in percent of the length; NaN without any segment.
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


class RelationErrors(NamedTuple):
    """Errors of a trajectory.

    Attributes:
        translation_m: (u,) length of the error of each relation that was used.
        rotation_deg: (u,) and its angle.
        is_used: (r,) False for relations with a time of which there is no scan.
    """

    translation_m: Float[np.ndarray, " u"]
    rotation_deg: Float[np.ndarray, " u"]
    is_used: np.ndarray


def relation_errors(
    relations: Relations,
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 3"],
    *,
    tolerance_s: float = 0.005,
) -> RelationErrors:
    """Compares a trajectory with relations; the benchmark reports the mean of each kind of error.

    Args:
        relations: relations of the same recording.
        times: times of the scans, seconds, of the same clock.
        poses: x, y, heading of T_world_scan, metres.
        tolerance_s: a scan is that of a relation if its time is so near.

    Returns:
        The errors.

    Raises:
        ValueError: if no relation has its scans, or if the lengths differ.
    """
    if len(times) != len(poses):
        raise ValueError(f"poses: expected {len(times)}, one for each time, got {len(poses)}")
    order = np.argsort(times, kind="stable")
    rows, is_used = [], np.ones(len(relations.times_from), bool)
    for wanted in (relations.times_from, relations.times_to):
        after = np.clip(np.searchsorted(times[order], wanted), 1, max(len(times) - 1, 1))
        pair = order[np.minimum(np.stack([after - 1, after]), len(times) - 1)]
        nearest = np.take_along_axis(pair, np.abs(times[pair] - wanted).argmin(axis=0)[None], axis=0)[0]
        is_used &= np.abs(times[nearest] - wanted) <= tolerance_s
        rows.append(nearest)
    if not is_used.any():
        raise ValueError("relations: expected times of the scans, no relation has both of its scans")
    found = se2.relative(poses[rows[0]], poses[rows[1]])[is_used]
    error = np.asarray(se2.relative(relations.T_from_to[is_used], found), np.float64)
    return RelationErrors(np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(se2.wrap_angle(error[:, 2]))), is_used)
