"""Losses of DeepPointMap on descriptors: their contrast and their offsets.

Each query should look like its positive key and like no other; predicted offsets are measured in units of their own
spread.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_positive, require_shape
from dpmjax.geometry.rigid import safe_sqrt
from dpmjax.geometry.traced import typed_jit
from dpmjax.types import AnyArray

# Largest determinant of a covariance that is not invertible, in epsilons of that of a ball of the same size.
SINGULAR_IN_EPS = 8

# Largest spread of equal residuals by rounding, in epsilons of their length.
ROUNDING_IN_EPS = 64


def info_nce(
    queries: Float[AnyArray, "m c"],
    keys: Float[AnyArray, "n c"],
    positives: Int[AnyArray, " m"],
    temperature: float | Float[AnyArray, ""] = 0.1,
    ignore: Bool[AnyArray, "m n"] | None = None,
    mask: Bool[AnyArray, " m"] | None = None,
) -> Float[Array, ""]:
    """Computes InfoNCE with cosine similarities, the mean over all queries that have a positive key.

    For query i with positive p it is -log( exp(cos(q_i, k_p) / t) / sum_j exp(cos(q_i, k_j) / t) ). The sum runs over
    all keys that are not ignored (van den Oord et al. 2018; DeepPointMap's pairing loss).

    Args:
        queries: descriptors of any norm; only their direction counts. A zero vector is similar to nothing (0).
        keys: the same.
        positives: row of each query's positive key; outside [0, n), -1 by custom, the query is not counted.
        temperature: t, above 0.
        ignore: True for pairs that are left out of the sum, neither positive nor negative. The positive itself always
            stays in.
        mask: False for queries that are not counted. Keys that are not there are set in `ignore`.

    Returns:
        The loss; 0, with zero gradient, when no query counts. Gradients are finite, at zero vectors too.

    Raises:
        ValueError: the shapes do not match, or `temperature` is not above 0.
    """
    queries, keys = as_points("queries", queries), as_points("keys", keys)
    positives = jnp.asarray(positives)
    num_queries, num_keys = queries.shape[0], keys.shape[0]
    require_shape("keys", keys, (num_keys, queries.shape[1]))
    require_shape("positives", positives, (num_queries,))
    if not jnp.issubdtype(positives.dtype, jnp.integer):
        raise ValueError(f"positives: expected integers, got dtype {positives.dtype}")
    require_positive("temperature", temperature)
    ignore = jnp.zeros((num_queries, num_keys), bool) if ignore is None else ignore
    ignore = as_mask("ignore", ignore, (num_queries, num_keys))
    mask = as_mask("mask", mask, (num_queries,))
    return _info_nce(queries, keys, positives, as_float("temperature", jnp.asarray(temperature)), ignore, mask)


@jax.jit
def _info_nce(
    queries: jax.Array,
    keys: jax.Array,
    positives: jax.Array,
    temperature: jax.Array,
    ignore: jax.Array,
    mask: jax.Array,
) -> jax.Array:
    num_keys = keys.shape[0]
    if num_keys == 0:
        return jnp.zeros((), queries.dtype)
    is_counted = mask & (positives >= 0) & (positives < num_keys)
    positives = jnp.where(is_counted, positives, 0)
    # Rows that do not count may hold anything; cleared here, they cannot reach a gradient.
    queries = jnp.where(is_counted[:, None], queries, 0)
    is_positive = positives[:, None] == jnp.arange(num_keys)
    is_left_out = ignore & ~is_positive & is_counted[:, None]
    is_key_used = jnp.any(is_counted[:, None] & ~is_left_out, axis=0)
    keys = jnp.where(is_key_used[:, None], keys, 0)
    cosines = jnp.matmul(_unit(queries), _unit(keys).T, precision=lax.Precision.HIGHEST)
    logits = jnp.where(is_left_out, -jnp.inf, cosines / temperature.astype(cosines.dtype))
    positive_logits = jnp.take_along_axis(logits, positives[:, None], axis=1)[:, 0]
    losses = jnp.where(is_counted, jax.nn.logsumexp(logits, axis=1) - positive_logits, 0)
    return jnp.sum(losses) / jnp.maximum(jnp.sum(is_counted), 1)


def _unit(vectors: Float[Array, "n c"]) -> Float[Array, "n c"]:
    # Largest entry first: the square of a small or large vector neither vanishes nor overflows.
    largest = lax.stop_gradient(jnp.max(jnp.abs(vectors), axis=-1, keepdims=True))
    is_zero = largest == 0
    scaled = vectors / jnp.where(is_zero, 1, largest)
    length = jnp.sqrt(jnp.where(is_zero, 1, jnp.sum(scaled**2, axis=-1, keepdims=True)))
    return jnp.where(is_zero, 0, scaled / length)


@typed_jit()
def offset_loss(
    predicted: Float[AnyArray, "n d"], true: Float[AnyArray, "n d"], mask: Bool[AnyArray, " n"] | None = None
) -> Float[Array, ""]:
    """Computes the mean Mahalanobis distance between predicted and true offsets (DeepPointMap eq. 6).

    The covariance is that of the residuals themselves, with n - 1 in the denominator, and is held constant for the
    derivative: so the loss compares residuals with each other, and the scale of the gradient does not shrink with them.
    Where the covariance cannot be inverted (too few residuals, or all of them in one plane) it is the identity, and the
    loss is the mean distance.

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
    is_there: jax.Array = as_mask("mask", mask, predicted.shape[:1])
    residuals = jnp.where(is_there[:, None], predicted, 0) - jnp.where(is_there[:, None], true, 0)
    inverse = _inverse_covariance(lax.stop_gradient(residuals), is_there)
    # Differences of products, summed over the last axis: a short contraction in full precision everywhere.
    squared = jnp.sum(residuals * jnp.matmul(residuals, inverse, precision=lax.Precision.HIGHEST), axis=1)
    return jnp.sum(safe_sqrt(squared)) / jnp.maximum(jnp.sum(is_there), 1)


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
