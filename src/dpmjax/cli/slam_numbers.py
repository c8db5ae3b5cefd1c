"""Numbers of SLAM and of localization for metrics.json: errors, counts, status and verdict."""

from __future__ import annotations

import collections
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dpmjax import geometry, metrics, slam
from dpmjax.cli.run import Numbers
from dpmjax.sequences import LidarSequence, counted


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


# Of 120 scans of a sound drive up to five are guessed; 53 blind ones ended metres off.
MAX_GUESSED_SHARE = 0.1

UNSURE = {
    "network": "placed by the network: at the start, or because alignment with the scans before failed",
    "coasting": "where nothing faces the axis of a corridor: the last speed goes on there, uncertain",
    "predicted": "placed by the predicted motion only: uncertain",
    "restarted": "not placed: a new part of the map begins there",
    "empty": "without enough points",
}
"""Texts for scans that were not aligned with the scans before them, by status."""


def run_numbers(result: slam.SlamResult, sequence: LidarSequence) -> Numbers:
    """Returns the numbers of a map for `metrics.json`; the sequence has the scans that were placed."""
    T, reference = result.T_world_scan, sequence.T_world_lidar
    loops = collections.Counter(loop.status for loop in result.loops)
    numbers = {
        "sequence": sequence.name,
        "num_scans": len(T),
        "path_m": float(metrics.path_lengths(T).max(initial=0.0)),
        "reference_doubt": metrics.reference_doubt(T, sequence),
        "num_keyframes": len(result.keyframes),
        "num_new_keyframes": sum(report.is_keyframe for report in result.reports),
        "num_parts": count_parts(result.map),
        "num_loops": loops["accepted"],
        **metrics.trajectory_errors(T, reference),
        **metrics.trajectory_errors(result.T_odometry_scan, reference, "_odometry"),
        "scan_statuses": dict(collections.Counter(report.status for report in result.reports)),
        "loop_statuses": dict(loops),
    }
    return {"status": status_of(numbers), "verdict": verdict_of(numbers), **numbers}


def why_failed(statuses: Mapping[str, int]) -> str | None:
    """Returns the reason why a finished run has no result; None where it has one.

    Args:
        statuses: number of scans by status.

    Returns:
        One text.
    """
    num_scans, num_empty = sum(statuses.values()), statuses.get("empty", 0)
    num_aligned = sum(statuses.get(status, 0) for status in ("tracked", "network", "coasting"))
    if num_scans and num_empty == num_scans:
        return f"{num_empty} of {counted(num_scans, 'scan')} without enough points, no map was made"
    if num_scans > 1 and not num_aligned:
        return f"none of {counted(num_scans, 'scan')} could be aligned with those before, the trajectory is no result"
    return None


def status_of(numbers: Numbers) -> str:
    """Returns the status of a run that came to its end.

    Args:
        numbers: of the run.

    Returns:
        done; uncertain: more than one scan and a tenth of all were not aligned in all directions, or no loop joins all
        parts of the map; failed: none aligned.
    """
    statuses = numbers["scan_statuses"]
    if why_failed(statuses) is not None:
        return "failed"
    if numbers["num_parts"] > 1:
        return "uncertain"
    num_scans = sum(statuses.values())
    num_guessed = num_scans - sum(statuses.get(status, 0) for status in ("first", "tracked", "network"))
    return "done" if num_guessed <= max(1, MAX_GUESSED_SHARE * num_scans) else "uncertain"


def count_parts(slam_map: slam.KeyframeMap) -> int:
    """Returns the number of parts of a map that measured motions join."""
    return len(set(slam.measured_parts(slam_map).tolist()))


def verdict_of(numbers: Numbers) -> str:
    """Returns what was mapped, and what is uncertain or wrong about it."""
    if (reason := why_failed(numbers["scan_statuses"])) is not None:
        return f"{reason}: check that the scans are 3-D, in metres, and follow each other"
    counts = (("scan", "num_scans"), ("keyframe", "num_new_keyframes"), ("loop closure", "num_loops"))
    scans, keyframes, loops = (counted(numbers[name], noun) for noun, name in counts)
    if numbers["num_keyframes"] > numbers["num_new_keyframes"]:
        keyframes += f" ({numbers['num_keyframes']} in the map)"
    texts = [", ".join([scans, f"{numbers['path_m']:.1f} m driven", keyframes, loops])]
    texts += [
        f"{counted(numbers['scan_statuses'][status], 'scan')} {text} (scans.csv has the reasons)"
        for status, text in UNSURE.items()
        if status in numbers["scan_statuses"]
    ]
    if numbers["num_parts"] > 1:
        texts.append(f"the map has {numbers['num_parts']} parts that no loop joins; their relative pose is a guess")
    if numbers["reference_doubt"] is not None:
        texts.append(f"warning: {numbers['reference_doubt']}")
    return "; ".join(texts)


def error_text(numbers: Numbers) -> str:
    """Returns the errors against the reference poses; empty without a reference."""
    lines = []
    for suffix, name in (("_odometry", "odometry alone"), ("", "SLAM")):
        if f"ate{suffix}_m" in numbers:
            ate_m, rpe_m = numbers[f"ate{suffix}_m"], numbers[f"rpe{suffix}_m"]
            line = f"{name:14}  ATE {ate_m:.3f} m, RPE from scan to scan {rpe_m:.3f} m"
            t_rel, r_rel = numbers.get(f"t_rel{suffix}_percent"), numbers.get(f"r_rel{suffix}_deg_per_100m")
            is_long = t_rel is not None and math.isfinite(t_rel)
            lines.append(line + (f", {t_rel:.2f} %, {r_rel:.2f} degrees/100 m" if is_long else ""))
    return "\n".join(lines)
