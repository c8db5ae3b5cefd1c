"""Masked attention between descriptors, and the embedding of their positions (DeepPointMap section 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from dpmjax.nets.layers import TwoLayers, layer_norm, linear

EMBEDDING_TEMPERATURE = 10_000.0

# Largest number of logits that a CPU holds at once: 1 MB.
MAX_LIVE_LOGITS = 1 << 18


def embed_positions(positions: Float[Array, "n 3"], num_channels: int) -> Float[Array, "n c"]:
    """Embeds positions by sines and cosines at wavelengths from 2 m to about 20 km (Vaswani et al. 2017).

    Each axis has the largest even number of channels that fits three times: alternating sine and cosine, from the
    shortest wavelength to the longest. The remaining channels are zero.

    Args:
        positions: metres.
        num_channels: channels of the result, at least 6.

    Returns:
        (n, c), in the dtype of the positions.
    """
    per_axis = num_channels // 6 * 2
    exponents = 2 * jnp.arange(per_axis // 2, dtype=positions.dtype) / per_axis
    angles = positions[..., None] * jnp.pi / EMBEDDING_TEMPERATURE**exponents
    waves = jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=-1).reshape(*positions.shape[:-1], 3 * per_axis)
    return jnp.pad(waves, [(0, 0)] * (positions.ndim - 1) + [(0, num_channels - 3 * per_axis)])


def attend(
    queries: Float[Array, "m h c"], keys: Float[Array, "n h c"], values: Float[Array, "n h c"], mask: Bool[Array, " n"]
) -> Float[Array, "m h c"]:
    """Applies masked scaled dot-product attention; the softmax is computed in float32.

    The gradient computes the softmax again instead of keeping it (Dao et al. 2022, FlashAttention).

    Args:
        queries: m rows of h heads.
        keys: n rows of h heads.
        values: row for row with the keys.
        mask: False for keys that are not there; they may hold any finite number.

    Returns:
        A weighted mean of the values for each query; zero without any key.
    """
    num_queries, num_heads, num_channels = queries.shape
    num_blocks = max(1, -(-num_queries * len(keys) // MAX_LIVE_LOGITS))
    size = -(-num_queries // num_blocks)
    padded = jnp.pad(queries / num_channels**0.5, ((0, num_blocks * size - num_queries), (0, 0), (0, 0)))
    blocks = jnp.transpose(padded.reshape(num_blocks, size, num_heads, num_channels), (2, 0, 3, 1))
    # Channels stand before rows, because sums over keys and products with few channels are faster on a CPU then.
    arguments = blocks, jnp.moveaxis(keys, 0, 2), jnp.moveaxis(values, 0, 2)
    of_head = partial(_attend_head, bias=jnp.where(mask, 0, -jnp.inf))
    # All heads at once where their logits fit the cache of a CPU.
    num_logits = num_queries * num_heads * len(keys)
    over_heads = partial(_one_after_the_other, of_head) if num_logits > MAX_LIVE_LOGITS else jax.vmap(of_head)
    return jnp.transpose(over_heads(*arguments), (1, 3, 0, 2)).reshape(-1, num_heads, num_channels)[:num_queries]


def _attend_head(queries: jax.Array, keys: jax.Array, values: jax.Array, *, bias: jax.Array) -> jax.Array:
    """Applies one head to queries (b, c, m) in b blocks and to keys (c, n); the bias is 0 or, without a key, -inf."""

    @jax.checkpoint
    def of_block(query: jax.Array) -> jax.Array:
        logits = jnp.einsum("cn,cm->nm", keys, query) + bias[:, None]
        # Finite even without any key, so that masked keys have a share of exactly zero.
        largest = jnp.max(lax.stop_gradient(logits), axis=0, initial=jnp.finfo(jnp.float32).min)
        shares = jnp.exp(logits - largest)
        total = jnp.sum(shares, axis=0)
        # Divided after the product: (c, m) numbers instead of (n, m).
        return jnp.einsum("cn,nm->cm", values, shares) / jnp.where(total > 0, total, 1)

    return _one_after_the_other(of_block, queries)


def _one_after_the_other(function: Callable[..., jax.Array], *arrays: jax.Array) -> jax.Array:
    # Maps over the first axis. Logits that do not fit the cache of a CPU take twice as long there.
    return lax.platform_dependent(
        *arrays, cpu=lambda *arrays: lax.map(lambda one: function(*one), arrays), default=jax.vmap(function)
    )


class PairAttention(nn.Module):
    """Attention with several heads on a pair of clouds: self-attention or cross-attention.

    Attributes:
        num_heads: divides the number of channels.
        is_crossed: True for cross attention between both clouds; False for self-attention.
    """

    num_heads: int
    is_crossed: bool

    @nn.compact
    def __call__(
        self, features: Float[Array, "rows c"], masks: tuple[Bool[Array, " m"], Bool[Array, " n"]]
    ) -> Float[Array, "rows c"]:
        """Applies attention to both clouds.

        Args:
            features: the stacked rows of both clouds, so that each matrix is multiplied once.
            masks: masks of both clouds.

        Returns:
            Mixed features, row for row.
        """
        num_rows, num_channels = features.shape
        # One matrix for queries, keys and values, side by side.
        kernel = self.param("in_kernel", nn.initializers.lecun_normal(), (num_channels, 3 * num_channels))
        bias = self.param("in_bias", nn.initializers.zeros_init(), (3 * num_channels,))
        mapped = jnp.matmul(features.astype(jnp.float32), kernel) + bias
        mapped = mapped.reshape(num_rows, 3, self.num_heads, num_channels // self.num_heads)
        queries, keys, values = (jnp.split(mapped[:, part], [masks[0].size]) for part in range(3))
        contexts = [*zip(keys, values, masks, strict=True)]
        if self.is_crossed:
            contexts.reverse()
        mixed = [attend(query, *context) for query, context in zip(queries, contexts, strict=True)]
        rows = jnp.concatenate(mixed).reshape(num_rows, num_channels)
        return linear(num_channels, "out")(rows)


class AttentionLayer(nn.Module):
    """Attention and a two-layer network on a pair of clouds, each added to its input and then normalised.

    With embeddings of positions it has self-attention and cross-attention, and they are added to the features before
    both. They are therefore in the queries, keys, values and in the residual path (the published networks; the paper
    leaves it open). Otherwise it has self-attention alone, of features alone. Both clouds share the weights.

    Attributes:
        num_heads: heads of both attentions.
    """

    num_heads: int

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "rows c"],
        embeddings: Float[Array, "rows c"] | None,
        masks: tuple[Bool[Array, " m"], Bool[Array, " n"]],
    ) -> Float[Array, "rows c"]:
        """Applies the layer to both clouds.

        Args:
            features: the stacked rows of both clouds.
            embeddings: embeddings of the positions, row for row; None for self-attention alone.
            masks: masks of both clouds.

        Returns:
            New features, row for row.
        """
        num_channels = features.shape[1]
        x = features if embeddings is None else features + embeddings
        x += PairAttention(self.num_heads, False, name="self_attention")(x, masks)
        x = layer_norm("self_norm")(x)
        if embeddings is not None:
            x += embeddings
            x += PairAttention(self.num_heads, True, name="cross_attention")(x, masks)
            x = layer_norm("cross_norm")(x)
        x += TwoLayers(num_channels, num_channels, name="network")(x)
        return layer_norm("network_norm")(x)
