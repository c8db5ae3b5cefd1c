"""Localisation of `dpm_evaluate --slam`: random scans of a drive in the map that SLAM made of its first half."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from tqdm import tqdm

from dpmjax import load_map, save_map
from dpmjax.cli import localization_errors
from dpmjax.io import LidarSequence
from dpmjax.saved_maps import Precision
from dpmjax.slam import SlamMethods, localize_each
from experiments._slam_evaluation import Drive, StoppedError, first_keyframes, map_path


def evaluate_localization(
    drive: Drive, methods: SlamMethods, precision: Precision, num: int, seed: int
) -> dict[str, Any]:
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
    errors = localization_errors(found, slam_map, known, drive.reference[chosen])
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
            raise StoppedError
        yield part.read_points(number)
