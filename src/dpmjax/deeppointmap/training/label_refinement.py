"""Refinement of labels: the scans of a group are aligned with its frame by point-to-plane ICP, from their given poses.

Poses of recorded drives are decimetres off between neighbours (a limitation that DeepPointMap names). Labels are
refined where a sample is made, so that nothing more is stored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import small_gicp
from jaxtyping import Float

from dpmjax.deeppointmap.training.sampling import Group, PlacedScans, number_scans
from dpmjax.geometry import rigid, se3
from dpmjax.geometry.pyramid_storage import StoredPyramid

# Values of DeepPointMap's published program: reach of the correspondences, voxels, iterations, and least range.
REACH_M, VOXEL_M, NUM_ITERATIONS, MIN_RANGE_M = 1.0, 0.3, 30, 5.0

# A larger correction is another minimum: the given pose stays.
MAX_SHIFT_M, MAX_TURN_RAD = 1.0, math.radians(5)

# With fewer points that find a partner, scans far apart slide along the ground they share.
MIN_INLIER_SHARE = 0.3

# As `map`: calls a function with the entries of two sequences.
Mapper = Callable[..., Iterable[Any]]


def refine_labels(
    placed: PlacedScans,
    points: Sequence[Float[np.ndarray, "_n 3"]],
    groups: Sequence[Group],
    *,
    mapper: Mapper = map,
) -> PlacedScans:
    """Corrects the places of the scans of each group relative to the frame of its second map.

    Args:
        placed: the scans of all groups in their order, by their given poses.
        points: points of each scan, metres, in the frame of `placed.T_world_scan`.
        groups: groups from `draw_groups`.
        mapper: function that applies another one, such as `ThreadPoolExecutor.map`.

    Returns:
        The corrected places; a scan keeps its given place where ICP fails.
    """
    frames = np.concatenate([np.full(len(group.rows), group.target[0]) for group in number_scans(groups)])
    T_world_scan = placed.T_world_scan
    T_frame_scan = rigid.inverse(T_world_scan[frames]) @ T_world_scan
    refined = mapper(aligned_motion, [points[row] for row in frames], points, T_frame_scan)
    T_refined = T_world_scan[frames] @ np.stack(list(refined))
    T_refined[frames == np.arange(len(frames))] = T_world_scan[frames == np.arange(len(frames))]
    correction = T_refined @ rigid.inverse(T_world_scan)
    positions = placed.positions_world @ correction[:, :3, :3].swapaxes(1, 2) + correction[:, None, :3, 3]
    return PlacedScans(T_refined, positions, placed.mask)


def aligned_motion(
    target: Float[np.ndarray, "n 3"], source: Float[np.ndarray, "m 3"], T_target_source: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Refines the motion between two scans.

    Args:
        target: metres, in its own frame.
        source: metres, in its own frame.
        T_target_source: the given motion.

    Returns:
        The refined motion; the given one where ICP does not converge, finds few partners or goes too far.
    """
    far = [cloud[np.linalg.norm(cloud, axis=1) >= MIN_RANGE_M].astype(np.float64) for cloud in (target, source)]
    if min(map(len, far)) == 0:
        return T_target_source
    found = small_gicp.align(
        far[0],
        far[1],
        T_target_source,
        registration_type="PLANE_ICP",
        downsampling_resolution=VOXEL_M,
        max_correspondence_distance=REACH_M,
        max_iterations=NUM_ITERATIONS,
    )
    refined = np.asarray(found.T_target_source)
    is_small = se3.are_near(T_target_source, refined, MAX_SHIFT_M, MAX_TURN_RAD)
    is_good = found.converged and is_small and found.num_inliers >= MIN_INLIER_SHARE * len(far[1])
    return refined if is_good else T_target_source


def moved_points(
    stored: StoredPyramid, T_scan_lidar: Float[np.ndarray, "s 4 4"], scale_m: float
) -> list[Float[np.ndarray, "_n 3"]]:
    """Reads the points of stored scans.

    Args:
        stored: pyramids of NumPy arrays.
        T_scan_lidar: the motion of each scan, metres.
        scale_m: metres in one unit of the pyramids.

    Returns:
        Points of each scan after its motion, metres.
    """
    moved = []
    for row, T in enumerate(np.asarray(T_scan_lidar, np.float64)):
        points = stored.points[row, : stored.num_points[row]] * (float(stored.unit[row]) * scale_m)
        moved.append(points @ T[:3, :3].T + T[:3, 3])
    return moved
