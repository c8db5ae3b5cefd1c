"""Refinements of our run in `dpm_evaluate --slam --refine`: by DeepMapping, and by Open3D's multiway registration."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from dpmjax.cli import map_drive, progress_bar
from dpmjax.slam import SlamMethods, place_scans, refine_keyframes
from experiments._slam_evaluation import Drive, StoppedError, common_numbers

REFINED, MULTIWAY = "ours, refined by DeepMapping", "ours, refined by multiway registration"


def evaluate_refinement(drive: Drive, methods: SlamMethods, method: str, seed: int) -> dict[str, Any]:
    """Refines the keyframes of our run, which goes on from its state, and measures the poses of all scans."""
    run, result = map_drive(drive.folder, drive.sequence, methods, drive.is_stopped)
    if len(run.reports) < len(drive.sequence):
        raise StoppedError
    T, numbers = result.map.T_world_keyframe, {}

    def read_keyframe(row: int) -> np.ndarray:
        return drive.sequence.read_points(result.map.keyframes[row].scan)

    clock = time.perf_counter()
    if method == REFINED:
        with progress_bar("refine", " windows of keyframes") as on_window:
            refined = refine_keyframes(
                result.map, read_keyframe, key=jax.random.key(seed), on_window=on_window, stop=drive.is_stopped
            )
        T = refined.slam_map.T_world_keyframe
        numbers = {"refine_windows": refined.num_windows, "refine_windows_improved": refined.num_improved}
    elif len(T) > 1:
        from experiments.baselines.multiway import multiway_clouds

        T = multiway_clouds([read_keyframe(row) for row in range(len(T))], T)
    seconds = time.perf_counter() - clock
    if drive.is_stopped():
        raise StoppedError
    row = common_numbers(drive, method, place_scans(T, run.reports), [])
    return {**row, **numbers, "num_keyframes": len(T), "scan_s": seconds / len(drive.sequence)}
