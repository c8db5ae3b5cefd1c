"""Accuracy of predicted offsets: along the normal of the wall, along the wall, and up, in metres.

Along a wall nothing fixes an offset, because a wall looks the same further on. The three axes are measured apart,
because the height alone can make the loss small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from dpmjax.deeppointmap.model import Model, correlate, predict_offsets
from dpmjax.deeppointmap.training.objective import ObjectiveConfig, training_pairs
from dpmjax.geometry.bearing import directions_of, ray_directions, to_ray_frame
from dpmjax.types import AnyArray, DescriptorCloud, SurfaceElements

TRAINED = ObjectiveConfig()

# Normals at most 30 degrees from the horizontal belong to walls.
MAX_NORMAL_HEIGHT = 0.5

# Planarity of walls. Below, normals of vegetation and of edges count too; above, few walls are left in sparse scans.
MIN_PLANARITY = 0.3


class WallOffsets(NamedTuple):
    """Predicted and true offsets of pairs of descriptors, in the frame of the wall of the first descriptor.

    Attributes:
        predicted: along the horizontal normal, along the wall, and up, metres.
        true: the same of the true offsets.
        mask: True for pairs within the radius whose first descriptor lies on an upright wall; others hold anything.
    """

    predicted: Float[AnyArray, "*p 3"]
    true: Float[AnyArray, "*p 3"]
    mask: Bool[AnyArray, "*p"]


def offset_r2(parts: Sequence[WallOffsets]) -> Float[np.ndarray, " 3"]:
    """Computes the coefficients of determination of predicted offsets, all parts together.

    Args:
        parts: offsets of any number of pairs of clouds.

    Returns:
        1 less the mean squared residual over the variance of the true offsets, along the normal of the wall, along the
        wall, and up. NaN along an axis without variance, and without a pair.
    """
    pairs = [(np.asarray(part.predicted)[part.mask], np.asarray(part.true)[part.mask]) for part in parts]
    if not sum(len(true) for _, true in pairs):
        return np.full(3, np.nan)
    predicted, true = (np.concatenate(some).astype(np.float64) for some in zip(*pairs, strict=True))
    squared, variance = np.mean((predicted - true) ** 2, axis=0), np.var(true, axis=0)
    return np.asarray(1 - np.divide(squared, variance, out=np.full(3, np.nan), where=variance > 0))


def wall_offsets(
    model: Model,
    source: DescriptorCloud,
    target: DescriptorCloud,
    T_target_source: Array,
    config: ObjectiveConfig = TRAINED,
) -> WallOffsets:
    """Predicts the offsets of all close descriptors of which the first lies on an upright wall.

    Args:
        model: encoder and decoder.
        source: uncorrelated descriptors of a scan or a map, with normals.
        target: the same.
        T_target_source: the true motion, metres.
        config: radius and number of close pairs.

    Returns:
        Offsets (m, k, 3) from the descriptors of the source.

    Raises:
        ValueError: if the source has no normals.
    """
    normals, is_wall = _walls(source)
    source, target = source.described, target.described
    correlated, others = correlate(model, source, target)
    close, _ = training_pairs(source, target, T_target_source, config=config)
    directions = directions_of(source)[:, None]
    offsets = predict_offsets(model, correlated.features[:, None], others.features, directions, close.indices)
    predicted, true = (to_ray_frame(values, normals[:, None]) for values in (offsets, close.offsets))
    return WallOffsets(predicted, true, close.mask & is_wall[:, None])


def _walls(cloud: DescriptorCloud) -> tuple[Float[Array, "m 2"], Bool[Array, " m"]]:
    """Returns the horizontal normals of the descriptors, and True where they lie on upright walls."""
    num_described = cloud.features.shape[0]
    elements: SurfaceElements = jax.tree.map(lambda leaf: leaf[:num_described], cloud.elements)
    is_upright = jnp.abs(elements.normals[:, 2]) <= MAX_NORMAL_HEIGHT
    return ray_directions(elements.normals), is_upright & (elements.planarity >= MIN_PLANARITY)
