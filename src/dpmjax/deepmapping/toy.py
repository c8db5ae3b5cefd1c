"""Optimisation of a network instead of its output, in one dimension (DeepMapping supplement D, figure 14).

The same function is minimised twice by plain gradient descent from the same initial value. The first variable is x. The
second is the weights and the input of a network with the output x. Both are problems of the engine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from dpmjax.checks import require_fields, require_one_of, require_positive_fields
from dpmjax.deepmapping.problem import Problem
from dpmjax.types import AnyArray

Initialization = Literal["xavier-relu", "xavier", "he", "lecun", "pytorch"]

# Minimum of L and its value, by Newton's method in float64.
GLOBAL_MINIMUM = (-1.4170104840663422, -23.7572935100868)
# Scale, fan and distribution of `variance_scaling`.
_KERNELS: dict[str, tuple[float, Any, Any]] = {
    "xavier-relu": (2.0, "fan_avg", "uniform"),
    "xavier": (1.0, "fan_avg", "uniform"),
    "he": (2.0, "fan_in", "normal"),
    "lecun": (1.0, "fan_in", "truncated_normal"),
    "pytorch": (1.0 / 3.0, "fan_in", "uniform"),
}


class ScalarNet(nn.Module):
    """A multi-layer perceptron from one number to one number.

    Attributes:
        initialization: distribution of the first weights.
        features: channels of the hidden layers, each followed by an ELU; the default is the paper's.
    """

    initialization: Initialization
    features: tuple[int, ...] = (10, 20, 30, 40)

    @nn.compact
    def __call__(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """Computes the value x from the auxiliary variable z."""
        x = z[None]
        for features in self.features:
            x = nn.elu(self._linear(features, x))
        return self._linear(1, x)[0]

    def _linear(self, features: int, x: Float[Array, " c"]) -> Float[Array, " f"]:
        kernel_init = nn.initializers.variance_scaling(*_KERNELS[self.initialization])
        bound = x.shape[0] ** -0.5 if self.initialization == "pytorch" else 0.0

        def bias_init(key: jax.Array, shape: Any, dtype: Any = float) -> Array:
            return jax.random.uniform(key, shape, dtype, -bound, bound)

        return nn.Dense(features, kernel_init=kernel_init, bias_init=bias_init)(x)


@dataclass(frozen=True)
class ToyConfig:
    """Settings of the example and of its only phase; the defaults are the paper's, whose initialisation is unpublished.

    Attributes:
        form: "network": weights and input of the network are optimised; "direct": x is optimised, from the output of
            the untrained network, so that both forms have the same initial value.
        initialization: "xavier-relu": Xavier-uniform with the gain of ReLU, as in the published L-Net; "xavier":
            without the gain; "he"; "lecun" (Flax's default); "pytorch": PyTorch's default. Biases are zero, or for
            "pytorch" uniform like the weights.
        learning_rate: learning rate of gradient descent.
        num_steps: number of steps of gradient descent.
    """

    form: Literal["network", "direct"] = "network"
    initialization: Initialization = "xavier-relu"
    learning_rate: float = 2e-4
    num_steps: int = 1000

    def __post_init__(self) -> None:
        require_one_of("initialization", self.initialization, get_args(Initialization))
        require_positive_fields(self, "learning_rate")
        require_fields(self, "num_steps", low=1)


@flax.struct.dataclass
class ToyParams:
    """Parameters of the example.

    Attributes:
        x: value of the direct form.
        net: weights of the network.
        z: input of the network, drawn from a standard normal distribution.
    """

    x: Float[Array, ""]
    net: Any
    z: Float[Array, ""]


def toy_loss(x: Float[AnyArray, "..."]) -> Float[Array, "..."]:
    """Computes L(x) = x^2 / 2 + 5 sin 10x + 20 sin x (supplement D)."""
    x = jnp.asarray(x)
    return 0.5 * x**2 + 5.0 * jnp.sin(10.0 * x) + 20.0 * jnp.sin(x)


def toy_problem(config: ToyConfig) -> Problem:
    """Makes the problem of the example for the engine: no data (None), one phase in one call.

    The terms of a report are x before each step of the call; the poses are x after the call.

    Args:
        config: settings.

    Returns:
        The problem.
    """
    return Problem(config, (config,), _init, _optimizer, _loss, config.num_steps, _poses)


def network_value(config: ToyConfig, params: ToyParams) -> Float[Array, ""]:
    """Computes the output of the network f(z).

    Args:
        config: settings.
        params: parameters with the weights and the input of the network.

    Returns:
        x = f(z).
    """
    return ScalarNet(config.initialization).apply(params.net, params.z)  # type: ignore[return-value]


def _init(config: ToyConfig, key: jax.Array, data: None) -> ToyParams:
    net_key, z_key = jax.random.split(key)
    z = jax.random.normal(z_key)
    params = ToyParams(jnp.zeros(()), ScalarNet(config.initialization).init(net_key, z), z)
    return replace(params, x=network_value(config, params))


def _optimizer(config: ToyConfig, phase: ToyConfig) -> optax.GradientTransformation:
    return optax.sgd(config.learning_rate)


def _loss(
    config: ToyConfig, phase: ToyConfig, params: ToyParams, data: None, step: Array, key: jax.Array
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    x = _poses(config, phase, params, data)
    return toy_loss(x), x


def _poses(config: ToyConfig, phase: ToyConfig, params: ToyParams, data: None) -> Float[Array, ""]:
    return params.x if config.form == "direct" else network_value(config, params)
