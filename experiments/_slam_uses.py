"""Uses of the finished SLAM run of `dpm_evaluate --slam`: localisation in its map, and refinements of its keyframes."""

from __future__ import annotations

import time
from collections.abc import Iterator

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import cli, load_map, save_map
from dpmjax.io import LidarSequence
from dpmjax.saved_maps import Precision
from dpmjax.slam import SlamMethods, localize_each, place_scans, refine_keyframes
from experiments._slam_evaluation import Drive, common_numbers, first_keyframes, map_path

REFINED, MULTIWAY = "ours, refined by DeepMapping", "ours, refined by multiway registration"


def evaluate_localization(drive: Drive, methods: SlamMethods, precision: Precision, num: int, seed: int) -> cli.Row:
    """Looks for random scans of the drive in the map of its first half, saved and loaded at a precision.

    The map is that of the SLAM run. No scan is one of its keyframes. A scan is in the map where a keyframe of the whole
    first half is near; elsewhere the right answer is that it is not.
    """
    assert drive.reference is not None
    if not map_path(drive.folder.path, "float32").exists():  # no scan had points enough
        return {"num_scans": 0}
    whole = load_map(map_path(drive.folder.path, "float32"))
    num_early = sum(keyframe.scan < len(drive.sequence) / 2 for keyframe in whole.keyframes)
    half = first_keyframes(whole, max(num_early, 1))
    path = save_map(drive.folder / f"first_half_{precision}.npz", half, precision)
    slam_map, taken = load_map(path), {keyframe.scan for keyframe in half.keyframes}
    others = [scan for scan in range(len(drive.sequence)) if scan not in taken]
    chosen = np.sort(np.random.default_rng(seed).choice(others, min(num, len(others)), replace=False))
    part = drive.sequence.take(chosen)
    known = drive.reference[[keyframe.scan for keyframe in slam_map.keyframes]]
    found, seconds, clock = [], [], time.perf_counter()
    for one in localize_each(methods, slam_map, _points_of(part, drive, precision)):
        found.append(one)
        seconds.append(time.perf_counter() - clock)
        clock = time.perf_counter()
    errors = cli.localization_errors(found, slam_map, known, drive.reference[chosen])
    keyframes = drive.reference[sorted(taken), :3, 3]
    apart = np.linalg.norm(drive.reference[chosen][:, None, :3, 3] - keyframes[None], axis=2).min(axis=1)
    is_inside, is_found, is_right = apart <= drive.scale.reach_m, errors.is_found, errors.is_right
    return {
        "num_scans": len(found),
        "num_keyframes": len(slam_map),
        "map_bytes": path.stat().st_size,
        "num_inside": int(is_inside.sum()),
        "num_right": int((is_inside & is_right).sum()),
        "num_wrong": int((is_inside & is_found & ~is_right).sum()),
        "num_outside": int((~is_inside).sum()),
        "num_outside_right": int((~is_inside & is_right).sum()),
        "num_outside_wrong": int((~is_inside & is_found & ~is_right).sum()),
        "median_error_m": float(np.median(errors.translation_m[is_right])) if is_right.any() else None,
        "scan_s": float(np.median(seconds)),
    }


def _points_of(part: LidarSequence, drive: Drive, precision: str) -> Iterator[np.ndarray]:
    for number in tqdm(range(len(part)), desc=f"{part.name}, {precision}", unit=" scans", dynamic_ncols=True):
        if drive.is_stopped():
            raise cli.RowStopped
        yield part.read_points(number)


def evaluate_refinement(drive: Drive, methods: SlamMethods, method: str, seed: int) -> cli.Row:
    """Refines the keyframes of our run, which goes on from its state, and measures the poses of all scans."""
    run, result = cli.map_drive(drive.folder, drive.sequence, methods, drive.is_stopped)
    if len(run.reports) < len(drive.sequence):
        raise cli.RowStopped
    T, numbers = result.map.T_world_keyframe, {}

    def read_keyframe(row: int) -> np.ndarray:
        return drive.sequence.read_points(result.map.keyframes[row].scan)

    clock = time.perf_counter()
    if method == REFINED:
        with cli.progress_bar("refine", " windows of keyframes") as on_window:
            refined = refine_keyframes(
                result.map, read_keyframe, key=jax.random.key(seed), on_window=on_window, stop=drive.is_stopped
            )
        T = refined.slam_map.T_world_keyframe
        numbers = {"refine_windows": refined.num_windows, "refine_windows_improved": refined.num_improved}
    elif len(T) > 1:
        from experiments._baselines import multiway_clouds

        T = multiway_clouds([read_keyframe(row) for row in range(len(T))], T)
    seconds = time.perf_counter() - clock
    if drive.is_stopped():
        raise cli.RowStopped
    row = common_numbers(drive, method, place_scans(T, run.reports), [])
    return {**row, **numbers, "num_keyframes": len(T), "scan_s": seconds / len(drive.sequence)}
