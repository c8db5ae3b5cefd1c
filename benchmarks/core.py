"""The shared core beside the same computation in NumPy or SciPy: time, and the distance from a float64 result."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

import dpmjax
from benchmarks import Row, measure

TEMPERATURE = 0.1


class Case(NamedTuple):
    """One computation in both forms; both return what can be compared."""

    name: str
    ours: Callable[..., object]
    peer_name: str
    peer: Callable[..., object]
    arguments: tuple[np.ndarray, ...]


def run(quick: bool) -> list[Row]:
    """Times each case with both programs on the same arrays."""
    repeats = 5 if quick else 30
    rows: list[Row] = []
    for case in cases(quick):
        ours, peer = f"{case.name}: dpmjax", f"{case.name}: {case.peer_name}"
        rows += measure(case.ours, *case.arguments, repeats=repeats).rows(ours)
        rows += measure(case.peer, *case.arguments, repeats=repeats).rows(peer, is_compiled=False)
        rows.append(Row(ours, "largest difference", difference(case), ""))
    return rows


def cases(quick: bool) -> list[Case]:
    """Returns problems of the sizes that registration and training meet."""
    rng = np.random.default_rng(0)
    num_pairs, num_points, num_descriptors = (256, 1024, 256) if quick else (4096, 16384, 1024)
    source = rng.normal(size=(num_pairs, 3)).astype(np.float32)
    turned = Rotation.from_euler("z", 0.3).apply(source)
    target = (turned + [1.0, 2.0, 3.0] + 0.01 * rng.normal(size=source.shape)).astype(np.float32)
    weights = rng.uniform(size=num_pairs).astype(np.float32)
    queries, points = rng.uniform(0.0, 50.0, (2, num_points, 3)).astype(np.float32)
    scan_a, scan_b = rng.uniform(0.0, 500.0, (2, 256, 2)).astype(np.float32)
    descriptors, keys = rng.normal(size=(2, num_descriptors, 128)).astype(np.float32)
    positives = rng.permutation(num_descriptors).astype(np.int32)
    info_nce = partial(dpmjax.info_nce, temperature=TEMPERATURE)
    return [
        Case(f"weighted_svd {num_pairs}x3", dpmjax.weighted_svd, "SciPy", weighted_svd, (source, target, weights)),
        Case(f"k_nearest k=8 {num_points}x{num_points}", k_nearest, "SciPy tree", tree_nearest, (queries, points)),
        Case("chamfer 256x256", dpmjax.chamfer_distance, "SciPy tree", chamfer_distance, (scan_a, scan_b)),
        Case(f"info_nce {num_descriptors}x128", info_nce, "NumPy", numpy_info_nce, (descriptors, keys, positives)),
    ]


def difference(case: Case) -> float:
    """Returns the largest entry of the difference to the peer on the same numbers in float64."""
    exact = (array.astype(np.float64) if array.dtype == np.float32 else array for array in case.arguments)
    return float(np.max(np.abs(np.asarray(case.ours(*case.arguments)) - np.asarray(case.peer(*exact)))))


def k_nearest(queries: np.ndarray, points: np.ndarray) -> object:
    """Returns the squared distances of the eight nearest points."""
    return dpmjax.k_nearest(queries, points, 8).squared_distances


def tree_nearest(queries: np.ndarray, points: np.ndarray) -> object:
    """Returns the same by a tree, built anew for each call, as a moving scan needs it."""
    return KDTree(points).query(queries, 8)[0] ** 2


def weighted_svd(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> object:
    """Returns T_target_source by SciPy's alignment of vectors."""
    source_centre, target_centre = (np.average(points, axis=0, weights=weights) for points in (source, target))
    turn, _ = Rotation.align_vectors(target - target_centre, source - source_centre, weights)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), target_centre - turn.apply(source_centre)
    return T


def chamfer_distance(a: np.ndarray, b: np.ndarray) -> object:
    """Returns the mean distance from a to b plus from b to a, with a tree for each."""
    return np.mean(KDTree(b).query(a)[0]) + np.mean(KDTree(a).query(b)[0])


def numpy_info_nce(queries: np.ndarray, keys: np.ndarray, positives: np.ndarray) -> object:
    """Returns InfoNCE of cosine similarities."""
    queries = queries / np.linalg.norm(queries, axis=1, keepdims=True)
    keys = keys / np.linalg.norm(keys, axis=1, keepdims=True)
    logits = queries @ keys.T / TEMPERATURE
    return np.mean(logsumexp(logits, axis=1) - logits[np.arange(len(queries)), positives])
