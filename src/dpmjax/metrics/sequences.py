"""Errors of the poses of recorded sequences: numbers under their names in json, which end with the unit."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from dpmjax import geometry
from dpmjax.metrics.drives import path_lengths, segment_error
from dpmjax.metrics.poses import (
    absolute_trajectory_error,
    align_poses,
    align_rigid,
    point_distance,
    relative_pose_error,
)
from dpmjax.sequences import DepthSequence, FloatArray, LidarSequence, ScanSequence

# Typical ranges that a radian equals in the alignment of cameras, for positions on a line.
_LEVER = 0.1
# Largest ratio of the lengths of trajectory and reference, and the least length that is compared, metres.
_MAX_LENGTH_RATIO, _MIN_WAY_M = 30.0, 1.0


def planar_errors(sequence: ScanSequence, poses: FloatArray) -> dict[str, float]:
    """Computes ATE, the largest error of a scan after the same alignment, and point distance, in the unit of the scans.

    Args:
        sequence: the scans.
        poses: (n, 3) T_world_scan.

    Returns:
        The numbers by name; empty without a reference.
    """
    reference, unit = sequence.reference_poses, sequence.unit
    if reference is None:
        return {}
    matrices = geometry.se2.to_matrix(poses), geometry.se2.to_matrix(reference)
    T_reference_world = np.asarray(align_rigid(poses[:, :2], reference[:, :2]))
    off = poses[:, :2] @ T_reference_world[:2, :2].T + T_reference_world[:2, 2] - reference[:, :2]
    return {
        f"ate_{unit}": float(absolute_trajectory_error(poses[:, :2], reference[:, :2])),
        f"worst_scan_{unit}": float(np.hypot(*off.T).max()),
        f"point_distance_{unit}": float(point_distance(sequence.points, sequence.mask, *matrices)),
    }


def corrected_ate(times: FloatArray, poses: FloatArray, corrected: ScanSequence) -> float:
    """Computes the ATE of planar scans at the common scans of a corrected log of the same drive.

    Args:
        times: of all scans, seconds.
        poses: (n, 3) T_world_scan of all scans, metres.
        corrected: the corrected log.

    Returns:
        The ATE, metres.

    Raises:
        ValueError: the corrected log has no poses with times, or few scans of the same times.
    """
    if corrected.reference_poses is None or corrected.times is None:
        raise ValueError(f"{corrected.name}: has no corrected poses with times")
    _, mine, theirs = np.intersect1d(np.round(times, 3), np.round(corrected.times, 3), return_indices=True)
    if len(mine) < 10:
        raise ValueError(f"{corrected.name}: {len(mine)} scans have the time of a scan of the recording, not 10")
    return float(absolute_trajectory_error(poses[mine, :2], corrected.reference_poses[theirs, :2]))


def depth_errors(sequence: DepthSequence, T_world_camera: FloatArray) -> dict[str, float]:
    """Computes ATE, mean distance of map points, and the largest error of a turn between neighbours.

    Args:
        sequence: the images; their reference may be missing.
        T_world_camera: (n, 4, 4) poses, metres.

    Returns:
        The numbers by name; empty without a reference.
    """
    reference = sequence.T_world_camera
    if reference is None:
        return {}
    count = len(sequence)
    points, mask = sequence.points.reshape(count, -1, 3), sequence.mask.reshape(count, -1)
    lever = _LEVER * geometry.typical_range(points, mask)
    aligned = align_poses(T_world_camera, reference, lever=lever) @ T_world_camera
    off = np.einsum("nij,nbj->nbi", aligned[:, :3, :3] - reference[:, :3, :3], points)
    off += aligned[:, None, :3, 3] - reference[:, None, :3, 3]
    moved, true = (Rotation.from_matrix(T[:, :3, :3]) for T in (T_world_camera, reference))
    turn_errors = (true[:-1].inv() * true[1:]).inv() * (moved[:-1].inv() * moved[1:])
    return {
        "ate_m": float(absolute_trajectory_error(T_world_camera[:, :3, 3], reference[:, :3, 3])),
        "point_distance_m": float(np.linalg.norm(off, axis=-1)[mask].mean()),
        "largest_turn_error_deg": float(np.degrees(turn_errors.magnitude().max())),
    }


def trajectory_errors(T_world_scan: FloatArray, reference: FloatArray | None, suffix: str = "") -> dict[str, float]:
    """Returns ATE, RPE and KITTI's errors of a trajectory, at scans with a reference pose; none without two of them."""
    if reference is None:
        return {}
    has_reference = np.isfinite(reference.reshape(-1, 16)).all(axis=1)
    T_world_scan, reference = T_world_scan[has_reference], reference[has_reference]
    if len(T_world_scan) < 2:
        return {}
    relative, segments = relative_pose_error(T_world_scan, reference), segment_error(T_world_scan, reference)
    return {
        f"ate{suffix}_m": float(absolute_trajectory_error(T_world_scan[:, :3, 3], reference[:, :3, 3])),
        f"rpe{suffix}_m": float(relative.translation_rmse),
        f"rpe{suffix}_deg": math.degrees(relative.rotation_rmse),
        f"t_rel{suffix}_percent": segments.translation_percent,
        f"r_rel{suffix}_deg_per_100m": segments.rotation_deg_per_100m,
    }


def reference_doubt(T_world_scan: FloatArray, sequence: LidarSequence) -> str | None:
    """Returns a doubt where the reference seems to be in another unit, or of inverted poses; None without a doubt."""
    if sequence.T_world_lidar is None:
        return None
    T, reference = T_world_scan[sequence.has_reference], sequence.T_world_lidar[sequence.has_reference]
    way_m, reference_m = (path_lengths(poses).max(initial=0.0) for poses in (T, reference))
    if min(way_m, reference_m) < _MIN_WAY_M:
        return None
    if not 1 / _MAX_LENGTH_RATIO < reference_m / way_m < _MAX_LENGTH_RATIO:
        return f"the reference is {reference_m:.3g} m long, the trajectory {way_m:.3g} m: is the reference in metres?"
    references = reference, geometry.rigid.inverse(reference)
    given, inverted = (relative_pose_error(T, poses).translation_rmse for poses in references)
    if inverted < 0.2 * given:
        errors = f"RPE {given:.3g} m; with each pose inverted it would be {inverted:.3g} m"
        return f"{errors}: does the reference map the world to the lidar, not the lidar to the world?"
    return None
