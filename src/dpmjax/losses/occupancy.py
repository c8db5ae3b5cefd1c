"""The occupancy loss: what a beam hit is occupied, what it passed is free."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.checks import as_float
from dpmjax.types import AnyArray


def occupancy_loss(
    logits: Float[AnyArray, "..."], labels: Float[AnyArray, "..."], weights: Float[AnyArray, "..."]
) -> Float[Array, ""]:
    """Weighted binary cross entropy of occupancy logits (DeepMapping eq. 3 and 4).

    Args:
        logits: log odds of being occupied, any shape.
        labels: 1 occupied, 0 free; broadcasts against `logits`.
        weights: of each sample, 0 for samples of invalid beams, which may hold anything; broadcasts against `logits`.

    Returns:
        sum(weights * cross entropy) / sum(weights), in nats; 0, with zero gradient, when all weights are zero.

    Raises:
        ValueError: the shapes do not broadcast to that of `logits`.
    """
    logits, labels, weights = as_float("logits", logits), as_float("labels", labels), as_float("weights", weights)
    for name, array in (("labels", labels), ("weights", weights)):
        try:
            is_right = jnp.broadcast_shapes(array.shape, logits.shape) == logits.shape
        except ValueError:
            is_right = False
        if not is_right:
            raise ValueError(f"{name}: expected a shape that broadcasts to {logits.shape}, got {array.shape}")
    return _occupancy_loss(logits, labels, weights)


@jax.jit
def _occupancy_loss(logits: jax.Array, labels: jax.Array, weights: jax.Array) -> jax.Array:
    weights = jnp.broadcast_to(weights, logits.shape)
    labels = jnp.broadcast_to(labels, logits.shape)
    is_counted = weights != 0
    logits = jnp.where(is_counted, logits, 0)
    labels = jnp.where(is_counted, labels, 0)
    # Equals -y log p - (1 - y) log(1 - p) for p = sigmoid(logit), without the overflow.
    cross_entropy = jax.nn.softplus(logits) - labels * logits
    total = jnp.sum(weights)
    return jnp.sum(weights * cross_entropy) / jnp.where(total > 0, total, 1)
