"""Layers that all networks share, with their numerical settings in one place."""

from __future__ import annotations

from typing import Literal, get_args

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from dpmjax.checks import require_one_of

# Type of the matrix products. Parameters, normalisation, softmax and geometry are float32 either way.
ComputeDtype = Literal["float32", "bfloat16"]

NORM_EPSILON = 1e-5


def require_compute_dtype(value: str) -> None:
    """Checks the name of a type of matrix products.

    Args:
        value: one of the names in `ComputeDtype`.

    Another name raises a `ValueError`.
    """
    require_one_of("compute_dtype", value, get_args(ComputeDtype))


def linear(num_features: int, compute_dtype: ComputeDtype, name: str) -> nn.Dense:
    """Makes a linear map over channels (a 1x1 convolution over points).

    Args:
        num_features: channels of the result.
        compute_dtype: type of the matrix product.
        name: name of its parameters.

    Returns:
        The module.
    """
    return nn.Dense(num_features, dtype=jnp.dtype(compute_dtype), name=name)


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
        compute_dtype: type of the matrix products.
    """

    hidden_channels: int
    output_channels: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "... c"]) -> Float[Array, "... f"]:
        """Applies both maps.

        Args:
            x: channels last, any number of axes before them.

        Returns:
            float32, the same axes.
        """
        x = nn.relu(linear(self.hidden_channels, self.compute_dtype, "linear_0")(x))
        return linear(self.output_channels, self.compute_dtype, "linear_1")(x).astype(jnp.float32)
