"""The overlap loss: do two clouds see the same place or not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_float, as_mask
from dpmjax.types import AnyArray


def overlap_loss(
    logits: Float[AnyArray, " b"], labels: Bool[AnyArray, " b"], mask: Bool[AnyArray, " b"] | None = None
) -> Float[Array, ""]:
    """Binary cross entropy of overlap logits, mean over pairs of clouds (DeepPointMap section 3.3, overlap loss).

    Args:
        logits: log odds that the two clouds of each pair overlap.
        labels: True where they do: true poses, taken before augmentation, closer than 20 m.
        mask: False for pairs that are not there; they may hold anything.

    Returns:
        The loss, in nats; 0, with zero gradient, without any pair.

    Raises:
        ValueError: the shapes do not match.
    """
    logits = as_float("logits", logits)
    if logits.ndim != 1:
        raise ValueError(f"logits: expected shape (b,), got {logits.shape}")
    labels = as_mask("labels", labels, logits.shape)
    return _overlap_loss(logits, labels, as_mask("mask", mask, logits.shape))


@jax.jit
def _overlap_loss(logits: jax.Array, labels: jax.Array, mask: jax.Array) -> jax.Array:
    logits = jnp.where(mask, logits, 0)
    # Equals -log p or -log(1 - p) for p = sigmoid(logit), without the overflow.
    cross_entropy = jnp.where(mask, jax.nn.softplus(jnp.where(labels, -logits, logits)), 0)
    return jnp.sum(cross_entropy) / jnp.maximum(jnp.sum(mask), 1)
