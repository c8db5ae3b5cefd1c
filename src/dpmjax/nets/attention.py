"""Masked attention between descriptors, and the embedding of their positions (DeepPointMap section 3.2)."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from dpmjax.nets.layers import ComputeDtype, TwoLayers, layer_norm, linear

EMBEDDING_TEMPERATURE = 10_000.0

MAX_LIVE_LOGITS = 1 << 20
"""Largest number of logits that a CPU holds at once: 4 MB."""


def embed_positions(positions: Float[Array, "n 3"], num_channels: int) -> Float[Array, "n c"]:
    """Embeds positions by sines and cosines at wavelengths from 2 m to about 20 km (Vaswani et al. 2017).

    Each axis has the largest even number of channels that fits three times: sine and cosine by turns, from the
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

    Args:
        queries: m rows of h heads.
        keys: n rows of h heads.
        values: row for row with the keys.
        mask: False for keys that are not there; they may hold any finite number.

    Returns:
        A weighted mean of the values for each query; zero without any key.
    """
    per_head = [jnp.swapaxes(x, 0, 1) for x in (queries / queries.shape[-1] ** 0.5, keys, values)]

    def all_heads(*heads: jax.Array) -> jax.Array:
        return jax.vmap(lambda query, key, value: _attend_with_one_head(query, key, value, mask))(*heads)

    def head_by_head(*heads: jax.Array) -> jax.Array:
        return lax.map(lambda head: _attend_in_chunks(head[0], head[1], head[2], mask), heads)

    num_logits = queries.shape[0] * queries.shape[1] * keys.shape[0]
    if num_logits <= MAX_LIVE_LOGITS:
        mixed = all_heads(*per_head)
    else:
        # Logits that do not fit the cache of a CPU take three times as long there.
        mixed = lax.platform_dependent(*per_head, cpu=head_by_head, default=all_heads)
    return jnp.swapaxes(mixed, 0, 1)


def _attend_in_chunks(
    queries: Float[Array, "m c"], keys: Float[Array, "n c"], values: Float[Array, "n c"], mask: Bool[Array, " n"]
) -> Float[Array, "m c"]:
    @jax.checkpoint  # a gradient would keep all logits of all chunks
    def attend_one(query: Float[Array, " c"]) -> Float[Array, " c"]:
        return _attend_with_one_head(query[None], keys, values, mask)[0]

    return lax.map(attend_one, queries, batch_size=max(1, MAX_LIVE_LOGITS // keys.shape[0]))


def _attend_with_one_head(
    queries: Float[Array, "m c"], keys: Float[Array, "n c"], values: Float[Array, "n c"], mask: Bool[Array, " n"]
) -> Float[Array, "m c"]:
    logits = jnp.matmul(queries, keys.T, preferred_element_type=jnp.float32) + jnp.where(mask, 0, -jnp.inf)
    # Finite even without any key, so that masked keys have a share of exactly zero.
    lowest = jnp.finfo(jnp.float32).min
    largest = lax.stop_gradient(jnp.max(logits, axis=-1, keepdims=True, initial=lowest))
    shares = jnp.exp(logits - largest)
    # Divided after the product: (m, c) numbers instead of (m, n).
    total = jnp.sum(shares, axis=-1, keepdims=True)
    mixed = jnp.matmul(shares.astype(values.dtype), values, preferred_element_type=jnp.float32)
    return mixed / jnp.where(total > 0, total, 1)


class PairAttention(nn.Module):
    """Attention with several heads on a pair of clouds: self-attention or cross-attention.

    Attributes:
        num_heads: divides the number of channels.
        is_crossed: whether each cloud attends to the other one instead of to itself.
        compute_dtype: type of the matrix products.
    """

    num_heads: int
    is_crossed: bool
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self, features: Float[Array, "rows c"], masks: tuple[Bool[Array, " m"], Bool[Array, " n"]]
    ) -> Float[Array, "rows c"]:
        """Applies attention to both clouds.

        Args:
            features: the rows of both clouds, one below the other, so that each matrix is multiplied once.
            masks: masks of both clouds.

        Returns:
            Mixed features, row for row.
        """
        num_rows, num_channels = features.shape
        dtype = jnp.dtype(self.compute_dtype)
        # One matrix for queries, keys and values, side by side.
        kernel = self.param("in_kernel", nn.initializers.lecun_normal(), (num_channels, 3 * num_channels))
        bias = self.param("in_bias", nn.initializers.zeros_init(), (3 * num_channels,))
        mapped = jnp.matmul(features.astype(dtype), kernel.astype(dtype)) + bias.astype(dtype)
        mapped = mapped.reshape(num_rows, 3, self.num_heads, num_channels // self.num_heads)
        queries, keys, values = (jnp.split(mapped[:, part], [masks[0].size]) for part in range(3))
        contexts = [*zip(keys, values, masks, strict=True)]
        if self.is_crossed:
            contexts.reverse()
        mixed = [attend(query, *context) for query, context in zip(queries, contexts, strict=True)]
        rows = jnp.concatenate(mixed).reshape(num_rows, num_channels)
        return linear(num_channels, self.compute_dtype, "out")(rows).astype(jnp.float32)


class AttentionLayer(nn.Module):
    """Self-attention, cross-attention and a two-layer network on a pair of clouds, each added and then normalised.

    The position embedding is added to the features before both attentions. It is therefore in the queries, keys,
    values and in the residual path (the published networks; the paper leaves it open). Both clouds share the weights.

    Attributes:
        num_heads: heads of both attentions.
        compute_dtype: type of the matrix products.
    """

    num_heads: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self,
        features: Float[Array, "rows c"],
        embeddings: Float[Array, "rows c"],
        masks: tuple[Bool[Array, " m"], Bool[Array, " n"]],
    ) -> Float[Array, "rows c"]:
        """Applies the layer to both clouds.

        Args:
            features: the rows of both clouds, one below the other.
            embeddings: of the positions, row for row.
            masks: masks of both clouds.

        Returns:
            New features, row for row.
        """
        num_channels = features.shape[1]
        x = features + embeddings
        x += PairAttention(self.num_heads, False, self.compute_dtype, name="self_attention")(x, masks)
        x = layer_norm("self_norm")(x) + embeddings
        x += PairAttention(self.num_heads, True, self.compute_dtype, name="cross_attention")(x, masks)
        x = layer_norm("cross_norm")(x)
        x += TwoLayers(num_channels, num_channels, self.compute_dtype, name="network")(x)
        return layer_norm("network_norm")(x)
