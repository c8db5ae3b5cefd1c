"""The offset loss: how far predicted offsets are from the true ones, in units of their own spread."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_mask, as_points, require_shape
from dpmjax.types import AnyArray

SINGULAR_IN_EPS = 8
"""A covariance whose determinant is so many epsilons of that of a ball of the same size counts as not invertible."""

ROUNDING_IN_EPS = 64
"""A spread of residuals that is so many epsilons of their length is rounding: they are all the same."""


def offset_loss(
    predicted: Float[AnyArray, "n d"], true: Float[AnyArray, "n d"], mask: Bool[AnyArray, " n"] | None = None
) -> Float[Array, ""]:
    """Mean Mahalanobis distance between predicted and true offsets (DeepPointMap eq. 6).

    The covariance is that of the residuals themselves, with n - 1 in the denominator, and is held constant for the
    derivative: so the loss asks for residuals that are small against the others, and the scale of the gradient does not
    shrink with them. Where it cannot be inverted (too few residuals, or all of them in one plane) it is the identity,
    and the loss is the mean distance.

    The mean is over all pairs, as in the published configuration, not first over those of each descriptor as in eq. 6.

    Args:
        predicted: offsets (n, d), metres.
        true: the same.
        mask: False for pairs that are not there; they may hold anything.

    Returns:
        The loss; 0, with zero gradient, without any pair. At a residual of zero the derivative is taken as 0.

    Raises:
        ValueError: the shapes do not match.
    """
    predicted, true = as_points("predicted", predicted), as_float("true", true)
    require_shape("true", true, predicted.shape)
    return _offset_loss(predicted, true, as_mask("mask", mask, predicted.shape[:1]))


@jax.jit
def _offset_loss(predicted: jax.Array, true: jax.Array, mask: jax.Array) -> jax.Array:
    residuals = jnp.where(mask[:, None], predicted, 0) - jnp.where(mask[:, None], true, 0)
    inverse = _inverse_covariance(lax.stop_gradient(residuals), mask)
    # Differences of products, summed over the last axis: a short contraction in full precision everywhere.
    squared = jnp.sum(residuals * jnp.matmul(residuals, inverse, precision=lax.Precision.HIGHEST), axis=1)
    is_apart = mask & (squared > 0)
    distances = jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, squared, 1)), 0)
    return jnp.sum(distances) / jnp.maximum(jnp.sum(mask), 1)


def _inverse_covariance(residuals: Float[Array, "n d"], mask: Bool[Array, " n"]) -> Float[Array, "d d"]:
    dim = residuals.shape[1]
    count = jnp.sum(mask)
    mean = jnp.sum(residuals, axis=0) / jnp.maximum(count, 1)
    centred = jnp.where(mask[:, None], residuals - mean, 0)
    covariance = jnp.matmul(centred.T, centred, precision=lax.Precision.HIGHEST) / jnp.maximum(count - 1, 1)
    scale = jnp.trace(covariance) / dim
    scaled = covariance / jnp.where(scale > 0, scale, 1)
    eps = jnp.finfo(residuals.dtype).eps
    longest_squared = jnp.max(jnp.sum(jnp.where(mask[:, None], residuals, 0) ** 2, axis=1), initial=0)
    is_same = scale <= (ROUNDING_IN_EPS * eps) ** 2 * longest_squared
    is_singular = (count < 2) | is_same | (jnp.linalg.det(scaled) <= SINGULAR_IN_EPS * eps)
    identity = jnp.eye(dim, dtype=residuals.dtype)
    return jnp.linalg.inv(jnp.where(is_singular, identity, scaled)) / jnp.where(is_singular, 1, scale)
