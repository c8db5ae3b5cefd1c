"""The network of the one-dimensional example: a number goes in, a number comes out (DeepMapping supplement D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import flax.linen as nn
import jax
from jaxtyping import Array, Float

from dpmjax.checks import require_one_of

Initialization = Literal["xavier-relu", "xavier", "he", "lecun", "pytorch"]

# Scale, fan and distribution of `variance_scaling`.
_KERNELS: dict[str, tuple[float, Any, Any]] = {
    "xavier-relu": (2.0, "fan_avg", "uniform"),
    "xavier": (1.0, "fan_avg", "uniform"),
    "he": (2.0, "fan_in", "normal"),
    "lecun": (1.0, "fan_in", "truncated_normal"),
    "pytorch": (1.0 / 3.0, "fan_in", "uniform"),
}


@dataclass(frozen=True)
class ScalarNetConfig:
    """Shape of the network; the features are the paper's, which does not tell the initialisation.

    Attributes:
        features: channels of the hidden layers, each followed by an ELU.
        initialization: "xavier-relu": Xavier-uniform with the gain of ReLU, as in the published L-Net; "xavier":
            without the gain; "he"; "lecun" (Flax's default); "pytorch": PyTorch's default. Biases are zero but for
            "pytorch", where they are as uniform as the weights.
    """

    features: tuple[int, ...] = (10, 20, 30, 40)
    initialization: Initialization = "xavier-relu"

    def __post_init__(self) -> None:
        require_one_of("initialization", self.initialization, get_args(Initialization))


class ScalarNet(nn.Module):
    """A multi-layer perceptron from one number to one number."""

    config: ScalarNetConfig

    @nn.compact
    def __call__(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """The value x that the auxiliary variable z stands for."""
        x = z[None]
        for features in self.config.features:
            x = nn.elu(self._linear(features, x))
        return self._linear(1, x)[0]

    def _linear(self, features: int, x: Float[Array, " c"]) -> Float[Array, " f"]:
        kernel_init = nn.initializers.variance_scaling(*_KERNELS[self.config.initialization])
        bound = x.shape[0] ** -0.5 if self.config.initialization == "pytorch" else 0.0

        def bias_init(key: jax.Array, shape: Any, dtype: Any = float) -> Array:
            return jax.random.uniform(key, shape, dtype, -bound, bound)

        return nn.Dense(features, kernel_init=kernel_init, bias_init=bias_init)(x)
