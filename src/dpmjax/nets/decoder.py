"""The decoder: attention correlates two descriptor clouds; heads give similarity, offsets, overlap, coarse features.

DeepPointMap section 3.2. Call a method by its name: `decoder.apply({"params": params}, a, b, method="correlate")`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import require_fields, require_value
from dpmjax.nets.attention import AttentionLayer, embed_positions
from dpmjax.nets.layers import TwoLayers, linear
from dpmjax.types import DescriptorCloud


@dataclass(frozen=True)
class DecoderConfig:
    """Widths of the decoder (defaults: DeepPointMap's published configuration).

    Attributes:
        input_channels: channels of a descriptor.
        model_channels: channels of a correlated descriptor; at least 6.
        num_layers: number of attention layers.
        num_heads: heads of each attention; divides `model_channels`.
        is_crossed: True as in the published networks: positions are embedded, and descriptors attend to those of both
            clouds. With False they attend to the features of their own cloud alone, which describe the surroundings
            already. The result then depends on one cloud and not on positions, and training needs fewer steps.
        predicts_offsets: False leaves all offsets at 0, as in `tiny` and `small`, and in the ablation of Table 2.
    """

    input_channels: int = 128
    model_channels: int = 256
    num_layers: int = 3
    num_heads: int = 8
    is_crossed: bool = True
    predicts_offsets: bool = True

    def __post_init__(self) -> None:
        require_fields(self, "input_channels", "num_layers", "num_heads", low=1)
        num, num_heads = self.model_channels, self.num_heads
        is_right = num >= 6 and num % num_heads == 0
        require_value(is_right, "model_channels", f"at least 6 and a multiple of num_heads = {num_heads}", num)


class LinearOfPair(nn.Module):
    """A linear map of two concatenated rows: the sum of one map of each, so that each row is mapped once.

    Attributes:
        num_features: channels of the result.
    """

    num_features: int

    @nn.compact
    def __call__(
        self, first: Float[Array, "... c"], second: Float[Array, "... c"], rows: Int[Array, "..."] | None
    ) -> Float[Array, "... f"]:
        """Maps pairs.

        Args:
            first: first rows.
            second: second rows.
            rows: if given, the second row of each pair is `second[rows]`.

        Returns:
            The sums, in the type of the matrix products.
        """
        num_channels = first.shape[-1]
        shape = (2 * num_channels, self.num_features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros_init(), (self.num_features,))
        first, second = first.astype(jnp.float32), second.astype(jnp.float32)
        of_second = jnp.matmul(second, kernel[num_channels:])
        return jnp.matmul(first, kernel[:num_channels]) + (of_second if rows is None else of_second[rows]) + bias


class OffsetHead(nn.Module):
    """Predicts the offset from a descriptor to its partner (DeepPointMap section 3.2, figure 2d).

    Three linear layers of halving width run beside a linear short cut; a linear map to three coordinates follows.
    """

    num_channels: int

    @nn.compact
    def __call__(
        self, features: Float[Array, "... c"], partners: Float[Array, "... c"], rows: Int[Array, "..."] | None = None
    ) -> Float[Array, "... 3"]:
        """Predicts offsets, row for row.

        Args:
            features: correlated features of the first cloud.
            partners: correlated features of their partners.
            rows: if given, the partners are `partners[rows]`.

        Returns:
            Offsets in metres, in the frame that the features are relative to.
        """
        x = nn.relu(LinearOfPair(self.num_channels, name="linear_0")(features, partners, rows))
        x = nn.relu(linear(self.num_channels // 2, "linear_1")(x))
        x = linear(self.num_channels // 4, "linear_2")(x)
        short_cut = LinearOfPair(self.num_channels // 4, name="short_cut")(features, partners, rows)
        return linear(3, "output")(nn.relu(x + short_cut))


class OverlapHead(nn.Module):
    """Predicts the overlap of two clouds (DeepPointMap section 3.2, figure 2e)."""

    num_channels: int

    @nn.compact
    def __call__(
        self,
        features: tuple[Float[Array, "m c"], Float[Array, "n c"]],
        masks: tuple[Bool[Array, " m"], Bool[Array, " n"]],
    ) -> Float[Array, ""]:
        """Predicts the logit of the overlap probability.

        Args:
            features: correlated features of both clouds.
            masks: masks of both clouds.

        Returns:
            The logit.
        """
        network = TwoLayers(self.num_channels, self.num_channels, name="network")
        means = [_masked_mean(network(x), mask) for x, mask in zip(features, masks, strict=True)]
        classifier = TwoLayers(2 * self.num_channels, 1, name="classifier")
        return classifier(jnp.concatenate(means))[0]


class DescriptorDecoder(nn.Module):
    """Correlates two descriptor clouds, and holds the four heads.

    Attributes:
        config: widths of the layers.
    """

    config: DecoderConfig

    def setup(self) -> None:
        """Makes all parts, so that each method finds its own."""
        config = self.config
        channels = config.model_channels
        self.projection = linear(channels, "projection")
        self.layers = [AttentionLayer(config.num_heads, name=f"layer_{i}") for i in range(config.num_layers)]
        self.similarity_head = TwoLayers(channels, channels)
        self.offset_head = OffsetHead(channels)
        self.overlap_head = OverlapHead(channels)
        self.coarse_head = TwoLayers(config.input_channels, config.input_channels)

    def correlate(self, a: DescriptorCloud, b: DescriptorCloud) -> tuple[DescriptorCloud, DescriptorCloud]:
        """Relates each descriptor to others by attention: to those of both clouds, or of its own (`is_crossed`).

        Args:
            a: descriptors with `input_channels` channels.
            b: the same.

        Returns:
            Both clouds with features of `model_channels` channels; zero where the mask is False.
        """
        masks = (a.mask, b.mask)
        a, b = _cleared(a), _cleared(b)
        embeddings = None
        if self.config.is_crossed:
            embeddings = embed_positions(jnp.concatenate([a.positions, b.positions]), self.config.model_channels)
        x = self.projection(jnp.concatenate([a.features, b.features]))
        for layer in self.layers:
            x = layer(x, embeddings, masks)
        features_a, features_b = jnp.split(x, [a.mask.size])
        return _cleared(replace(a, features=features_a)), _cleared(replace(b, features=features_b))

    def overlap_logit(self, a: DescriptorCloud, b: DescriptorCloud) -> Float[Array, ""]:
        """Predicts the logit of the probability that two clouds overlap.

        Args:
            a: a correlated cloud.
            b: the correlated target cloud.

        Returns:
            The logit.
        """
        return self.overlap_head((_cleared(a).features, _cleared(b).features), (a.mask, b.mask))

    def __call__(self, a: DescriptorCloud, b: DescriptorCloud) -> None:
        """Calls every part once, so that `init` makes all parameters.

        Args:
            a: any descriptor cloud.
            b: any descriptor cloud.
        """
        correlated_a, correlated_b = self.correlate(a, b)
        self.similarity_head(correlated_a.features)
        self.coarse_head(a.features)
        self.offset_head(correlated_a.features[:1], correlated_b.features[:1])
        self.overlap_logit(correlated_a, correlated_b)


def _cleared(cloud: DescriptorCloud) -> DescriptorCloud:
    # Masked entries may hold anything, and must not reach a gradient.
    mask = cloud.mask[:, None]
    positions, features = jnp.where(mask, cloud.positions, 0), jnp.where(mask, cloud.features, 0)
    return replace(cloud, positions=positions, features=features)


def _masked_mean(features: Float[Array, "m c"], mask: Bool[Array, " m"]) -> Float[Array, " c"]:
    total = jnp.sum(jnp.where(mask[:, None], features, 0), axis=0)
    return total / jnp.maximum(jnp.sum(mask), 1)
