"""Errors of drives: drift over segments (KITTI's benchmark, Geiger et al. 2012), hand-checked relations, loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from dpmjax.geometry import rigid, se2
from dpmjax.metrics.poses import checked_poses, rotation_angle
from dpmjax.sequences import Relations
from dpmjax.types import AnyArray

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


class SegmentError(NamedTuple):
    """Mean errors of segments, relative to their lengths.

    Attributes:
        translation_percent: error of the translation in percent of the length; NaN without any segment.
        rotation_deg_per_100m: degrees a hundred metres; NaN without any segment.
        num_segments: number of compared segments.
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

    A segment begins at every `stride`-th pose and ends at the first pose that is more than its length farther along the
    reference. The frames of the two trajectories do not matter.

    Args:
        estimated: (n, 4, 4) `T_world_scan`, metres.
        reference: the same poses in another frame.
        lengths_m: lengths of segments.
        stride: number of poses from the start of a segment to that of the next; KITTI takes 10.

    Returns:
        Means over all segments of all lengths.

    Raises:
        ValueError: the shapes differ or are not (n, 4, 4), or a number is not finite, or `stride` is below 1.
    """
    estimated, reference = checked_poses(estimated=estimated, reference=reference)
    if stride < 1 or estimated.shape[1:] != (4, 4):
        raise ValueError(f"expected poses (n, 4, 4) and a stride from 1, got {estimated.shape} and {stride}")
    way, lengths = path_lengths(reference), np.asarray(lengths_m, np.float64)[:, None]
    begins = np.arange(0, len(way), stride)
    ends = np.searchsorted(way, way[begins] + lengths, side="right")
    is_whole = ends < len(way)
    a, b, length_m = (np.broadcast_to(x, ends.shape)[is_whole] for x in (begins, ends, lengths))
    if not len(a):
        return SegmentError(float("nan"), float("nan"), 0)
    moved, true = (rigid.inverse(poses[a]) @ poses[b] for poses in (estimated, reference))
    error = rigid.inverse(moved) @ true
    translations = np.linalg.norm(error[:, :3, 3], axis=1) / length_m
    rotations = np.degrees(rotation_angle(error[:, :3, :3])) / length_m
    return SegmentError(100 * float(translations.mean()), 100 * float(rotations.mean()), len(a))


class RelationErrors(NamedTuple):
    """Errors of a trajectory at the relations.

    Attributes:
        translation_m: (u,) length of the error of each relation that was used.
        rotation_deg: (u,) angle of the error of each of these relations.
        is_used: (r,) False for relations without a scan at one of their times.
    """

    translation_m: Float[np.ndarray, " u"]
    rotation_deg: Float[np.ndarray, " u"]
    is_used: np.ndarray


def relation_errors(
    relations: Relations, times: Float[np.ndarray, " n"], poses: Float[np.ndarray, "n 3"]
) -> RelationErrors:
    """Compares a trajectory with relations; the benchmark reports the mean of each kind of error.

    A relation is used where scans were taken within 5 ms of its times.

    Args:
        relations: relations of the same recording.
        times: times of the scans, seconds, of the same clock.
        poses: x, y, heading of T_world_scan, metres.

    Returns:
        The errors.

    Raises:
        ValueError: if no relation has its scans.
    """
    order = np.argsort(times, kind="stable")
    # A scan belongs to the times that are nearer to it than to its neighbours.
    middles = (times[order][1:] + times[order][:-1]) / 2
    ends = (relations.times_from, relations.times_to)
    first, second = (order[np.searchsorted(middles, wanted)] for wanted in ends)
    off_s = [np.abs(times[rows] - wanted) for rows, wanted in zip((first, second), ends, strict=True)]
    is_used = np.asarray(np.max(off_s, axis=0) <= 0.005)
    if not is_used.any():
        raise ValueError("relations: expected times of the scans, no relation has both of its scans")
    found = se2.relative(poses[first], poses[second])[is_used]
    error = np.asarray(se2.relative(relations.T_from_to[is_used], found), np.float64)
    return RelationErrors(np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(se2.wrap_angle(error[:, 2]))), is_used)


class Revisits(NamedTuple):
    """Scans at places seen before.

    Attributes:
        is_revisit: (n,) True for a scan near an earlier one, after a least path.
        is_opposite: (n,) True for a revisit turned by more than 120 degrees against the nearest earlier scan.
    """

    is_revisit: Bool[np.ndarray, " n"]
    is_opposite: Bool[np.ndarray, " n"]


class LoopRecall(NamedTuple):
    """Shares of the revisits that have a loop; NaN without any revisit.

    Attributes:
        recall: recall of all revisits.
        same_way: recall of revisits in the same direction, or across it.
        opposite: recall of revisits in the opposite direction.
    """

    recall: float
    same_way: float
    opposite: float


def find_revisits(
    T_world_scan: Float[AnyArray, "n 4 4"], *, distance_m: float = 5.0, min_path_m: float = 50.0
) -> Revisits:
    """Finds the scans that are near an earlier one, after a least path.

    Args:
        T_world_scan: true poses; x is forward.
        distance_m: largest distance from the earlier scan.
        min_path_m: least length of the path between the two.

    Returns:
        The scans at places seen before, and their direction.

    Raises:
        ValueError: the shape is not (n, 4, 4), or a number is not finite.
    """
    (poses,) = checked_poses(T_world_scan=T_world_scan)
    positions, forward, path = poses[:, :3, 3], poses[:, :3, 0], path_lengths(poses)
    is_revisit, is_opposite = np.zeros(len(poses), bool), np.zeros(len(poses), bool)
    tree = KDTree(positions)
    for scan, position in enumerate(positions):
        near = np.asarray(tree.query_ball_point(position, distance_m), np.int64)
        earlier = near[path[near] <= path[scan] - min_path_m]
        if len(earlier):
            nearest = earlier[np.argmin(np.linalg.norm(positions[earlier] - positions[scan], axis=1))]
            is_revisit[scan], is_opposite[scan] = True, forward[scan] @ forward[nearest] < -0.5  # cosine of 120 degrees
    return Revisits(is_revisit, is_opposite)


def loop_recall(
    T_world_scan: Float[AnyArray, "n 4 4"],
    newer_ends: Int[AnyArray, "m 2"],
    revisits: Revisits,
    *,
    reach_m: float = 10.0,
) -> LoopRecall:
    """Computes the share of the revisits with a loop whose newer end is within `reach_m` along the path.

    Pass right loops only. Where no wrong one was accepted, this is the recall at 100 % precision.

    Args:
        T_world_scan: true poses.
        newer_ends: first and last scan of the newer end of each loop; equal where it joins single scans.
        revisits: result of `find_revisits` on the same poses.
        reach_m: largest distance along the path of a scan from the loop that counts for it; keyframes are metres apart.

    Returns:
        The recall, also by direction.

    Raises:
        ValueError: the shapes are not (n, 4, 4) and (m, 2), or an end is no scan.
    """
    path = path_lengths(*checked_poses(T_world_scan=T_world_scan))
    ends = np.asarray(newer_ends, np.int64)
    if ends.ndim != 2 or ends.shape[1] != 2 or (ends.size and not 0 <= ends.min() <= ends.max() < len(path)):
        raise ValueError(f"newer_ends: expected shape (m, 2) and scans from 0 to {len(path) - 1}, got {ends.shape}")
    has_loop = np.zeros(len(path), bool)
    for first, last in ends:
        has_loop |= (path >= path[first] - reach_m) & (path <= path[last] + reach_m)
    every, opposite = revisits
    groups = (every, every & ~opposite, opposite)
    return LoopRecall(*(float(has_loop[chosen].mean()) if chosen.any() else np.nan for chosen in groups))


def path_lengths(T_world_scan: Float[AnyArray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Returns the length of the path until each scan, metres."""
    steps = np.linalg.norm(np.diff(T_world_scan[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])[: len(T_world_scan)]
