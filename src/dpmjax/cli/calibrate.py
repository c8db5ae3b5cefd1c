"""Calibration of a model: regressions of its confidence and of its overlap, fitted on pairs of scans with true poses.

`dpmjax train` fits them on the training part of the user's drives, and `python -m experiments.dpm_calibrate` on
simulated places, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax import deeppointmap as dpm
from dpmjax import metrics
from dpmjax.sequences import LidarSequence

Row = dict[str, Any]
# Smallest and largest distance of the pairs of each kind, metres.
Bands = tuple[tuple[float, float], ...]
# Probabilities of examples by fits without their place, and the labels of these examples.
HeldOut = tuple[np.ndarray, np.ndarray]

KINDS = ("of_clouds", "of_elements", "of_scans", "of_weak_scans")
OF_CLOUDS = ("of_clouds", "of_elements")
HAVE_LOOKALIKES = ("of_elements", "of_scans")
# Elements of a scan in the map of SLAM, and in `register(..., refine=True)` with a cloud.
NUM_ELEMENTS = 1024
PAIR_STREAM, OVERLAP_STREAM = 4141, 4134
# The two ends of a corridor may look alike. Only `register` of clouds has to know: SLAM proposes neighbours, and scans
# tell the ends apart.
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
) -> Iterator[dpm.ScanPair]:
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
    distances = dpm.scan_distances(drive)
    if anchors is not None:
        distances[np.setdiff1d(np.arange(len(drive)), anchors)] = np.nan
    for number, (low, high) in enumerate(bands_m):
        drawn = dpm.draw_rows_apart(distances, low, high, num_pairs, np.random.default_rng([PAIR_STREAM, number, seed]))
        yield from dpm.read_scan_pairs(drive, drawn, seed=seed)


def measure_pairs(model: dpm.Model, pairs: Iterable[dpm.ScanPair], on_pair: Callable[[], object] = lambda: None) -> Row:
    """Registers pairs as scans, and as clouds of surface elements.

    Args:
        model: encoder and decoder.
        pairs: the pairs.
        on_pair: called before each registration.

    Returns:
        Lists with an entry for each pair: the evidence of each kind, whether both registrations are right, and the
        true distance, metres.
    """
    gaps = [f"lookalike_gap_{kind}" for kind in HAVE_LOOKALIKES]
    found: Row = {name: [] for name in (*KINDS, *gaps, "is_right_of_clouds", "is_right", "distance_m")}
    num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)
    for pair in pairs:
        on_pair()
        result = dpm.register_in_stages(model, pair)
        clouds = [dpm.encode(model, points, num_elements=num_elements) for points in (pair.source, pair.target)]
        T_of_clouds, evidence_of_clouds = dpm.register_clouds(model, *clouds)
        motions = np.stack([T_of_clouds, result.verified])
        is_right = metrics.registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
        for name in KINDS:
            # At run time clouds have the features of their own best motion, whatever the scans say.
            features = getattr(evidence_of_clouds if name in OF_CLOUDS else result.evidence, name)
            found[name].append(None if features is None else features.tolist())
        for name, evidence in zip(gaps, (evidence_of_clouds, result.evidence), strict=True):
            gap = float(evidence.lookalike_gap)
            found[name].append(gap if np.isfinite(gap) else None)
        found["is_right_of_clouds"].append(bool(is_right[0]))
        found["is_right"].append(bool(is_right[1]))
        found["distance_m"].append(float(np.linalg.norm(pair.T_target_source[:3, 3])))
    return found


def measure_overlap(
    model: dpm.Model,
    drives: Sequence[LidarSequence],
    num_pairs: int,
    seed: int,
    *,
    anchors: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> Row | None:
    """Matches pairs of which half are less than 20 m apart, each scan turned by a random yaw.

    Args:
        model: encoder and decoder.
        drives: drives with poses for all scans; pairs of two drives do not overlap.
        num_pairs: number of pairs.
        seed: seed of the pairs.
        anchors: scans of each drive of which one must be in each pair; None for all.

    Returns:
        The evidence and the label of each pair, and the probability of the head if it is trained; None if the drives
        have no pairs with overlap, or none without.
    """
    starts = np.cumsum([0, *(len(drive) for drive in drives)])
    poses = np.concatenate([np.asarray(drive.T_world_lidar) for drive in drives])
    table = dpm.ScanTable(poses, np.repeat(np.arange(len(drives)), np.diff(starts)))
    allowed = None if anchors is None else np.concatenate([rows + s for rows, s in zip(anchors, starts, strict=False)])
    if dpm.why_no_overlap(table) is not None or (allowed is not None and len(allowed) == 0):
        return None
    rng = np.random.default_rng([OVERLAP_STREAM, seed])
    pairs = dpm.draw_overlap_pairs(table, num_pairs, rng, anchors=allowed)
    rows, places = np.unique(pairs, return_inverse=True)
    clouds = []
    for number, drive in enumerate(drives):
        own = rows[table.scene[rows] == number] - starts[number]
        clouds += [cloud.described for cloud in dpm.encode_turned(model, drive, own, rng=rng)]
    sides = [[clouds[place] for place in side] for side in places.reshape(pairs.shape).T]
    apart_m = np.linalg.norm(np.diff(table.positions[pairs], axis=1)[:, 0], axis=1)
    is_one_drive = table.scene[pairs[:, 0]] == table.scene[pairs[:, 1]]
    found: Row = {
        "evidence": np.asarray(dpm.evidence_pairs(model, *sides), float).tolist(),
        "is_overlap": (is_one_drive & (apart_m < dpm.OVERLAP_M)).tolist(),
    }
    if "overlap" in model.config.trained:
        by_head = replace(model, config=replace(model.config, overlap=None))
        found["head"] = np.asarray(dpm.overlap_pairs(by_head, *sides), float).tolist()
    return found


class MeasuredDrives(NamedTuple):
    """Measured pairs of the drives of a user.

    Attributes:
        confidence: registrations of each drive, of places that are trained on.
        tested_confidence: those of held-out places.
        overlap: matches of the drives; None without pairs of both labels.
        tested_overlap: those of held-out places.
    """

    confidence: list[Row]
    tested_confidence: list[Row]
    overlap: Row | None
    tested_overlap: Row | None


def measure_drives(
    model: dpm.Model,
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
    splits = [dpm.split_places(drive) for drive in drives]
    of_training = [drive.take(split.training) for drive, split in zip(drives, splits, strict=True)]

    def numbers(num_pairs: int) -> int:
        return max(2, -(-num_pairs // (len(drives) * len(DRIVE_BANDS_M))))

    def measure(drive: LidarSequence, num: int, anchors: Int[np.ndarray, " a"] | None = None) -> Row:
        return measure_pairs(model, draw_calibration_pairs(drive, DRIVE_BANDS_M, num, seed, anchors=anchors), on_pair)

    num, num_tested = numbers(NUM_CONFIDENCE_PAIRS), numbers(NUM_TESTED_CONFIDENCE_PAIRS)
    held_out = [split.held_out for split in splits]
    return MeasuredDrives(
        [measure(drive, num) for drive in of_training],
        [measure(drive, num_tested, rows) for drive, rows in zip(drives, held_out, strict=True)],
        measure_overlap(model, of_training, NUM_OVERLAP_PAIRS, seed),
        measure_overlap(model, drives, NUM_TESTED_OVERLAP_PAIRS, seed + 1, anchors=held_out),
    )


def calibrate(model: dpm.Model, measured: MeasuredDrives) -> tuple[dpm.Model, Row]:
    """Fits the regressions of overlap and confidence on the drives of a user.

    Args:
        model: the model that was measured.
        measured: from `measure_drives`.

    Returns:
        The model with the regressions that the pairs could fix; and Brier scores and AUC of the held-out places.
    """
    calibration, numbers, _ = fit_confidence(measured.confidence, measured.tested_confidence)
    overlap = None
    if measured.overlap is not None:
        labels = np.asarray(measured.overlap["is_overlap"])
        features = np.asarray(measured.overlap["evidence"])
        overlap = dpm.fit_logistic(dpm.OVERLAP_FEATURES, features, labels)
        numbers["num_overlap_pairs"] = len(labels)
        if (tested := measured.tested_overlap) is not None:
            numbers |= overlap_numbers(overlap, tested)
    return replace(model, config=replace(model.config, calibration=calibration, overlap=overlap)), numbers


def overlap_numbers(fitted: dpm.LogisticModel, tested: Row) -> Row:
    """Computes the AUC and the Brier score of the regression, and of the head where it is trained.

    Args:
        fitted: the regression.
        tested: pairs from `measure_overlap`.

    Returns:
        The numbers.
    """
    labels = np.asarray(tested["is_overlap"])
    found = {"overlap": dpm.logistic_probability(fitted, np.asarray(tested["evidence"]))}
    if "head" in tested:
        found["head"] = np.asarray(tested["head"])
    numbers: Row = {"num_tested_overlap_pairs": len(labels)}
    for name, probability in found.items():
        numbers[f"auc_{name}"] = metrics.area_under_curve(probability, labels)
        numbers[f"brier_{name}"] = metrics.brier_score(probability, labels)
    return numbers


def fit_confidence(
    rows: Sequence[Row], tested: Sequence[Row] | None = None
) -> tuple[dpm.Calibration | None, Row, dict[str, HeldOut]]:
    """Fits the calibration of the confidence.

    Each regression is fitted on the pairs that it rates: scans on those whose walls hold all directions.

    Args:
        rows: measured pairs of each place.
        tested: pairs of other places, that the numbers are of; None takes each place by a fit without it.

    Returns:
        The calibration, its numbers, and the confidence and the labels of the tested pairs. No calibration if all
        registrations of scans or clouds are right, or all are wrong.
    """
    numbers: Row = {"num_pairs": sum(len(row["is_right"]) for row in rows)}
    models: dict[str, dpm.LogisticModel] = {}
    held_out: dict[str, HeldOut] = {}
    features_of = dpm.CLOUD_FEATURES, dpm.ELEMENT_FEATURES, dpm.SCAN_FEATURES, dpm.WEAK_FEATURES
    for kind, names in zip(KINDS, features_of, strict=True):
        examples = _examples(rows, kind, len(names))
        if len(np.unique(examples.is_right)) < 2:
            continue
        others = None if tested is None else _examples(tested, kind, len(names))
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
    return dpm.Calibration(**models) if is_whole else None, numbers, held_out


def _examples(rows: Sequence[Row], kind: str, num_features: int) -> Examples:
    pairs = [
        (
            place,
            row[kind][number],
            row["is_right_of_clouds" if kind in OF_CLOUDS else "is_right"][number],
            lookalike_gap(row, number, kind),
        )
        for place, row in enumerate(rows)
        for number, weak in enumerate(row["of_weak_scans"])
        if row[kind][number] is not None
        and (kind != "of_scans" or weak is None)
        and (kind == "of_elements" or not is_end(row, number))
    ]
    columns = zip(*pairs, strict=True) if pairs else ([], [], [], [])
    place, features, is_right, gaps = (np.asarray(column) for column in columns)
    shares = np.asarray(dpm.lookalike_share(gaps.astype(float)))
    return Examples(place.astype(int), features.astype(float).reshape(-1, num_features), is_right.astype(bool), shares)


def is_end(row: Row, number: int) -> bool:
    """Returns True for a pair without overlap in an ambiguous place, whose ends may look alike."""
    return "place" in row and bool(row["distance_m"][number] >= FAR_M)


def lookalike_gap(row: Row, number: int, kind: str) -> float:
    """Returns the lead of a pair over other places that look alike; files hold None for infinity."""
    gap = row["lookalike_gap_" + kind][number] if kind in HAVE_LOOKALIKES else None
    return np.inf if gap is None else float(gap)


def fit_overlap(rows: Sequence[Row]) -> tuple[dpm.LogisticModel, Row, HeldOut]:
    """Fits the regression of overlap.

    Args:
        rows: pairs of each place, from `measure_overlap`.

    Returns:
        The regression, its numbers, and the probability of the pairs of each place by a fit without it.
    """
    places = np.concatenate([np.full(len(row["is_overlap"]), number) for number, row in enumerate(rows)])
    features = np.concatenate([np.asarray(row["evidence"], float) for row in rows])
    is_overlap = np.concatenate([np.asarray(row["is_overlap"], bool) for row in rows])
    examples = Examples(places, features, is_overlap, np.ones(len(places)))
    fitted, found = fit_held_out(dpm.OVERLAP_FEATURES, examples)
    numbers: Row = {
        "num_overlap_pairs": len(places),
        "auc_overlap": metrics.area_under_curve(*found),
        "brier_overlap": metrics.brier_score(*found),
        "brier_of_a_constant_overlap": float(is_overlap.var()),
    }
    return fitted, numbers, found


def fit_held_out(
    names: tuple[str, ...], examples: Examples, tested: Examples | None = None
) -> tuple[dpm.LogisticModel, HeldOut]:
    """Fits a regression on all places, and predicts examples of places that their fit has not seen.

    Args:
        names: names of the features.
        examples: examples of the fit.
        tested: examples of other places; None takes each place by a fit on all others.

    Returns:
        The regression, and the probabilities and the labels of the tested examples.
    """
    place, features, labels, shares = examples
    fitted = dpm.fit_logistic(names, features, labels, shares)
    if tested is not None:
        return fitted, (tested.shares * dpm.logistic_probability(fitted, tested.features), tested.is_right)
    found = np.empty(len(place))
    for one in np.unique(place):
        part = place == one
        without = dpm.fit_logistic(names, features[~part], labels[~part], shares[~part])
        found[part] = shares[part] * dpm.logistic_probability(without, features[part])
    return fitted, (found, labels)
