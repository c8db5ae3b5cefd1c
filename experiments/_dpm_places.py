"""Registrations that the confidence is fitted and checked on: places where it is easy to be wrong, and their pairs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dpmjax import encode, register
from dpmjax.cli import RowStopped
from dpmjax.deeppointmap import Model, draw_rows_apart, read_scan_pairs, register_in_stages, scan_distances
from dpmjax.io import LidarSequence
from dpmjax.metrics import registration_recall
from dpmjax.simulation import HDL32E, OS1_64, VLP16, SceneMixture, draw_scene, simulate_scene

AMBIGUOUS = ("corridor", "tunnel", "jam", "hall", "field")
LIDARS = (VLP16, HDL32E, OS1_64)
BEAMS = {len(lidar.elevations_deg): lidar for lidar in LIDARS}
KINDS = ("of_clouds", "of_scans", "of_weak_scans")
# Elements of a scan in the map of SLAM, and in `register(..., refine=True)` with a cloud.
NUM_ELEMENTS = 1024
PAIR_STREAM = 4141


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
    model: Model,
    drive: LidarSequence,
    bands_m: tuple[tuple[float, float], ...],
    num_pairs: int,
    *,
    seed: int,
    is_stopped: Callable[[], bool],
) -> dict[str, Any]:
    """Registers random pairs as scans, and as clouds of surface elements.

    Args:
        model: encoder and decoder.
        drive: scans with true poses.
        bands_m: smallest and largest distance of the pairs.
        num_pairs: number of pairs of each distance, fewer where the drive has fewer.
        seed: of the draws.
        is_stopped: whether to leave the row out, by `RowStopped`.

    Returns:
        Lists with an entry for each pair: the evidence of each kind, whether both registrations are right, and the
        true distance, metres.
    """
    names = (*KINDS, "is_right_of_clouds", "is_right", "distance_m")
    found: dict[str, list[Any]] = {name: [] for name in names}
    distances = scan_distances(drive)
    num_elements = min(NUM_ELEMENTS, model.config.pyramid.stages[0].num_points)
    for number, (low, high) in enumerate(bands_m):
        drawn = draw_rows_apart(distances, low, high, num_pairs, np.random.default_rng([PAIR_STREAM, number, seed]))
        for pair in read_scan_pairs(drive, drawn, seed=seed):
            result = register_in_stages(model, pair)
            clouds = [encode(model, points, num_elements=num_elements) for points in (pair.source, pair.target)]
            of_clouds = np.asarray(register(model, *clouds, refine=True).T_target_source, np.float64)
            motions = np.stack([of_clouds, result.verified])
            is_right = registration_recall(motions, np.stack([pair.T_target_source] * 2)).is_right
            for name, features in result.evidence._asdict().items():
                found[name].append(None if features is None else features.tolist())
            found["is_right_of_clouds"].append(bool(is_right[0]))
            found["is_right"].append(bool(is_right[1]))
            found["distance_m"].append(float(np.linalg.norm(pair.T_target_source[:3, 3])))
            if is_stopped():
                raise RowStopped
    return found
