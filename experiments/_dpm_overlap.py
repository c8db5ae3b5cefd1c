"""Overlap of scans: the pairs that its probability is fitted on, and its AUC on the pairs of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from dpmjax import encode, overlap_pairs
from dpmjax.deeppointmap import Model
from dpmjax.deeppointmap.batches import evidence_pairs
from dpmjax.deeppointmap.confidence import OVERLAP_FEATURES, LogisticModel, fit_logistic, probability
from dpmjax.deeppointmap.overlap_prediction import OVERLAP_M
from dpmjax.geometry import se2
from dpmjax.io import LidarSequence
from dpmjax.types import DescriptorCloud

# Scans between OVERLAP_M and this apart may see the same place: the AUC leaves them out, the fit does not.
NO_OVERLAP_M = 40.0
# Scans seen again after so many metres of driving are revisits.
REVISIT_PATH_M = 100.0
# Scans of each town, and of another town beside, that pairs are made of.
NUM_SCANS, NUM_OTHER_SCANS = 36, 12
REVISIT_STREAM, TOWN_STREAM = 4133, 4134


def measure_town(model: Model, drives: Sequence[LidarSequence], num_pairs: int, seed: int, bar: tqdm) -> dict[str, Any]:
    """Returns evidence and distance of the pairs of a town.

    Half of the pairs are less than 20 m apart, a quarter is 20 to 40 m apart, an eighth is farther, and an eighth has
    one scan of another town.

    Args:
        model: encoder and decoder.
        drives: through the town, and through the other one.
        num_pairs: number of pairs, about.
        seed: of the run.
        bar: gets the pairs.
    """
    rng = np.random.default_rng([TOWN_STREAM, seed])
    rows = [_spread(len(drive), num) for drive, num in zip(drives, (NUM_SCANS, NUM_OTHER_SCANS), strict=True)]
    own, other = (_turned_clouds(model, drive, some, rng) for drive, some in zip(drives, rows, strict=True))
    distances = _distances(drives[0])[np.ix_(rows[0], rows[0])]
    kinds = (
        (distances < OVERLAP_M) & (distances > 0),
        (distances >= OVERLAP_M) & (distances < NO_OVERLAP_M),
        distances >= NO_OVERLAP_M,
    )
    sources, targets, metres = [], [], []
    for kind, share in zip(kinds, (2, 4, 8), strict=True):
        for a, b in _draw(np.argwhere(kind), num_pairs // share, rng):
            sources.append(own[a])
            targets.append(own[b])
            metres.append(float(distances[a, b]))
    for a, b in _draw(np.argwhere(np.ones((len(own), len(other)))), num_pairs // 8, rng):
        sources.append(own[a])
        targets.append(other[b])
        metres.append(float("inf"))
    evidence = np.asarray(evidence_pairs(model, sources, targets))
    bar.update(len(sources))
    return {"evidence": evidence.tolist(), "is_overlap": [distance < OVERLAP_M for distance in metres]}


def fit(rows: Sequence[dict[str, Any]]) -> tuple[LogisticModel, dict[str, Any], dict[str, np.ndarray]]:
    """Returns the model of overlap, its numbers, and the probability of the pairs of each town when it is left out."""
    towns = np.concatenate([np.full(len(row["is_overlap"]), row["overlap_town"]) for row in rows])
    features = np.concatenate([np.asarray(row["evidence"], float) for row in rows])
    is_overlap = np.concatenate([np.asarray(row["is_overlap"], bool) for row in rows])
    found = held_out_probability(OVERLAP_FEATURES, features, is_overlap, towns)
    numbers = {
        "num_overlap_pairs": len(towns),
        "auc_overlap": _area_under_curve(found, is_overlap),
        "brier_overlap": float(np.mean((found - is_overlap) ** 2)),
        "brier_of_a_constant_overlap": float(np.mean((is_overlap.mean() - is_overlap) ** 2)),
    }
    fitted = fit_logistic(OVERLAP_FEATURES, features, is_overlap)
    return fitted, numbers, {"probability": found, "is_overlap": is_overlap}


def held_out_probability(
    names: tuple[str, ...], features: np.ndarray, labels: np.ndarray, towns: np.ndarray
) -> np.ndarray:
    """Returns the probability of each example by a fit on the other towns."""
    found = np.empty(len(towns))
    for town in np.unique(towns):
        part = towns == town
        found[part] = probability(fit_logistic(names, features[~part], labels[~part]), features[part])
    return found


def evaluate_overlap(model: Model, drive: LidarSequence, num_pairs: int, seed: int, bar: tqdm) -> dict[str, Any]:
    """Returns the AUC of the overlap probability: pairs nearer than 20 m against pairs farther than 40 m.

    Where the drive comes back to places, the near pairs are revisits. Each scan is turned by a random yaw.
    """
    assert drive.T_world_lidar is not None
    distances = _distances(drive)
    steps = np.linalg.norm(np.diff(drive.T_world_lidar[:, :3, 3], axis=0), axis=1)
    path = np.concatenate([[0], np.cumsum(steps)])
    is_near = (distances < OVERLAP_M) & (distances > 0)
    is_revisit = is_near & (np.abs(path[:, None] - path[None]) > REVISIT_PATH_M)
    has_revisits = bool(is_revisit.any())
    classes = [np.argwhere(is_revisit if has_revisits else is_near), np.argwhere(distances > NO_OVERLAP_M)]
    if min(map(len, classes)) == 0:
        return {"auc": None, "has_revisits": has_revisits, "num_pairs": 0}
    rng = np.random.default_rng([REVISIT_STREAM, seed])
    chosen = [_draw(pairs, num_pairs, rng) for pairs in classes]
    pairs = np.concatenate(chosen)
    rows, places = np.unique(pairs, return_inverse=True)
    clouds = _turned_clouds(model, drive, rows, rng)
    sides = ([clouds[place] for place in side] for side in places.reshape(pairs.shape).T)
    found = np.asarray(overlap_pairs(model, *sides), float)
    bar.update(len(pairs))
    is_overlap = np.arange(len(pairs)) < len(chosen[0])
    return {
        "auc": _area_under_curve(found, is_overlap),
        "brier": float(np.mean((found - is_overlap) ** 2)),
        "has_revisits": has_revisits,
        "num_pairs": len(pairs),
        "probability": found.tolist(),
        "is_overlap": is_overlap.tolist(),
    }


def _turned_clouds(
    model: Model, drive: LidarSequence, rows: np.ndarray, rng: np.random.Generator
) -> list[DescriptorCloud]:
    """Returns the descriptors of scans, each turned by a random yaw."""
    turns = se2.rotation(rng.uniform(-np.pi, np.pi, len(rows)))
    clouds = []
    for row, turn in zip(rows, np.asarray(turns), strict=True):
        points = drive.read_scan(int(row)).astype(np.float32)
        points[:, :2] = points[:, :2] @ turn.T
        clouds.append(jax.device_get(encode(model, points)))
    return clouds


def _distances(drive: LidarSequence) -> np.ndarray:
    assert drive.T_world_lidar is not None
    positions = drive.T_world_lidar[:, :3, 3]
    return np.linalg.norm(positions[:, None] - positions[None], axis=2)


def _spread(num: int, num_kept: int) -> np.ndarray:
    return np.unique(np.linspace(0, num - 1, num_kept).astype(int))


def _draw(pairs: np.ndarray, num: int, rng: np.random.Generator) -> np.ndarray:
    return pairs[rng.choice(len(pairs), min(num, len(pairs)), replace=False)] if len(pairs) else pairs


def _area_under_curve(score: np.ndarray, is_overlap: np.ndarray) -> float:
    """Returns how often an overlapping pair has a higher score than another one; ties count half."""
    near, far = score[is_overlap], score[~is_overlap]
    return float(((near[:, None] > far) + 0.5 * (near[:, None] == far)).mean())
