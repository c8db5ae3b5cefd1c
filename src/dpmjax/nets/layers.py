"""The layers that the networks are made of, and one place for their numerical habits."""

from __future__ import annotations

from typing import Literal, get_args

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

ComputeDtype = Literal["float32", "bfloat16"]
"""What matrix products are computed in. Parameters, normalisation, softmax and geometry are float32 either way."""

NORM_EPSILON = 1e-5


def require_compute_dtype(value: str) -> None:
    """Raises a ValueError where the name is none of `ComputeDtype`."""
    if value not in get_args(ComputeDtype):
        raise ValueError(f"compute_dtype: expected one of {', '.join(get_args(ComputeDtype))}, got {value!r}")


def linear(num_features: int, compute_dtype: ComputeDtype, name: str) -> nn.Dense:
    """A linear map over channels (a 1x1 convolution over points)."""
    return nn.Dense(num_features, dtype=jnp.dtype(compute_dtype), name=name)


def layer_norm(name: str) -> nn.LayerNorm:
    """Layer normalisation over channels, in float32, the variance from differences to the mean."""
    return nn.LayerNorm(epsilon=NORM_EPSILON, dtype=jnp.float32, use_fast_variance=False, name=name)


class TwoLayers(nn.Module):
    """Linear, relu, linear.

    Attributes:
        hidden_channels: between the two.
        output_channels: of the result.
        compute_dtype: of the matrix products.
    """

    hidden_channels: int
    output_channels: int
    compute_dtype: ComputeDtype = "float32"

    @nn.compact
    def __call__(self, x: Float[Array, "... c"]) -> Float[Array, "... f"]:
        """Channels last; any number of axes before them. The result is float32."""
        x = nn.relu(linear(self.hidden_channels, self.compute_dtype, "linear_0")(x))
        return linear(self.output_channels, self.compute_dtype, "linear_1")(x).astype(jnp.float32)
