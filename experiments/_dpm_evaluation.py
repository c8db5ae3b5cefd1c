"""Rows of `dpm_evaluate`: registrations by the model, without it and by KISS-Matcher on the same pairs; the table."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from dpmjax import registration_recall
from dpmjax.deeppointmap import Model
from dpmjax.deeppointmap.confidence import probability
from dpmjax.deeppointmap.verification import VerificationConfig, choose_motion, measure_scan, refine_motion
from dpmjax.io import LidarSequence
from dpmjax.viz import RegisteredPair
from experiments._dpm_pairs import Clock, ScanPair, draw_pairs, median_seconds, read_pairs, register_pair

# KISS-Matcher's voxels, metres; indoors is where half of the points are nearer than INDOORS_M.
VOXEL_M, INDOOR_VOXEL_M, INDOORS_M = 0.3, 0.2, 5.0
Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]


def evaluate_registrations(
    model: Model, drive: LidarSequence, band: str, num_pairs: int, seed: int, bar: tqdm
) -> dict[str, Any]:
    """Returns errors by stage, confidence and seconds of the model on the pairs of a band."""
    motions: dict[str, list[np.ndarray]] = {"descriptors": [], "verified": [], "refined": []}
    confidence, seconds, true = [], [], []
    calibration = model.config.calibration
    for number, pair in enumerate(_pairs(drive, band, num_pairs, seed, bar)):
        if number == 0:
            register_pair(model, pair)  # compiles
        found = register_pair(model, pair)
        for stage, T in found.motions.items():
            motions[stage].append(T)
        of_scans, score = found.evidence.of_scans, float(found.evidence.of_clouds[1])
        is_calibrated = calibration is not None and of_scans is not None
        confidence.append(float(probability(calibration.of_scans, of_scans)) if is_calibrated else score)
        seconds.append(found.seconds)
        true.append(pair.T_target_source)
    row: dict[str, Any] = {"is_calibrated": calibration is not None, "num_asked": num_pairs, "confidence": confidence}
    for stage, of_stage in motions.items():
        row |= _errors(of_stage, true, f"_{stage}")
    is_right = row.pop("is_right_refined")
    return {
        **row,
        "is_right": is_right.tolist(),
        "motions": np.reshape(motions["refined"], (-1, 16)).tolist(),
        **median_seconds(seconds),
    }


def why_no_kiss() -> str | None:
    """Returns why KISS-Matcher cannot run; None where it can."""
    if importlib.util.find_spec("kiss_matcher") is None:
        return "it is not installed (pip install dpmjax[kiss])"
    return None


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
        clock = Clock()
        motions.append(matcher(pair.source, pair.target))
        clock.stop("match")
        seconds.append(clock.seconds)
        true.append(pair.T_target_source)
    row = _errors(motions, true, "_refined")
    return {**row, "is_right": row.pop("is_right_refined"), **median_seconds(seconds)}


def calibration_numbers(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the Brier score of the confidence, over all pairs and over those of each band."""
    mine = [row for row in rows if row["method"] == "DeepPointMap" and row["num_pairs"]]

    def brier(some: Sequence[dict[str, Any]]) -> float:
        errors = [np.asarray(row["confidence"]) - np.asarray(row["is_right"], float) for row in some]
        return float(np.mean(np.concatenate(errors) ** 2))

    bands = dict.fromkeys(row["band"] for row in mine)
    numbers = {f"brier_{band}": brier([row for row in mine if row["band"] == band]) for band in bands}
    return {"brier": brier(mine), **numbers} if mine else {}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns the table as Markdown: a row for each sequence and distance."""
    lines = [
        "| sequence | distance | pairs | recall, descriptors | recall, verified | recall, refined "
        "| search without network | KISS-Matcher "
        "| median error, descriptors | median error, refined | s / pair | KISS, s | overlap AUC |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    by_case = {(row["method"], row["sequence"], row["band"]): row for row in rows}
    names = {"near": "2-10 m", "middle": "10-20 m"}
    for (method, sequence, band), row in by_case.items():
        if method != "DeepPointMap" or band not in names or not row["num_pairs"]:
            continue
        kiss, search = (by_case.get((other, sequence, band), {}) for other in ("KISS-Matcher", "search"))
        auc = by_case.get(("overlap", sequence, "all"), {}).get("auc") if band == "near" else None
        errors = " | ".join(_length(row[f"median_error_{stage}_m"]) for stage in ("descriptors", "refined"))
        recalls = " | ".join(f"{row[f'recall_{stage}']:.2f}" for stage in ("descriptors", "verified", "refined"))
        others = " | ".join(_number(other.get("recall_refined")) for other in (search, kiss))
        lines.append(
            f"| {sequence} | {names[band]} | {row['num_pairs']} | {recalls} | {others} | {errors} "
            f"| {_number(row['pair_s'])} | {_number(kiss.get('pair_s'))} | {_number(auc, 3)} |"
        )
    return "\n".join(lines)


def worst_failures(
    drives: Sequence[LidarSequence], rows: Sequence[dict[str, Any]], num_shown: int, seed: int
) -> list[RegisteredPair]:
    """Returns the wrong registrations of overlapping pairs that the model was most confident of."""
    names = {drive.name: drive for drive in drives}
    wrong = [
        (row["confidence"][number], row, number)
        for row in rows
        if row["band"] != "far"
        for number in np.flatnonzero(~np.asarray(row["is_right"], bool))
    ]
    shown = []
    for confidence, row, number in sorted(wrong, key=lambda failure: -failure[0])[:num_shown]:
        drive = names[row["sequence"]]
        drawn = draw_pairs(drive, row["band"], row["num_asked"], seed)
        *_, pair = read_pairs(drive, drawn[: number + 1], seed)
        a, b = drawn[number]
        title = f"{drive.name}: scan {a} onto {b}, confidence {confidence:.2f}"
        T = np.asarray(row["motions"][number]).reshape(4, 4)
        shown.append(RegisteredPair(title, pair.source, pair.target, {"found": T, "true": pair.T_target_source}))
    return shown


def _pairs(drive: LidarSequence, band: str, num_pairs: int, seed: int, bar: tqdm) -> Iterator[ScanPair]:
    for pair in read_pairs(drive, draw_pairs(drive, band, num_pairs, seed), seed):
        yield pair
        bar.update(1)


def _errors(motions: Sequence[np.ndarray], true: Sequence[np.ndarray], suffix: str) -> dict[str, Any]:
    """Returns recall, and the median errors of right registrations."""
    recall = registration_recall(np.reshape(motions, (-1, 4, 4)), np.reshape(true, (-1, 4, 4)))
    is_right = recall.is_right
    errors = np.column_stack([recall.translation_errors_m, recall.rotation_errors_deg])[is_right]
    metres, degrees = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
    return {
        "num_pairs": len(is_right),
        f"recall{suffix}": recall.recall if len(is_right) else None,
        f"median_error{suffix}_m": float(metres),
        f"median_error{suffix}_deg": float(degrees),
        f"translation_errors{suffix}_m": recall.translation_errors_m,
        f"rotation_errors{suffix}_deg": recall.rotation_errors_deg,
        f"is_right{suffix}": is_right,
    }


def _number(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _length(metres: float | None) -> str:
    return "-" if metres is None or np.isnan(metres) else f"{metres:.3f} m"
