"""Rows of an evaluation of weights: the drives, registrations and overlap of a drive as JSON, numbers and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dpmjax import viz
from dpmjax.cli.drive_sources import Source, find_sources
from dpmjax.cli.run_folder import RunFolder
from dpmjax.deeppointmap import (
    Model,
    ScanEvaluation,
    draw_scan_pairs,
    evaluate_overlap,
    evaluate_scan_pairs,
    read_scan_pairs,
)
from dpmjax.metrics import RegistrationRecall, brier_score
from dpmjax.sequences import LidarSequence

FIRST_TOWN = 5_000_000
"""Seed of the first town; no training, selection or calibration uses these towns."""

NUM_SHOWN = 4
STAGES = ("descriptors", "verified", "refined")
BAND_NAMES = {"near": "2-10 m", "middle": "10-20 m"}
Row = dict[str, Any]


def evaluation_towns(num_towns: int, length_m: float, kinds: Sequence[str | None] = (None,)) -> list[Source]:
    """Returns towns that no training has seen; the kinds of place take turns, None draws one."""
    return [
        Source(town_seed=FIRST_TOWN + number, town_length_m=length_m, town_kind=kinds[number % len(kinds)])
        for number in range(num_towns)
    ]


def open_evaluation_drives(data: Sequence[str], towns: Sequence[Source]) -> list[LidarSequence]:
    """Opens the drives of a command line.

    Args:
        data: folders, or `town` for the towns.
        towns: towns from `evaluation_towns`.

    Returns:
        The drives, each with poses, near pairs and a name of its own.

    Raises:
        ValueError: a path cannot be read, or a drive has no poses or no pairs, or two drives have the same name.
    """
    drives = [source.open() for source in find_sources(data, towns)]
    for drive in drives:
        if not len(draw_scan_pairs(drive, "near", 1)):
            raise ValueError(f"{drive.name}: no two scans are 2 to 10 m apart; are the poses in metres?")
    names = [drive.name for drive in drives]
    if len(set(names)) < len(names):
        raise ValueError(f"two drives have the same name ({', '.join(sorted(names))}); evaluate them one by one")
    return drives


def registration_row(
    model: Model, drive: LidarSequence, band: str, num_pairs: int, *, seed: int, on_pair: Callable[[], object]
) -> Row:
    """Returns errors by stage, confidence and seconds of the registrations of a band of distances."""
    pairs = read_scan_pairs(drive, draw_scan_pairs(drive, band, num_pairs, seed=seed), seed=seed)
    found = evaluate_scan_pairs(model, pairs, on_pair=on_pair)
    row: Row = {
        "is_calibrated": model.config.calibration is not None,
        "num_asked": num_pairs,
        "confidence": found.confidence.tolist(),
    }
    for stage in STAGES:
        row |= error_columns(getattr(found, stage), f"_{stage}")
    is_right = row.pop("is_right_refined")
    return {
        **row,
        "is_right": is_right.tolist(),
        "motions": found.T_target_source.reshape(-1, 16).tolist(),
        **_seconds(found),
    }


def overlap_row(model: Model, drive: LidarSequence, num_pairs: int, *, seed: int, on_scan: Callable[[], object]) -> Row:
    """Returns AUC and Brier score of the overlap probability; AUC None where the drive lacks pairs."""
    found = evaluate_overlap(model, drive, num_pairs, seed=seed, on_scan=on_scan)
    row: Row = {"auc": None, "has_revisits": found.has_revisits, "num_pairs": len(found.is_overlap)}
    if not len(found.is_overlap):
        return row
    return {
        **row,
        "auc": found.area_under_curve,
        "brier": found.brier_score,
        "probability": found.probability.tolist(),
        "is_overlap": found.is_overlap.tolist(),
    }


def error_columns(errors: RegistrationRecall, suffix: str) -> Row:
    """Returns the recall, all errors, and the median errors of right registrations."""
    is_right = errors.is_right
    of_right = np.column_stack([errors.translation_errors_m, errors.rotation_errors_deg])[is_right]
    metres, degrees = np.median(of_right, axis=0) if len(of_right) else (np.nan, np.nan)
    return {
        "num_pairs": len(is_right),
        f"recall{suffix}": errors.recall if len(is_right) else None,
        f"median_error{suffix}_m": float(metres),
        f"median_error{suffix}_deg": float(degrees),
        f"translation_errors{suffix}_m": errors.translation_errors_m,
        f"rotation_errors{suffix}_deg": errors.rotation_errors_deg,
        f"is_right{suffix}": is_right,
    }


def calibration_numbers(rows: Sequence[Row]) -> Row:
    """Returns the Brier score of the confidence, over all pairs and those of each band, and `is_calibrated`."""
    known = [row for row in rows if "confidence" in row and row["num_pairs"]]

    def brier(some: Sequence[Row]) -> float:
        confidence, is_right = (np.concatenate([row[name] for row in some]) for name in ("confidence", "is_right"))
        return brier_score(confidence, is_right.astype(bool))

    bands = dict.fromkeys(row["band"] for row in known)
    numbers = {f"brier_{band}": brier([row for row in known if row["band"] == band]) for band in bands}
    is_calibrated = all(row["is_calibrated"] for row in known)
    return {"brier": brier(known), **numbers, "is_calibrated": is_calibrated} if known else {}


def draw_evaluation(
    folder: RunFolder, drives: Sequence[LidarSequence], rows: Sequence[Row], *, title: str, seed: int
) -> None:
    """Draws reliability.png, and failures.png where a registration of an overlapping pair is wrong."""
    known = [row for row in rows if "confidence" in row]
    confidence, is_right = (np.concatenate([[], *(row[name] for row in known)]) for name in ("confidence", "is_right"))
    viz.save_figure(viz.reliability_figure(confidence, is_right, title=title), folder / "reliability.png")
    if worst := worst_failures(drives, known, NUM_SHOWN, seed):
        viz.save_figure(viz.registered_pairs_figure(worst), folder / "failures.png")


def worst_failures(
    drives: Sequence[LidarSequence], rows: Sequence[Row], num_shown: int, seed: int
) -> list[viz.RegisteredPair]:
    """Returns the wrong registrations of overlapping pairs that have the highest confidence."""
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
        drawn = draw_scan_pairs(drive, row["band"], row["num_asked"], seed=seed)
        *_, pair = read_scan_pairs(drive, drawn[: number + 1], seed=seed)
        a, b = drawn[number]
        title = f"{drive.name}: scan {a} onto {b}, confidence {confidence:.2f}"
        T = np.asarray(row["motions"][number]).reshape(4, 4)
        motions = {"found": T, "true": pair.T_target_source}
        shown.append(viz.RegisteredPair(title, pair.source, pair.target, motions))
    return shown


def _seconds(found: ScanEvaluation) -> Row:
    if not len(found.confidence):
        return {}
    stages = {f"{stage}_s": float(np.median(of_stage)) for stage, of_stage in found.seconds._asdict().items()}
    return {**stages, "pair_s": float(np.median(found.seconds.total))}
