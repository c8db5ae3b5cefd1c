"""Retrieval: keyframes that look alike, by one vector each and one matrix product. It needs no position."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.types import DescriptorCloud


def pooled_vector(cloud: DescriptorCloud) -> Float[np.ndarray, " d"]:
    """Pools the descriptors of a scan into one unit vector: their mean and their deviation in each channel.

    Neither depends on the order of the descriptors. With features in frames that turn with the scan, neither changes
    where the scan turns about the vertical.

    Args:
        cloud: descriptors of a scan.

    Returns:
        (2 c,) float32; zero for an empty cloud.
    """
    features = np.asarray(cloud.features, np.float32)[np.asarray(cloud.mask)]
    if len(features) == 0:
        return np.zeros(2 * cloud.features.shape[-1], np.float32)
    features = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    pooled = np.concatenate([features.mean(axis=0), features.std(axis=0)])
    return np.asarray(pooled / max(float(np.linalg.norm(pooled)), 1e-12), np.float32)


def most_similar(
    vectors: Float[np.ndarray, "k d"],
    query: Float[np.ndarray, " d"],
    count: int,
    *,
    is_allowed: Bool[np.ndarray, " k"] | None = None,
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Finds the vectors with the largest cosine.

    The mean of many vectors says nothing about a place, so it is subtracted first.

    Args:
        vectors: unit vectors.
        query: any length of vector.
        count: largest number of vectors.
        is_allowed: False for vectors that are no candidates.

    Returns:
        Rows, most similar first, and their cosines.
    """
    if len(vectors) == 0 or count == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.float32)
    mean = vectors.mean(axis=0) if len(vectors) >= MIN_NUM_CENTRED else np.zeros_like(query)
    centred = query - mean
    # |v - m|^2 = 1 - 2 v.m + m.m for unit vectors: no centred copy of the whole map.
    lengths = np.sqrt(np.maximum(1 - 2 * (vectors @ mean) + mean @ mean, 1e-12)) * max(np.linalg.norm(centred), 1e-6)
    cosines = (vectors @ centred - mean @ centred) / lengths
    if is_allowed is not None:
        cosines = np.where(is_allowed, cosines, -np.inf)
    count = min(count, len(cosines))
    rows = np.argpartition(-cosines, count - 1)[:count]
    rows = rows[np.argsort(-cosines[rows], kind="stable")]
    rows = rows[np.isfinite(cosines[rows])]
    return rows, cosines[rows].astype(np.float32)


MIN_NUM_CENTRED = 20
"""The mean of fewer vectors is no background."""
