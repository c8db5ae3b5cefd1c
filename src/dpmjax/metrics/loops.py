"""Recall of loop closure: which scans of a drive come back to a place, and how many of them have a loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from dpmjax.metrics.inputs import checked_poses
from dpmjax.types import AnyArray

_OPPOSITE_COSINE = -0.5


class Revisits(NamedTuple):
    """The scans that come back.

    Attributes:
        is_revisit: (n,) the scan is near an earlier one, after some way.
        is_opposite: (n,) it is a revisit, turned by more than 120 degrees against the nearest earlier scan.
    """

    is_revisit: Bool[np.ndarray, " n"]
    is_opposite: Bool[np.ndarray, " n"]


class LoopRecall(NamedTuple):
    """Shares of the revisits that have a loop; NaN without any revisit.

    Attributes:
        recall: recall of all revisits.
        same_way: recall of revisits in the same direction, or across it.
        opposite: recall of revisits in the opposite direction.
        num_revisits: number of all.
        num_opposite: number of revisits in the opposite direction.
    """

    recall: float
    same_way: float
    opposite: float
    num_revisits: int
    num_opposite: int


def find_revisits(
    T_world_scan: Float[AnyArray, "n 4 4"], *, distance_m: float = 5.0, min_path_m: float = 50.0
) -> Revisits:
    """Finds the scans that are near an earlier one, after some way.

    Args:
        T_world_scan: true poses; x is forward.
        distance_m: so near.
        min_path_m: so long is the way between the two.

    Returns:
        Finds the scans at places seen before, and their direction.

    Raises:
        ValueError: the shape is not (n, 4, 4), or a number is not finite.
    """
    poses = checked_poses("T_world_scan", T_world_scan)
    positions, forward, path = poses[:, :3, 3], poses[:, :3, 0], path_lengths(poses)
    is_revisit, is_opposite = np.zeros(len(poses), bool), np.zeros(len(poses), bool)
    tree = cKDTree(positions)
    for scan, position in enumerate(positions):
        near = np.asarray(tree.query_ball_point(position, distance_m), np.int64)
        earlier = near[path[near] <= path[scan] - min_path_m]
        if len(earlier):
            nearest = earlier[np.argmin(np.linalg.norm(positions[earlier] - positions[scan], axis=1))]
            is_revisit[scan], is_opposite[scan] = True, forward[scan] @ forward[nearest] < _OPPOSITE_COSINE
    return Revisits(is_revisit, is_opposite)


def loop_recall(
    T_world_scan: Float[AnyArray, "n 4 4"],
    newer_ends: Int[AnyArray, "m 2"],
    revisits: Revisits,
    *,
    reach_m: float = 10.0,
) -> LoopRecall:
    """The share of the revisits that have a loop: the newer end of one is within `reach_m` along the path.

    Pass right loops only. Where no wrong one was accepted, this is the recall at 100 % precision.

    Args:
        T_world_scan: true poses.
        newer_ends: first and last scan of the newer end of each loop; equal where it joins single scans.
        revisits: result of `find_revisits` on the same poses.
        reach_m: a keyframe every few metres is enough, so loops count for the scans around them.

    Returns:
        The recall, also by direction.

    Raises:
        ValueError: the shapes are not (n, 4, 4) and (m, 2), or an end is no scan.
    """
    path = path_lengths(checked_poses("T_world_scan", T_world_scan))
    ends = np.asarray(newer_ends, np.int64)
    if ends.ndim != 2 or ends.shape[1] != 2 or (ends.size and not 0 <= ends.min() <= ends.max() < len(path)):
        raise ValueError(f"newer_ends: expected shape (m, 2) and scans from 0 to {len(path) - 1}, got {ends.shape}")
    has_loop = np.zeros(len(path), bool)
    for first, last in ends:
        has_loop |= (path >= path[first] - reach_m) & (path <= path[last] + reach_m)
    opposite = revisits.is_opposite
    same = revisits.is_revisit & ~opposite
    shares = (has_loop[chosen].mean() if chosen.any() else np.nan for chosen in (revisits.is_revisit, same, opposite))
    recall, same_way, other_way = map(float, shares)
    return LoopRecall(recall, same_way, other_way, int(revisits.is_revisit.sum()), int(opposite.sum()))


def path_lengths(T_world_scan: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Returns the length of the path until each scan, metres."""
    steps = np.linalg.norm(np.diff(T_world_scan[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
