"""The pairs of a town that the overlap probability is fitted on, and the fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dpmjax.deeppointmap import (
    NO_OVERLAP_M,
    OVERLAP_FEATURES,
    OVERLAP_M,
    LogisticModel,
    Model,
    draw_rows,
    encode_turned,
    evidence_pairs,
    fit_logistic,
    logistic_probability,
    scan_distances,
)
from dpmjax.io import LidarSequence
from dpmjax.metrics import area_under_curve, brier_score

# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
TOWN_STREAM = 4134


def measure_town(model: Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int) -> dict[str, Any]:
    """Returns evidence and distance of the pairs of a town.

    Half of the pairs are less than 20 m apart, a quarter 20 to 40 m, an eighth farther; an eighth has one scan of
    another town.

    Args:
        model: encoder and decoder.
        drives: drives through the town, and through a second one.
        num_pairs: number of pairs, about.
        seed: seed of the run.
    """
    rng = np.random.default_rng([TOWN_STREAM, seed])
    rows = [_spread(len(drive), num) for drive, num in zip(drives, (NUM_SCANS, NUM_OTHER_SCANS), strict=True)]
    own, other = (encode_turned(model, drive, some, rng=rng) for drive, some in zip(drives, rows, strict=True))
    distances = scan_distances(drives[0])[np.ix_(rows[0], rows[0])]
    kinds = (
        (distances < OVERLAP_M) & (distances > 0),
        (distances >= OVERLAP_M) & (distances < NO_OVERLAP_M),
        distances >= NO_OVERLAP_M,
    )
    drawn: list[tuple[Any, Any, float]] = []
    for kind, share in zip(kinds, (2, 4, 8), strict=True):
        for a, b in draw_rows(np.argwhere(kind), num_pairs // share, rng):
            drawn.append((own[a], own[b], float(distances[a, b])))
    for a, b in draw_rows(np.argwhere(np.ones((len(own), len(other)))), num_pairs // 8, rng):
        drawn.append((own[a], other[b], float("inf")))
    sources, targets, metres = zip(*drawn, strict=True)
    evidence = np.asarray(evidence_pairs(model, list(sources), list(targets)))
    return {"evidence": evidence.tolist(), "is_overlap": [distance < OVERLAP_M for distance in metres]}


def fit(rows: Sequence[dict[str, Any]]) -> tuple[LogisticModel, dict[str, Any], dict[str, np.ndarray]]:
    """Returns the model of overlap, its numbers, and the probability of the pairs of each town when it is left out."""
    towns = np.concatenate([np.full(len(row["is_overlap"]), row["overlap_town"]) for row in rows])
    features = np.concatenate([np.asarray(row["evidence"], float) for row in rows])
    is_overlap = np.concatenate([np.asarray(row["is_overlap"], bool) for row in rows])
    found = held_out_probability(OVERLAP_FEATURES, features, is_overlap, towns)
    numbers = {
        "num_overlap_pairs": len(towns),
        "auc_overlap": area_under_curve(found, is_overlap),
        "brier_overlap": brier_score(found, is_overlap),
        "brier_of_a_constant_overlap": float(is_overlap.var()),
    }
    fitted = fit_logistic(OVERLAP_FEATURES, features, is_overlap)
    return fitted, numbers, {"probability": found, "is_overlap": is_overlap}


def held_out_probability(
    names: tuple[str, ...], features: np.ndarray, labels: np.ndarray, towns: np.ndarray
) -> np.ndarray:
    """Returns the probability of each example by a fit on all towns but its own."""
    found = np.empty(len(towns))
    for town in np.unique(towns):
        part = towns == town
        found[part] = logistic_probability(fit_logistic(names, features[~part], labels[~part]), features[part])
    return found


def _spread(num: int, num_kept: int) -> np.ndarray:
    return np.unique(np.linspace(0, num - 1, num_kept).astype(int))
