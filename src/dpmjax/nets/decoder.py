"""The decoder: two descriptor clouds look at each other, and heads read off what registration needs.

DeepPointMap section 3.2. Its methods are called by name: `decoder.apply({"params": params}, a, b, method="correlate")`.
"""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.checks import require_count
from dpmjax.nets.attention import AttentionLayer, embed_positions
from dpmjax.nets.heads import OffsetHead, OverlapHead
from dpmjax.nets.layers import ComputeDtype, TwoLayers, linear, require_compute_dtype
from dpmjax.types import DescriptorCloud


@dataclass(frozen=True)
class DecoderConfig:
    """Widths of the decoder (defaults: DeepPointMap's published configuration).

    Attributes:
        input_channels: of a descriptor.
        model_channels: of a correlated descriptor; at least 6.
        num_layers: of attention.
        num_heads: of each attention; divides `model_channels`.
        shares_layers: whether all layers have the same weights, as the paper says; the published networks do not.
        compute_dtype: of the matrix products.
    """

    input_channels: int = 128
    model_channels: int = 256
    num_layers: int = 3
    num_heads: int = 8
    shares_layers: bool = False
    compute_dtype: ComputeDtype = "float32"

    def __post_init__(self) -> None:
        for name in ("input_channels", "num_layers", "num_heads"):
            require_count(name, getattr(self, name))
        if self.model_channels < 6 or self.model_channels % self.num_heads:
            expected = f"expected at least 6 and a multiple of num_heads = {self.num_heads}"
            raise ValueError(f"model_channels: {expected}, got {self.model_channels}")
        require_compute_dtype(self.compute_dtype)


class DescriptorDecoder(nn.Module):
    """Descriptor clouds to correlated ones, and the four heads.

    Attributes:
        config: the widths.
    """

    config: DecoderConfig

    def setup(self) -> None:
        """All parts, so that every method finds its own."""
        config = self.config
        channels, dtype = config.model_channels, config.compute_dtype
        self.projection = linear(channels, dtype, "projection")
        num_different = 1 if config.shares_layers else config.num_layers
        self.layers = [AttentionLayer(config.num_heads, dtype, name=f"layer_{i}") for i in range(num_different)]
        self.similarity_head = TwoLayers(channels, channels, dtype)
        self.offset_head = OffsetHead(channels, dtype)
        self.overlap_head = OverlapHead(channels, dtype)
        self.coarse_head = TwoLayers(config.input_channels, config.input_channels, dtype)

    def correlate(self, a: DescriptorCloud, b: DescriptorCloud) -> tuple[DescriptorCloud, DescriptorCloud]:
        """Both clouds with features that know of each other, `model_channels` wide; zero where the mask is False."""
        masks = (a.mask, b.mask)
        a, b = _cleared(a), _cleared(b)
        embeddings = embed_positions(jnp.concatenate([a.positions, b.positions]), self.config.model_channels)
        x = self.projection(jnp.concatenate([a.features, b.features])).astype(jnp.float32)
        for i in range(self.config.num_layers):
            x = self.layers[i % len(self.layers)](x, embeddings, masks)
        features_a, features_b = jnp.split(x, [a.mask.size])
        correlated_a = DescriptorCloud(a.positions, features_a, masks[0])
        correlated_b = DescriptorCloud(b.positions, features_b, masks[1])
        return _cleared(correlated_a), _cleared(correlated_b)

    def similarity_features(self, features: Float[Array, "m c"]) -> Float[Array, "m c"]:
        """Correlated features to those whose cosine tells how likely two descriptors are partners."""
        return self.similarity_head(features)

    def coarse_features(self, features: Float[Array, "m c"]) -> Float[Array, "m c"]:
        """Uncorrelated features to those that the coarse pairing loss compares (DeepPointMap eq. 5)."""
        return self.coarse_head(features)

    def offsets(self, features: Float[Array, "... c"], partners: Float[Array, "... c"]) -> Float[Array, "... 3"]:
        """Metres from each descriptor to its partner in the frame of the first, from their correlated features."""
        return self.offset_head(features, partners)

    def overlap_logit(self, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
        """Logit of the probability that two correlated clouds see the same place."""
        return self.overlap_head((_cleared(a).features, _cleared(b).features), (a.mask, b.mask))

    def __call__(self, a: DescriptorCloud, b: DescriptorCloud) -> None:
        """Touches every part once, so that `init` makes all parameters."""
        correlated_a, correlated_b = self.correlate(a, b)
        self.similarity_features(correlated_a.features)
        self.coarse_features(a.features)
        self.offsets(correlated_a.features[:1], correlated_b.features[:1])
        self.overlap_logit(correlated_a, correlated_b)


def _cleared(cloud: DescriptorCloud) -> DescriptorCloud:
    """Zero where nothing is: what stands there may be anything, and must not reach a gradient."""
    mask = cloud.mask[:, None]
    positions, features = jnp.where(mask, cloud.positions, 0), jnp.where(mask, cloud.features, 0)
    return DescriptorCloud(positions, features, cloud.mask)
