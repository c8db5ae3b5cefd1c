"""Pairs that confidence and overlap are fitted and checked on: ambiguous places, and towns; and the fit of overlap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dpmjax import deeppointmap as dpm
from dpmjax import encode, register
from dpmjax.io import LidarSequence
from dpmjax.metrics import area_under_curve, brier_score, registration_recall
from dpmjax.simulation import HDL32E, OS1_64, VLP16, SceneMixture, draw_scene, simulate_scene

AMBIGUOUS = ("corridor", "tunnel", "jam", "hall", "field")
LIDARS = (VLP16, HDL32E, OS1_64)
BEAMS = {len(lidar.elevations_deg): lidar for lidar in LIDARS}
KINDS = ("of_clouds", "of_scans", "of_weak_scans")
# Elements of a scan in the map of SLAM, and in `register(..., refine=True)` with a cloud.
NUM_ELEMENTS = 1024
PAIR_STREAM = 4141
# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
TOWN_STREAM = 4134


def ambiguous_case(number: int, first_seed: int) -> dict[str, Any]:
    """Returns the case of one of the ambiguous places: kinds of place take turns, then lidars do."""
    beams = list(BEAMS)[number // len(AMBIGUOUS) % len(BEAMS)]
    return {"place": first_seed + number, "kind": AMBIGUOUS[number % len(AMBIGUOUS)], "beams": beams}


def ambiguous_drive(place: int, kind: str, beams: int, length_m: float) -> LidarSequence:
    """Simulates an ambiguous place in its true size."""
    mixture = SceneMixture(
        kinds=((kind, 1.0),), sensors=((BEAMS[beams], 1.0),), indoor_scale=(1.0, 1.0), length_m=length_m
    )
    return simulate_scene(draw_scene(place, mixture))


def measure_pairs(
    model: dpm.Model,
    drive: LidarSequence,
    bands_m: tuple[tuple[float, float], ...],
    num_pairs: int,
    *,
    seed: int,
    on_pair: Callable[[], object],
) -> dict[str, Any]:
    """Registers random pairs as scans, and as clouds of surface elements.

    Args:
        model: encoder and decoder.
        drive: scans with true poses.
        bands_m: smallest and largest distance of the pairs.
        num_pairs: number of pairs of each distance, fewer where the drive has fewer.
        seed: of the draws.
        on_pair: called after each pair.

    Returns:
        Lists with an entry for each pair: the evidence of each kind, whether both registrations are right, and the
        true distance, metres.
    """
    names = (*KINDS, "is_right_of_clouds", "is_right", "distance_m")
    found: dict[str, list[Any]] = {name: [] for name in names}
    distances = dpm.scan_distances(drive)
    num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)
    for number, (low, high) in enumerate(bands_m):
        drawn = dpm.draw_rows_apart(distances, low, high, num_pairs, np.random.default_rng([PAIR_STREAM, number, seed]))
        for pair in dpm.read_scan_pairs(drive, drawn, seed=seed):
            result = dpm.register_in_stages(model, pair)
            clouds = [encode(model, points, num_elements=num_elements) for points in (pair.source, pair.target)]
            of_clouds = np.asarray(register(model, *clouds, refine=True).T_target_source, np.float64)
            motions = np.stack([of_clouds, result.verified])
            is_right = registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
            for name, features in result.evidence._asdict().items():
                found[name].append(None if features is None else features.tolist())
            found["is_right_of_clouds"].append(bool(is_right[0]))
            found["is_right"].append(bool(is_right[1]))
            found["distance_m"].append(float(np.linalg.norm(pair.T_target_source[:3, 3])))
            on_pair()
    return found


def measure_town(model: dpm.Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int) -> dict[str, Any]:
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
    own, other = (dpm.encode_turned(model, drive, some, rng=rng) for drive, some in zip(drives, rows, strict=True))
    distances = dpm.scan_distances(drives[0])[np.ix_(rows[0], rows[0])]
    kinds = (
        (distances < dpm.OVERLAP_M) & (distances > 0),
        (distances >= dpm.OVERLAP_M) & (distances < dpm.NO_OVERLAP_M),
        distances >= dpm.NO_OVERLAP_M,
    )
    drawn: list[tuple[Any, Any, float]] = []
    for kind, share in zip(kinds, (2, 4, 8), strict=True):
        for a, b in dpm.draw_rows(np.argwhere(kind), num_pairs // share, rng):
            drawn.append((own[a], own[b], float(distances[a, b])))
    for a, b in dpm.draw_rows(np.argwhere(np.ones((len(own), len(other)))), num_pairs // 8, rng):
        drawn.append((own[a], other[b], float("inf")))
    sources, targets, metres = zip(*drawn, strict=True)
    evidence = np.asarray(dpm.evidence_pairs(model, list(sources), list(targets)))
    return {"evidence": evidence.tolist(), "is_overlap": [distance < dpm.OVERLAP_M for distance in metres]}


def fit_overlap(rows: Sequence[dict[str, Any]]) -> tuple[dpm.LogisticModel, dict[str, Any], dict[str, np.ndarray]]:
    """Returns the model of overlap, its numbers, and the probability of the pairs of each town when it is left out."""
    towns = np.concatenate([np.full(len(row["is_overlap"]), row["overlap_town"]) for row in rows])
    features = np.concatenate([np.asarray(row["evidence"], float) for row in rows])
    is_overlap = np.concatenate([np.asarray(row["is_overlap"], bool) for row in rows])
    found = held_out_probability(dpm.OVERLAP_FEATURES, features, is_overlap, towns)
    numbers = {
        "num_overlap_pairs": len(towns),
        "auc_overlap": area_under_curve(found, is_overlap),
        "brier_overlap": brier_score(found, is_overlap),
        "brier_of_a_constant_overlap": float(is_overlap.var()),
    }
    fitted = dpm.fit_logistic(dpm.OVERLAP_FEATURES, features, is_overlap)
    return fitted, numbers, {"probability": found, "is_overlap": is_overlap}


def held_out_probability(
    names: tuple[str, ...], features: np.ndarray, labels: np.ndarray, towns: np.ndarray
) -> np.ndarray:
    """Returns the probability of each example by a fit on all towns but its own."""
    found = np.empty(len(towns))
    for town in np.unique(towns):
        part = towns == town
        found[part] = dpm.logistic_probability(dpm.fit_logistic(names, features[~part], labels[~part]), features[part])
    return found


def _spread(num: int, num_kept: int) -> np.ndarray:
    return np.unique(np.linspace(0, num - 1, num_kept).astype(int))
