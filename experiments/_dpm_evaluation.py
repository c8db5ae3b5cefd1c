"""Rows of `dpm_evaluate` besides the model's own: the search without a network and KISS-Matcher; the table."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from dpmjax import registration_recall
from dpmjax.cli import BAND_NAMES, error_columns
from dpmjax.deeppointmap import (
    ScanPair,
    VerificationConfig,
    choose_motion,
    draw_scan_pairs,
    measure_scan,
    read_scan_pairs,
    refine_motion,
)
from dpmjax.io import LidarSequence
from experiments._dpm_pooled import KISS, NETWORK, SEARCH, VERIFIED

# KISS-Matcher's voxels, metres; indoors is where half of the points are nearer than INDOORS_M.
VOXEL_M, INDOOR_VOXEL_M, INDOORS_M = 0.3, 0.2, 5.0
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]


def kiss_matcher(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns `T_target_source` of KISS-Matcher (Lim et al. 2025)."""
    import kiss_matcher

    ranges = np.linalg.norm(np.concatenate([source, target]), axis=1)
    voxel_m = INDOOR_VOXEL_M if np.median(ranges) < INDOORS_M else VOXEL_M
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_m))
    found = matcher.estimate(list(source.astype(np.float32)), list(target.astype(np.float32)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
    return T


def search_alone(source: np.ndarray, target: np.ndarray, config: VerificationConfig) -> np.ndarray:
    """Returns `T_target_source` of what `register` does around the network: it searches among the views from above."""
    measured = measure_scan(source, config), measure_scan(target, config)
    chosen = choose_motion(*measured, np.eye(4)[None], config)
    return refine_motion(*measured, chosen, config).T_target_source


def evaluate_matcher(
    matcher: Matcher, drive: LidarSequence, band: str, num_pairs: int, seed: int, bar: tqdm
) -> dict[str, Any]:
    """Returns errors and seconds of another matcher on the same pairs."""
    motions, seconds, true = [], [], []
    for pair in _pairs(drive, band, num_pairs, seed, bar):
        started = time.perf_counter()
        motions.append(matcher(pair.source, pair.target))
        seconds.append(time.perf_counter() - started)
        true.append(pair.T_target_source)
    errors = registration_recall(np.reshape(motions, (-1, 4, 4)), np.reshape(true, (-1, 4, 4)))
    row = error_columns(errors, "_refined")
    return {
        **row,
        "is_right": row.pop("is_right_refined"),
        **({"pair_s": float(np.median(seconds))} if seconds else {}),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the rows as a Markdown table: one line a sequence and distance."""
    lines = [
        f"| sequence | distance | pairs | recall: {NETWORK} | {VERIFIED} | the same, refined | {SEARCH}, refined "
        f"| {KISS} | median error: network alone | refined | s / pair | {KISS}, s | overlap AUC |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    by_case = {(row["method"], row["sequence"], row["band"]): row for row in rows}
    for (method, sequence, band), row in by_case.items():
        if method != "DeepPointMap" or band not in BAND_NAMES or not row["num_pairs"]:
            continue
        kiss, search = (by_case.get((other, sequence, band), {}) for other in ("KISS-Matcher", "search"))
        auc = by_case.get(("overlap", sequence, "all"), {}).get("auc") if band == "near" else None
        errors = " | ".join(_length(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined"))
        recalls = " | ".join(f"{row[f'recall_{stage}']:.2f}" for stage in ("descriptors", "verified", "refined"))
        others = " | ".join(_number(other.get("recall_refined")) for other in (search, kiss))
        lines.append(
            f"| {sequence} | {BAND_NAMES[band]} | {row['num_pairs']} | {recalls} | {others} | {errors} "
            f"| {_number(row['pair_s'])} | {_number(kiss.get('pair_s'))} | {_number(auc, 3)} |"
        )
    return "\n".join(lines)


def _pairs(drive: LidarSequence, band: str, num_pairs: int, seed: int, bar: tqdm) -> Iterator[ScanPair]:
    for pair in read_scan_pairs(drive, draw_scan_pairs(drive, band, num_pairs, seed=seed), seed=seed):
        yield pair
        bar.update(1)


def _number(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _length(metres: float | None) -> str:
    return "-" if metres is None or np.isnan(metres) else f"{metres:.3f} m"
