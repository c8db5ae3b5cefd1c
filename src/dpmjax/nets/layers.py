"""Layers that all networks share, with their numerical settings in one place."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

NORM_EPSILON = 1e-5


def linear(num_features: int, name: str) -> nn.Dense:
    """Makes a linear map over channels in float32 (a 1x1 convolution over points).

    Args:
        num_features: channels of the result.
        name: name of its parameters.

    Returns:
        The module.
    """
    return nn.Dense(num_features, dtype=jnp.float32, name=name)


def layer_norm(name: str) -> nn.LayerNorm:
    """Makes a layer normalisation over channels in float32; the variance comes from differences to the mean.

    Args:
        name: name of its parameters.

    Returns:
        The module.
    """
    return nn.LayerNorm(epsilon=NORM_EPSILON, dtype=jnp.float32, use_fast_variance=False, name=name)


class TwoLayers(nn.Module):
    """Linear, relu, linear.

    Attributes:
        hidden_channels: channels between the two maps.
        output_channels: channels of the result.
    """

    hidden_channels: int
    output_channels: int

    @nn.compact
    def __call__(self, x: Float[Array, "... c"]) -> Float[Array, "... f"]:
        """Applies both maps.

        Args:
            x: channels last, any number of axes before them.

        Returns:
            float32, the same axes.
        """
        x = nn.relu(linear(self.hidden_channels, "linear_0")(x))
        return linear(self.output_channels, "linear_1")(x)
