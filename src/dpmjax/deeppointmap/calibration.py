"""Calibration of a model: regressions of its confidence and of its overlap, fitted on pairs of scans with true poses.

`dpmjax train` fits them on the training part of the user's drives, and `python -m experiments.dpm_calibrate` on
simulated places, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit

from dpmjax import metrics
from dpmjax.deeppointmap.confidence import (
    CLOUD_FEATURES,
    ELEMENT_FEATURES,
    OVERLAP_FEATURES,
    SCAN_FEATURES,
    WEAK_FEATURES,
    Calibration,
    LogisticModel,
    MatchEvidence,
    calibrated_probability,
    fit_weights,
    logistic_probability,
)
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.evaluation import (
    ScanPair,
    draw_rows_apart,
    encode_pairs,
    head_overlap,
    read_scan_pairs,
    register_in_stages,
    scan_distances,
    split_places,
)
from dpmjax.deeppointmap.model import Model
from dpmjax.deeppointmap.overlap_prediction import evidence_pairs
from dpmjax.deeppointmap.registration import register_clouds
from dpmjax.deeppointmap.training.overlap_stage import draw_overlap_pairs, overlap_labels, why_no_overlap
from dpmjax.deeppointmap.training.sampling import ScanTable
from dpmjax.sequences import LidarSequence

Row = dict[str, Any]
# Smallest and largest distance of the pairs of each kind, metres.
Bands = tuple[tuple[float, float], ...]
# Probabilities of examples by fits without their place, and the labels of these examples.
HeldOut = tuple[np.ndarray, np.ndarray]

# Features of each kind of evidence; a row of a pair has a column for each, named `column_of(kind, feature)`.
KINDS = {
    "of_clouds": CLOUD_FEATURES,
    "of_elements": ELEMENT_FEATURES,
    "of_scans": SCAN_FEATURES,
    "of_weak_scans": WEAK_FEATURES,
}
OF_CLOUDS = ("of_clouds", "of_elements")
HAVE_LOOKALIKES = ("of_elements", "of_scans")
# Elements of a scan in the map of SLAM, and in `register(..., refine=True)` with a cloud.
NUM_ELEMENTS = 1024
PAIR_STREAM, OVERLAP_STREAM = 4141, 4134
# Scans that are farther apart have no overlap.
FAR_M = 60.0
DRIVE_BANDS_M = ((2.0, 10.0), (10.0, 20.0), (FAR_M, np.inf))
# Pairs of all drives of a user together: two minutes of two cores at rest.
NUM_CONFIDENCE_PAIRS, NUM_OVERLAP_PAIRS = 120, 320
# Pairs of held-out places, that the numbers are of.
NUM_TESTED_CONFIDENCE_PAIRS, NUM_TESTED_OVERLAP_PAIRS = 30, 120
# A longer drive is thinned to this number of scans: all distances of more would not fit in memory.
MAX_SCANS = 3000


class Examples(NamedTuple):
    """Examples of one kind: their places, features and labels, and the share of the probability beside lookalikes."""

    place: Int[np.ndarray, " n"]
    features: Float[np.ndarray, "n f"]
    is_right: Bool[np.ndarray, " n"]
    shares: Float[np.ndarray, " n"]


def draw_calibration_pairs(
    drive: LidarSequence, bands_m: Bands, num_pairs: int, seed: int, *, anchors: Int[np.ndarray, " a"] | None = None
) -> Iterator[ScanPair]:
    """Reads random pairs of each band of distances, fewer than `num_pairs` where the drive has fewer.

    Args:
        drive: scans with true poses.
        bands_m: smallest and largest distance of each band, metres.
        num_pairs: number of pairs of a band.
        seed: seed of the draws.
        anchors: scans of which one must be in each pair; None for all.

    Yields:
        The pairs.
    """
    distances = scan_distances(drive)
    if anchors is not None:
        distances[np.setdiff1d(np.arange(len(drive)), anchors)] = np.nan
    for number, (low, high) in enumerate(bands_m):
        drawn = draw_rows_apart(distances, low, high, num_pairs, np.random.default_rng([PAIR_STREAM, number, seed]))
        yield from read_scan_pairs(drive, drawn, seed=seed)


def measure_pair(model: Model, pair: ScanPair) -> Row:
    """Registers a pair as scans, and as clouds of surface elements.

    Args:
        model: encoder and decoder.
        pair: the pair.

    Returns:
        The evidence of each kind, `is_right` and `is_right_of_clouds`, the leads over places that look alike, infinite
        where none does, and the true distance, metres.
    """
    num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)
    result = register_in_stages(model, pair)
    clouds = [encode(model, points, num_elements=num_elements) for points in (pair.source, pair.target)]
    T_of_clouds, of_clouds = register_clouds(model, *clouds)
    motions = np.stack([T_of_clouds, result.verified])
    is_right = metrics.registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
    row: Row = {
        "is_right_of_clouds": bool(is_right[0]),
        "is_right": bool(is_right[1]),
        "distance_m": float(np.linalg.norm(pair.T_target_source[:3, 3])),
    }
    for kind, names in KINDS.items():
        # At run time clouds have the features of their own best motion, whatever the scans say.
        evidence = of_clouds if kind in OF_CLOUDS else result.evidence
        features = getattr(evidence, kind)
        values = [None] * len(names) if features is None else np.asarray(features).tolist()
        row |= {column_of(kind, name): value for name, value in zip(names, values, strict=True)}
        row[f"lookalike_gap_{kind}"] = float(evidence.lookalike_gap) if kind in HAVE_LOOKALIKES else np.inf
    return row


def column_of(kind: str, feature: str) -> str:
    """Returns the name of the column of a feature."""
    return f"{kind} {feature}"


def features_of(row: Row, kind: str) -> list[float] | None:
    """Returns the features of a kind of evidence; None where a pair has none."""
    values = [row[column_of(kind, name)] for name in KINDS[kind]]
    return None if values[0] is None else values


def measure_overlap(
    model: Model,
    drives: Sequence[LidarSequence],
    num_pairs: int,
    seed: int,
    *,
    anchors: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> list[Row]:
    """Matches pairs of which half are less than 20 m apart, each scan turned by a random yaw.

    Args:
        model: encoder and decoder.
        drives: drives with poses for all scans; pairs of two drives do not overlap.
        num_pairs: number of pairs.
        seed: seed of the pairs.
        anchors: scans of each drive of which one must be in each pair; None for all.

    Returns:
        The evidence and the label of each pair, and the probability of the head if it is trained. No pairs if the
        drives have none with overlap, or none without.
    """
    starts = np.cumsum([0, *(len(drive) for drive in drives)])
    poses = np.concatenate([np.asarray(drive.T_world_lidar) for drive in drives])
    table = ScanTable(poses, np.repeat(np.arange(len(drives)), np.diff(starts)))
    allowed = None if anchors is None else np.concatenate([rows + s for rows, s in zip(anchors, starts, strict=False)])
    if why_no_overlap(table) is not None or (allowed is not None and len(allowed) == 0):
        return []
    rng = np.random.default_rng([OVERLAP_STREAM, seed])
    pairs = draw_overlap_pairs(table, num_pairs, rng, anchors=allowed)
    sides = encode_pairs(model, drives, pairs, rng=rng)
    by_head = head_overlap(model, sides)
    names = (*OVERLAP_FEATURES, "is_overlap", *(() if by_head is None else ("head",)))
    evidence = np.asarray(evidence_pairs(model, *sides), float).T.tolist()
    columns = *evidence, overlap_labels(table, pairs).tolist(), *(() if by_head is None else (by_head.tolist(),))
    return [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)]


class MeasuredDrives(NamedTuple):
    """Measured pairs of the drives of a user.

    Attributes:
        confidence: a row for each registration, with the number of its drive as `place`, of places that are trained on.
        tested_confidence: those of held-out places.
        overlap: a row for each match; none without pairs of both labels.
        tested_overlap: those of held-out places.
    """

    confidence: list[Row]
    tested_confidence: list[Row]
    overlap: list[Row]
    tested_overlap: list[Row]


def measure_drives(
    model: Model,
    drives: Sequence[LidarSequence],
    seed: int,
    *,
    on_pair: Callable[[], object] = lambda: None,
) -> MeasuredDrives:
    """Measures pairs of the training part of drives, and pairs with a scan of their held-out places.

    Args:
        model: encoder and decoder.
        drives: drives with poses.
        seed: seed of the pairs.
        on_pair: called before each registration; an error of it ends the measurement.

    Returns:
        The measurements.
    """
    drives = [drive.take(drive.has_reference) for drive in drives]
    drives = [drive.take(slice(None, None, -(-len(drive) // MAX_SCANS))) for drive in drives]
    splits = [split_places(drive) for drive in drives]
    of_training = [drive.take(split.training) for drive, split in zip(drives, splits, strict=True)]
    held_out = [split.held_out for split in splits]

    def measure(parts: Sequence[LidarSequence], num_pairs: int, anchors: Sequence[Any]) -> list[Row]:
        num, rows = max(2, -(-num_pairs // (len(drives) * len(DRIVE_BANDS_M)))), []
        for place, (drive, anchor) in enumerate(zip(parts, anchors, strict=True)):
            for pair in draw_calibration_pairs(drive, DRIVE_BANDS_M, num, seed, anchors=anchor):
                on_pair()
                rows.append({"place": place, **measure_pair(model, pair)})
        return rows

    return MeasuredDrives(
        measure(of_training, NUM_CONFIDENCE_PAIRS, [None] * len(drives)),
        measure(drives, NUM_TESTED_CONFIDENCE_PAIRS, held_out),
        measure_overlap(model, of_training, NUM_OVERLAP_PAIRS, seed),
        measure_overlap(model, drives, NUM_TESTED_OVERLAP_PAIRS, seed + 1, anchors=held_out),
    )


def calibrate(model: Model, measured: MeasuredDrives) -> tuple[Model, Row]:
    """Fits the regressions of overlap and confidence on the drives of a user.

    Args:
        model: the model that was measured.
        measured: from `measure_drives`.

    Returns:
        The model with the regressions that the pairs could fix; and Brier scores and AUC of the held-out places.
    """
    calibration, numbers, _ = fit_confidence(measured.confidence, measured.tested_confidence)
    overlap = None
    if measured.overlap:
        overlap, overlap_numbers, _ = fit_overlap(measured.overlap, measured.tested_overlap)
        numbers |= overlap_numbers
    return replace(model, config=replace(model.config, calibration=calibration, overlap=overlap)), numbers


def fit_confidence(
    rows: Sequence[Row], tested: Sequence[Row] | None = None
) -> tuple[Calibration | None, Row, dict[str, HeldOut]]:
    """Fits the calibration of the confidence.

    Each regression is fitted on the pairs that it rates: scans on those whose walls hold all directions.

    Args:
        rows: measured pairs, each with the number of its `place`. Scans and clouds of a pair with `is_end` are left
            out, because the two ends of an ambiguous place may look alike.
        tested: pairs of other places, on which the numbers are measured. None measures each place by a fit without it.

    Returns:
        The calibration, its numbers, and the confidence and the labels of the tested pairs. No calibration if all
        registrations of scans or clouds are right, or all are wrong.
    """
    numbers: Row = {"num_pairs": len(rows)}
    models: dict[str, LogisticModel] = {}
    held_out: dict[str, HeldOut] = {}
    for kind, names in KINDS.items():
        examples = _examples(rows, kind)
        if len(np.unique(examples.is_right)) < 2:
            continue
        others = None if tested is None else _examples(tested, kind)
        models[kind], found = fit_held_out(names, examples, others)
        numbers |= {f"num_pairs_{kind}": len(examples.is_right), f"share_right_{kind}": float(examples.is_right.mean())}
        if len(found[1]):
            held_out[kind] = found
            numbers |= {
                f"brier_{kind}": metrics.brier_score(*found),
                f"brier_of_a_constant_{kind}": float(found[1].var()),
                f"calibration_error_{kind}": metrics.expected_calibration_error(*found),
            }
    is_whole = {"of_clouds", "of_scans"} <= models.keys()
    return Calibration(**models) if is_whole else None, numbers, held_out


def _examples(rows: Sequence[Row], kind: str) -> Examples:
    """Returns the registrations that a kind of evidence rates: scans those whose walls hold all directions."""
    chosen = [
        row
        for row in rows
        if features_of(row, kind) is not None
        and (kind != "of_scans" or features_of(row, "of_weak_scans") is None)
        and (kind == "of_elements" or not row.get("is_end"))
    ]
    label = "is_right_of_clouds" if kind in OF_CLOUDS else "is_right"
    return _gathered(chosen, [column_of(kind, name) for name in KINDS[kind]], label, f"lookalike_gap_{kind}")


def _gathered(rows: Sequence[Row], columns: Sequence[str], label: str, lookalike_gap: str = "") -> Examples:
    features = np.array([[row[name] for name in columns] for row in rows], float).reshape(-1, len(columns))
    place, is_right = (np.array([row.get(name, 0) for row in rows]) for name in ("place", label))
    gaps = np.array([row.get(lookalike_gap, np.inf) for row in rows], float)
    return Examples(place, features, is_right.astype(bool), expit(gaps))


def rate_pair(calibration: Calibration, row: Row, *, of_clouds: bool) -> float:
    """Returns the calibrated confidence of a pair, matched as clouds of surface elements or as scans."""
    kinds = ("of_elements",) if of_clouds else ("of_scans", "of_weak_scans")
    features = {kind: features_of(row, kind) for kind in kinds}
    known = {kind: np.asarray(values) for kind, values in features.items() if values is not None}
    evidence = MatchEvidence(np.asarray(features_of(row, "of_clouds")), None)
    evidence = evidence._replace(**known, lookalike_gap=row.get(f"lookalike_gap_{kinds[0]}", np.inf))
    return float(calibrated_probability(calibration, evidence))


def fit_overlap(rows: Sequence[Row], tested: Sequence[Row] | None = None) -> tuple[LogisticModel, Row, HeldOut]:
    """Fits the regression of overlap.

    Args:
        rows: pairs from `measure_overlap`, each with its `place` where no others are tested.
        tested: pairs of other places, that the numbers are of; None takes each place by a fit without it.

    Returns:
        The regression; the AUC and the Brier score of it, and of the head where that was measured; and the probability
        and the label of the tested pairs.
    """
    others = None if tested is None else _gathered(tested, OVERLAP_FEATURES, "is_overlap")
    fitted, found = fit_held_out(OVERLAP_FEATURES, _gathered(rows, OVERLAP_FEATURES, "is_overlap"), others)
    numbers: Row = {"num_overlap_pairs": len(rows), "num_tested_overlap_pairs": len(found[1])}
    probabilities = {"overlap": found[0]}
    if tested and "head" in tested[0]:
        probabilities["head"] = np.array([row["head"] for row in tested])
    for name, probability in probabilities.items() if len(found[1]) else ():
        numbers[f"auc_{name}"] = metrics.area_under_curve(probability, found[1])
        numbers[f"brier_{name}"] = metrics.brier_score(probability, found[1])
        numbers["brier_of_a_constant_overlap"] = float(found[1].var())
    return fitted, numbers, found


def fit_held_out(
    names: tuple[str, ...], examples: Examples, tested: Examples | None = None
) -> tuple[LogisticModel, HeldOut]:
    """Fits a regression on all places, and predicts examples of places that their fit has not seen.

    Args:
        names: names of the features.
        examples: examples of the fit.
        tested: examples of other places; None takes each place by a fit on all others.

    Returns:
        The regression, and the probabilities and the labels of the tested examples.
    """
    place, *of_examples = examples

    def fit(rows: Bool[np.ndarray, " n"] | slice) -> LogisticModel:
        return LogisticModel(names, *fit_weights(*(values[rows] for values in of_examples)))

    fitted = fit(slice(None))
    if tested is not None:
        return fitted, (tested.shares * logistic_probability(fitted, tested.features), tested.is_right)
    found = np.empty(len(place))
    for one in np.unique(place):
        part = place == one
        found[part] = examples.shares[part] * logistic_probability(fit(~part), examples.features[part])
    return fitted, (found, examples.is_right)
