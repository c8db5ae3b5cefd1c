"""What is read from descriptors: how alike they are, how far apart, and whether two clouds overlap."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.nets.layers import ComputeDtype, TwoLayers, linear


class OffsetHead(nn.Module):
    """Where the partner of a descriptor lies, relative to it (DeepPointMap section 3.2, figure 2d).

    Three linear layers of halving width beside a linear short cut, then a linear map to three coordinates.

    Attributes:
        num_channels: of one descriptor.
        compute_dtype: of the matrix products.
    """

    num_channels: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(self, features: Float[Array, "... c"], partners: Float[Array, "... c"]) -> Float[Array, "... 3"]:
        """Metres, in the frame of the first cloud; row for row."""
        pair = jnp.concatenate([features, partners], axis=-1)
        x = nn.relu(linear(self.num_channels, self.compute_dtype, "linear_0")(pair))
        x = nn.relu(linear(self.num_channels // 2, self.compute_dtype, "linear_1")(x))
        x = linear(self.num_channels // 4, self.compute_dtype, "linear_2")(x)
        short_cut = linear(self.num_channels // 4, self.compute_dtype, "short_cut")(pair)
        return linear(3, "float32", "output")(nn.relu(x + short_cut).astype(jnp.float32))


class OverlapHead(nn.Module):
    """Whether two clouds see the same place (DeepPointMap section 3.2, figure 2e).

    Attributes:
        num_channels: of one descriptor.
        compute_dtype: of the matrix products.
    """

    num_channels: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(
        self,
        features: tuple[Float[Array, "m c"], Float[Array, "n c"]],
        masks: tuple[Bool[Array, " m"], Bool[Array, " n"]],
    ) -> Float[Array, ""]:
        """The logit of the probability; features and masks of the one cloud and of the other."""
        network = TwoLayers(self.num_channels, self.num_channels, self.compute_dtype, name="network")
        means = [_masked_mean(network(x), mask) for x, mask in zip(features, masks, strict=True)]
        classifier = TwoLayers(2 * self.num_channels, 1, "float32", name="classifier")
        return classifier(jnp.concatenate(means))[0]


def _masked_mean(features: Float[Array, "m c"], mask: Bool[Array, " m"]) -> Float[Array, " c"]:
    total = jnp.sum(jnp.where(mask[:, None], features, 0), axis=0)
    return total / jnp.maximum(jnp.sum(mask), 1)
