"""Numbers of SLAM and of localization for metrics.json: errors, counts, seconds; and the record of a run."""

from __future__ import annotations

import collections
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dpmjax import geometry, metrics, slam
from dpmjax.sequences import LidarSequence, counted

MAX_LENGTH_RATIO, MIN_WAY_M = 30.0, 1.0
"""Largest ratio of the lengths of trajectory and reference, and the least length that is compared, metres."""

INVERTED_SHARE = 0.2
"""Share of the error of the reference, below which the error of its inverse makes the reference doubtful."""


class SlamRun(NamedTuple):
    """A run until its end or its stop.

    Attributes:
        state: after the last scan.
        reports: reports of all scans.
        stages_s: seconds of each stage in this process, without compilation. "waiting" is for the next scan; a stage
            "ahead" runs in the thread that reads and thins it, at the same time as the others.
        compile_s: seconds of compilation.
        run_s: seconds of all scans of this process, without compilation.
        scan_s: seconds of each scan of this process, without compilation and writing.
        failure: error that ended the run early; None without an error.
    """

    state: slam.SlamState
    reports: tuple[slam.ScanReport, ...]
    stages_s: dict[str, float]
    compile_s: float
    run_s: float
    scan_s: tuple[float, ...]
    failure: Exception | None

    @property
    def num_done(self) -> int:
        """Returns the number of scans of this process."""
        return len(self.scan_s)


class LocalizationErrors(NamedTuple):
    """Errors of n scans against the reference.

    Attributes:
        is_found: (n,) bool.
        is_right: (n,) True where the scan was found within 2 m and 5 degrees.
        translation_m: (n,) NaN where it was not found.
        rotation_deg: (n,) NaN where it was not found.
        keyframe_distance_m: (n,) distance of the true position to the nearest keyframe.
    """

    is_found: np.ndarray
    is_right: np.ndarray
    translation_m: np.ndarray
    rotation_deg: np.ndarray
    keyframe_distance_m: np.ndarray


def localization_errors(
    found: Sequence[slam.Localization],
    slam_map: slam.KeyframeMap,
    T_reference_keyframe: np.ndarray,
    T_reference_scan: np.ndarray,
) -> LocalizationErrors:
    """Compares the pose of each scan in the frame of its keyframe with the reference.

    Args:
        found: results of n scans.
        slam_map: the map.
        T_reference_keyframe: (k, 4, 4) reference poses of all keyframes.
        T_reference_scan: (n, 4, 4) reference poses of the scans, in the same world.

    Returns:
        The errors.
    """
    is_found = np.array([one.is_in_map for one in found], bool)
    is_right, errors = np.zeros(len(found), bool), np.full((2, len(found)), np.nan)
    keyframes = np.array([one.keyframe for one in found if one.is_in_map], np.int64)
    T_world_scan = np.reshape([one.T_world_scan for one in found if one.is_in_map], (-1, 4, 4))
    T = geometry.rigid.inverse(slam_map.T_world_keyframe[keyframes]) @ T_world_scan
    true = geometry.rigid.inverse(T_reference_keyframe[keyframes]) @ T_reference_scan[is_found]
    recall = metrics.registration_recall(T, true)
    is_right[is_found] = recall.is_right
    errors[:, is_found] = recall.translation_errors_m, recall.rotation_errors_deg
    apart = np.linalg.norm(T_reference_scan[:, None, :3, 3] - T_reference_keyframe[None, :, :3, 3], axis=2)
    translation_m, rotation_deg = errors
    return LocalizationErrors(is_found, is_right, translation_m, rotation_deg, apart.min(axis=1))


UNSURE = {
    "network": "placed by the network: at the start, or because alignment with the scans before failed",
    "predicted": "placed by the predicted motion only: uncertain",
    "restarted": "not placed: a new part of the map begins there",
    "empty": "without enough points",
}
"""Texts for scans that were not aligned with the scans before them, by status."""


def trajectory_errors(T_world_scan: np.ndarray, reference: np.ndarray | None, suffix: str = "") -> dict[str, Any]:
    """Returns ATE, RPE and KITTI's errors of a trajectory, at scans with a reference pose; none without two of them."""
    if reference is None:
        return {}
    has_reference = np.isfinite(reference.reshape(-1, 16)).all(axis=1)
    T_world_scan, reference = T_world_scan[has_reference], reference[has_reference]
    if len(T_world_scan) < 2:
        return {}
    relative = metrics.relative_pose_error(T_world_scan, reference)
    segments = metrics.segment_error(T_world_scan, reference)
    return {
        f"ate{suffix}_m": metrics.absolute_trajectory_error(T_world_scan[:, :3, 3], reference[:, :3, 3]),
        f"rpe{suffix}_m": relative.translation_rmse,
        f"rpe{suffix}_deg": math.degrees(relative.rotation_rmse),
        f"t_rel{suffix}_percent": segments.translation_percent,
        f"r_rel{suffix}_deg_per_100m": segments.rotation_deg_per_100m,
    }


def reference_doubt(T_world_scan: np.ndarray, sequence: LidarSequence) -> str | None:
    """Returns a doubt where the reference seems to be in another unit, or of inverted poses; None without a doubt."""
    if sequence.T_world_lidar is None:
        return None
    T, reference = T_world_scan[sequence.has_reference], sequence.T_world_lidar[sequence.has_reference]
    way_m, reference_m = (metrics.path_lengths(poses).max(initial=0.0) for poses in (T, reference))
    if min(way_m, reference_m) < MIN_WAY_M:
        return None
    if not 1 / MAX_LENGTH_RATIO < reference_m / way_m < MAX_LENGTH_RATIO:
        return f"the reference is {reference_m:.3g} m long, the trajectory {way_m:.3g} m: is the reference in metres?"
    references = reference, geometry.rigid.inverse(reference)
    given, inverted = (metrics.relative_pose_error(T, poses).translation_rmse for poses in references)
    if inverted < INVERTED_SHARE * given:
        errors = f"RPE {given:.3g} m; with each pose inverted it would be {inverted:.3g} m"
        return f"{errors}: does the reference map the world to the lidar, not the lidar to the world?"
    return None


def distances_to_reference(T_world_scan: np.ndarray, reference: np.ndarray | None) -> np.ndarray | None:
    """Returns the distance of each scan to the reference after the best rigid alignment; NaN for scans without one."""
    if reference is None:
        return None
    has_reference = np.isfinite(reference.reshape(-1, 16)).all(axis=1)
    if not has_reference.any():
        return None
    T = metrics.align_rigid(T_world_scan[has_reference, :3, 3], reference[has_reference, :3, 3])
    moved = T_world_scan[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.linalg.norm(moved - reference[:, :3, 3], axis=1))


def run_numbers(run: SlamRun, result: slam.SlamResult, sequence: LidarSequence) -> dict[str, Any]:
    """Returns the numbers of a run for `metrics.json`; the sequence has the scans that were placed."""
    T, reference = result.T_world_scan, sequence.T_world_lidar
    statuses = collections.Counter(report.status for report in result.reports)
    loops = collections.Counter(loop.status for loop in result.loops)
    return {
        "sequence": sequence.name,
        "num_scans": len(T),
        "path_m": float(metrics.path_lengths(T).max(initial=0.0)),
        "reference_doubt": reference_doubt(T, sequence),
        "num_keyframes": len(result.keyframes),
        "num_new_keyframes": sum(report.is_keyframe for report in result.reports),
        "num_parts": count_parts(result.map),
        "num_loops": loops["accepted"],
        **trajectory_errors(T, reference),
        **trajectory_errors(result.T_odometry_scan, reference, "_odometry"),
        "scan_statuses": dict(statuses),
        "num_unknown_along": sum(report.is_unknown_along for report in result.reports),
        "loop_statuses": dict(loops),
        "scans_per_s": run.num_done / run.run_s if run.num_done else None,
        "run_s": run.run_s,
        "compile_s": run.compile_s,
        "stages_s": run.stages_s,
        "stages_ms_per_scan": {name: 1000 * s / max(run.num_done, 1) for name, s in run.stages_s.items()},
    }


def why_failed(statuses: Mapping[str, int]) -> str | None:
    """Returns the reason why a finished run has no result; None where it has one.

    Args:
        statuses: number of scans by status.

    Returns:
        One text.
    """
    num_scans, num_empty = sum(statuses.values()), statuses.get("empty", 0)
    num_aligned = statuses.get("tracked", 0) + statuses.get("network", 0)
    if num_scans and num_empty == num_scans:
        return f"{num_empty} of {counted(num_scans, 'scan')} without enough points, no map was made"
    if num_scans > 1 and not num_aligned:
        return f"none of {counted(num_scans, 'scan')} could be aligned with those before, the trajectory is no result"
    return None


def run_status(numbers: Mapping[str, Any], is_interrupted: bool) -> str:
    """Returns the status of a finished run.

    Args:
        numbers: of the run.
        is_interrupted: True for a run that stopped before its end.

    Returns:
        done; uncertain: less than half of the scans were aligned in all directions, or no loop joins all parts of the
        map; failed: none aligned; interrupted: before its end.
    """
    statuses = numbers["scan_statuses"]
    if is_interrupted:
        return "interrupted"
    if why_failed(statuses) is not None:
        return "failed"
    if numbers["num_parts"] > 1:
        return "uncertain"
    num_placed = sum(statuses.get(status, 0) for status in ("first", "tracked", "network"))
    num_sure = num_placed - numbers["num_unknown_along"]
    return "done" if 2 * num_sure >= sum(statuses.values()) else "uncertain"


def count_parts(slam_map: slam.KeyframeMap) -> int:
    """Returns the number of parts of a map that measured motions join."""
    return len(set(slam.measured_parts(slam_map).tolist()))


def summary(numbers: Mapping[str, Any]) -> str:
    """Returns the last lines on the console."""
    counts = (("scan", "num_scans"), ("keyframe", "num_new_keyframes"), ("loop closure", "num_loops"))
    scans, keyframes, loops = (counted(numbers[name], noun) for noun, name in counts)
    if numbers["num_keyframes"] > numbers["num_new_keyframes"]:
        keyframes += f" ({numbers['num_keyframes']} in the map)"
    lines = [", ".join([scans, f"{numbers['path_m']:.1f} m driven", keyframes, loops])]
    lines += [
        f"{counted(numbers['scan_statuses'][status], 'scan')} {text}"
        for status, text in UNSURE.items()
        if status in numbers["scan_statuses"]
    ]
    if numbers["num_unknown_along"]:
        unknown = counted(numbers["num_unknown_along"], "scan")
        lines.append(f"{unknown} where nothing faces the axis of a corridor: the last speed goes on there, uncertain")
    if len(lines) > 1:
        lines[-1] += " (scans.csv has the reason for each)"
    if numbers["num_parts"] > 1:
        lines.append(f"the map has {numbers['num_parts']} parts that no loop joins; their relative pose is a guess")
    if numbers["reference_doubt"] is not None:
        lines.append(f"warning: {numbers['reference_doubt']}")
    if "ate_m" in numbers:
        lines.append("errors against the reference poses (ATE of the whole drive, RPE from scan to scan):")
    for suffix, name in (("_odometry", "odometry alone"), ("", "SLAM")):
        if f"ate{suffix}_m" in numbers:
            line = f"  {name:14}  ATE {numbers[f'ate{suffix}_m']:.3f} m, RPE {numbers[f'rpe{suffix}_m']:.3f} m"
            t_rel, r_rel = numbers.get(f"t_rel{suffix}_percent"), numbers.get(f"r_rel{suffix}_deg_per_100m")
            is_long = t_rel is not None and math.isfinite(t_rel)
            lines.append(line + (f", {t_rel:.2f} %, {r_rel:.2f} degrees/100 m" if is_long else ""))
    speed = numbers["scans_per_s"]
    if speed is not None:
        slowest = sorted(numbers["stages_ms_per_scan"].items(), key=lambda entry: -entry[1])[:4]
        stages = ", ".join(f"{name} {ms:.0f}" for name, ms in slowest)
        lines.append(f"{speed:.1f} scans/s (ms a scan: {stages}); compilation took {numbers['compile_s']:.0f} s more")
    return "\n".join(lines)
