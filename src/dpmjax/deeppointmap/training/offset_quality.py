"""Accuracy of predicted offsets: along the normal of the wall, along the wall, and up, in metres.

Along a wall nothing fixes an offset, because a wall looks the same further on. The three axes are measured apart,
because the height alone can make the loss small.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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


class OffsetQuality(NamedTuple):
    """Accuracy of predicted offsets along the normal of the wall, along the wall, and up.

    Attributes:
        r2: coefficient of determination: 1 less the mean squared residual over the variance of the true offsets; NaN
            along an axis without variance.
        rmse_m: root mean square residual, metres.
        spread_m: standard deviation of the true offsets, metres: the residual of the best constant.
        num_pairs: number of pairs of descriptors.
    """

    r2: Float[np.ndarray, " 3"]
    rmse_m: Float[np.ndarray, " 3"]
    spread_m: Float[np.ndarray, " 3"]
    num_pairs: int


def measure_offsets(parts: Sequence[WallOffsets]) -> OffsetQuality:
    """Measures predicted offsets, all parts together.

    Args:
        parts: offsets of any number of pairs of clouds.

    Returns:
        The quality; NaN without a pair.
    """
    pairs = [(np.asarray(part.predicted)[part.mask], np.asarray(part.true)[part.mask]) for part in parts]
    num_pairs = sum(len(true) for _, true in pairs)
    if num_pairs == 0:
        nothing = np.full(3, np.nan)
        return OffsetQuality(nothing, nothing, nothing, 0)
    predicted, true = (np.concatenate(some).astype(np.float64) for some in zip(*pairs, strict=True))
    squared, variance = np.mean((predicted - true) ** 2, axis=0), np.var(true, axis=0)
    r2 = 1 - np.divide(squared, variance, out=np.full(3, np.nan), where=variance > 0)
    return OffsetQuality(r2, np.sqrt(squared), np.sqrt(variance), num_pairs)


def offset_quality(
    model: Model,
    pairs: Iterable[tuple[DescriptorCloud, DescriptorCloud, Float[AnyArray, "4 4"]]],
    *,
    config: ObjectiveConfig = TRAINED,
) -> OffsetQuality:
    """Compares predicted offsets with the true ones, over all close descriptors of which the first lies on a wall.

    Args:
        model: encoder and decoder.
        pairs: source, target and true motion `T_target_source` of each pair of clouds.
        config: radius and number of close pairs, as in training.

    Returns:
        The quality; NaN where no two descriptors are close.
    """
    parts = [_wall_offsets(model, source, target, jnp.asarray(T), config) for source, target, T in pairs]
    return measure_offsets(jax.device_get(parts))


def wall_offsets(
    model: Model, source: DescriptorCloud, target: DescriptorCloud, T_target_source: Array, config: ObjectiveConfig
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


_wall_offsets = jax.jit(wall_offsets, static_argnames="config")


def _walls(cloud: DescriptorCloud) -> tuple[Float[Array, "m 2"], Bool[Array, " m"]]:
    """Returns the horizontal normals of the descriptors, and True where they lie on upright walls."""
    num_described = cloud.features.shape[0]
    elements: SurfaceElements = jax.tree.map(lambda leaf: leaf[:num_described], cloud.elements)
    is_upright = jnp.abs(elements.normals[:, 2]) <= MAX_NORMAL_HEIGHT
    return ray_directions(elements.normals), is_upright & (elements.planarity >= MIN_PLANARITY)
