"""Losses of DeepMapping: the Chamfer distance between clouds, and the occupancy loss of beams.

Hits of beams are occupied, and the space that beams passed is free.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_mask, as_points, require_positive, require_value
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.rigid import safe_sqrt
from dpmjax.geometry.traced import typed_jit, usable_weights
from dpmjax.types import AnyArray


def chamfer_distance(
    a: Float[AnyArray, "n d"],
    b: Float[AnyArray, "m d"],
    mask_a: Bool[AnyArray, " n"] | None = None,
    mask_b: Bool[AnyArray, " m"] | None = None,
    *,
    max_distance: float | Float[AnyArray, ""] | None = None,
) -> Float[Array, ""]:
    """Computes the mean distance from points of a to the nearest of b, plus that from b to a (DeepMapping eq. 5).

    Distances are Euclidean, not squared, in the unit of the points.

    Args:
        a: points, in the same frame and unit as `b`.
        b: points.
        mask_a: False for points of `a` that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.
        mask_b: the same for `b`.
        max_distance: larger distances count as this one and have no derivative; None: no limit.

    Returns:
        The sum of both means; 0 if either cloud has no valid point. Where points coincide the derivative of their
        distance is taken as 0.

    Raises:
        ValueError: the shapes do not match, or `max_distance` is not above 0.
    """
    a, b = as_points("a", a), as_points("b", b)
    require_value(a.shape[1] == b.shape[1], "b", f"{a.shape[1]} columns like a", b.shape[1])
    if max_distance is not None:
        require_positive("max_distance", max_distance)
    limit = jnp.asarray(jnp.inf if max_distance is None else max_distance, a.dtype)
    mask_a, mask_b = as_mask("mask_a", mask_a, a.shape[:1]), as_mask("mask_b", mask_b, b.shape[:1])
    total: Array = _mean_distance(a, b, mask_a, mask_b, limit) + _mean_distance(b, a, mask_b, mask_a, limit)
    return total


@jax.jit
def _mean_distance(
    queries: Float[Array, "n d"],
    points: Float[Array, "m d"],
    query_mask: Bool[Array, " n"],
    mask: Bool[Array, " m"],
    limit: Float[Array, ""],
) -> Float[Array, ""]:
    near = k_nearest(queries, points, 1, mask)
    is_counted = query_mask & near.mask[:, 0]
    squared = jnp.where(is_counted, near.squared_distances[:, 0], 0)
    return jnp.sum(jnp.minimum(safe_sqrt(squared), limit)) / jnp.maximum(jnp.sum(is_counted), 1)


@typed_jit()
def occupancy_loss(
    logits: Float[AnyArray, "..."], labels: Float[AnyArray, "..."], weights: Float[AnyArray, "..."]
) -> Float[Array, ""]:
    """Computes the weighted binary cross entropy of occupancy logits (DeepMapping eq. 3 and 4).

    Args:
        logits: log odds of being occupied, any shape.
        labels: 1 occupied, 0 free; broadcasts against `logits`.
        weights: weight of each sample, 0 for samples of invalid beams, which may hold anything; broadcasts against
            `logits`. Only ratios count. A weight that is not finite or not above 0 counts as 0, and so does one below
            the smallest normal number (1.2e-38 in float32).

    Returns:
        sum(weights * cross entropy) / sum(weights), in nats; 0, with zero gradient, when all weights are zero.

    Raises:
        ValueError: the shapes do not broadcast to that of `logits`.
    """
    logits, labels, weights = as_float("logits", logits), as_float("labels", labels), as_float("weights", weights)
    for name, array in (("labels", labels), ("weights", weights)):
        sizes = zip(reversed(array.shape), reversed(logits.shape), strict=False)
        is_right = array.ndim <= logits.ndim and all(size in (1, whole) for size, whole in sizes)
        require_value(is_right, name, f"a shape that broadcasts to {logits.shape}", array.shape)
    weights = jnp.broadcast_to(usable_weights(weights), logits.shape)
    labels = jnp.broadcast_to(labels, logits.shape)
    is_counted = weights > 0
    logits = jnp.where(is_counted, logits, 0)
    labels = jnp.where(is_counted, labels, 0)
    total = jnp.sum(weights)
    return jnp.sum(weights * _cross_entropy(logits, labels)) / jnp.where(total > 0, total, 1)


@jax.custom_jvp
def _cross_entropy(logits: jax.Array, labels: jax.Array) -> jax.Array:
    """Computes -y log p - (1 - y) log(1 - p) for p = sigmoid(logit), without the overflow."""
    return jnp.maximum(logits, 0) - labels * logits + jnp.log1p(jnp.exp(-jnp.abs(logits)))


# The derivative that JAX finds for softplus takes several exponentials, and XLA computes them again for every sum.
_cross_entropy.defjvps(
    lambda tangent, _, logits, labels: tangent * (jax.nn.sigmoid(logits) - labels),
    lambda tangent, _, logits, labels: -tangent * logits,
)
