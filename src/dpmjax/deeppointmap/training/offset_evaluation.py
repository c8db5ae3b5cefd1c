"""Evaluation of the offset head in metres, axis by axis."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.model import Model, correlate, predict_offsets
from dpmjax.deeppointmap.training.objective import ObjectiveConfig, training_pairs
from dpmjax.geometry.bearing import directions_of
from dpmjax.types import AnyArray, DescriptorCloud

TRAINED = ObjectiveConfig()


class OffsetQuality(NamedTuple):
    """Accuracy of predicted offsets along x, y and z of the lidar.

    Attributes:
        r2: coefficient of determination: 1 less the mean squared residual over the variance of the true offsets.
        rmse_m: root mean square residual, metres.
        spread_m: standard deviation of the true offsets, metres: the residual without any prediction.
        num_pairs: number of pairs of descriptors.
    """

    r2: Float[np.ndarray, " 3"]
    rmse_m: Float[np.ndarray, " 3"]
    spread_m: Float[np.ndarray, " 3"]
    num_pairs: int


def offset_quality(
    model: Model,
    pairs: Iterable[tuple[DescriptorCloud, DescriptorCloud, Float[AnyArray, "4 4"]]],
    *,
    config: ObjectiveConfig = TRAINED,
) -> OffsetQuality:
    """Compares predicted offsets with the true ones, over all pairs of descriptors that are close.

    The offset loss (DeepPointMap eq. 6) whitens the residuals, so that it cannot show whether an axis is predicted.

    Args:
        model: encoder and decoder.
        pairs: source, target and true motion `T_target_source` of each pair of clouds.
        config: radius and number of close pairs, as in training.

    Returns:
        The quality; NaN where no two descriptors are close, and `r2` along an axis without spread.
    """
    found = [_offsets(model, source, target, jnp.asarray(T), config) for source, target, T in pairs]
    if sum(len(true) for _, true in found) == 0:
        nothing = np.full(3, np.nan)
        return OffsetQuality(nothing, nothing, nothing, 0)
    predicted, true = (np.concatenate(parts).astype(np.float64) for parts in zip(*found, strict=True))
    squared, variance = np.mean((predicted - true) ** 2, axis=0), np.var(true, axis=0)
    r2 = 1 - np.divide(squared, variance, out=np.full(3, np.nan), where=variance > 0)
    return OffsetQuality(r2, np.sqrt(squared), np.sqrt(variance), len(true))


def _offsets(
    model: Model, source: DescriptorCloud, target: DescriptorCloud, T: jax.Array, config: ObjectiveConfig
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Returns predicted and true offsets of the close pairs, in the frame of the source."""
    source, target = correlate(model, source, target)
    close, _ = training_pairs(source, target, T, config=config)
    directions = directions_of(source)[:, None]
    predicted = predict_offsets(model, source.features[:, None], target.features, directions, close.indices)
    mask = np.asarray(close.mask)
    return np.asarray(predicted)[mask], np.asarray(close.offsets)[mask]
