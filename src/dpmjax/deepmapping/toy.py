"""Why DeepMapping optimises a network instead of the poses, in one dimension (DeepMapping supplement D, figure 14).

The same function is minimised twice by plain gradient descent from the same start: over x, and over the weights and
the input of a network whose output is x. Everything is for one seed; `vmap` over keys.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import jaxopt
import numpy as np
from jaxtyping import Array, Float

from dpmjax.nets.scalar import ScalarNet, ScalarNetConfig
from dpmjax.types import AnyArray


@dataclass(frozen=True)
class ToyConfig:
    """Settings of the example; the defaults are the paper's.

    Attributes:
        net: the network.
        learning_rate: of gradient descent, in both forms.
        num_steps: of both forms.
    """

    net: ScalarNetConfig = field(default_factory=ScalarNetConfig)
    learning_rate: float = 2e-4
    num_steps: int = 1000

    def __post_init__(self) -> None:
        if not self.learning_rate > 0.0:
            raise ValueError(f"learning_rate: expected a number above 0, got {self.learning_rate}")
        if self.num_steps < 1:
            raise ValueError(f"num_steps: expected at least 1, got {self.num_steps}")


class NetworkStart(NamedTuple):
    """Where the network form starts.

    Attributes:
        params: weights of the network.
        z: its input, drawn from a standard normal distribution.
    """

    params: Any
    z: Float[Array, ""]


class Descent(NamedTuple):
    """One descent.

    Attributes:
        x: values of x from the start to the end, num_steps + 1.
        params: weights at the end; None in the direct form.
        z: input of the network at the end; None in the direct form.
    """

    x: Float[Array, " t"]
    params: Any = None
    z: Float[Array, ""] | None = None


def toy_loss(x: Float[AnyArray, "..."]) -> Float[Array, "..."]:
    """L(x) = x^2 / 2 + 5 sin 10x + 20 sin x (supplement D)."""
    x = jnp.asarray(x)
    return 0.5 * x**2 + 5.0 * jnp.sin(10.0 * x) + 20.0 * jnp.sin(x)


def global_minimum() -> tuple[float, float]:
    """Where L is smallest, and its value there: (-1.417, -23.757), in float64.

    Beyond |x| = 12 the parabola alone is above 47, more than the smallest value plus both amplitudes.
    """
    x = np.linspace(-12.0, 12.0, 240_001)
    loss = 0.5 * x**2 + 5.0 * np.sin(10.0 * x) + 20.0 * np.sin(x)
    best = float(x[np.argmin(loss)])
    for _ in range(5):
        slope = best + 50.0 * np.cos(10.0 * best) + 20.0 * np.cos(best)
        best -= slope / (1.0 - 500.0 * np.sin(10.0 * best) - 20.0 * np.sin(best))
    return float(best), float(0.5 * best**2 + 5.0 * np.sin(10.0 * best) + 20.0 * np.sin(best))


def init_toy(key: jax.Array, config: ToyConfig) -> NetworkStart:
    """Fresh weights and input."""
    params_key, z_key = jax.random.split(key)
    z = jax.random.normal(z_key)
    return NetworkStart(ScalarNet(config.net).init(params_key, z), z)


def network_value(start: NetworkStart, config: ToyConfig) -> Float[Array, ""]:
    """The output f(z) = x: where the direct form starts, so that both start alike."""
    return ScalarNet(config.net).apply(start.params, start.z)  # type: ignore[return-value]


def descend_network(start: NetworkStart, config: ToyConfig) -> Descent:
    """Gradient descent on weights and input of the network together."""

    def loss_of(at: NetworkStart) -> tuple[Array, Array]:
        x = network_value(at, config)
        return toy_loss(x), x

    def step(at: NetworkStart, _: None) -> tuple[NetworkStart, Array]:
        gradient, x = jax.grad(loss_of, has_aux=True)(at)
        return jax.tree.map(lambda value, slope: value - config.learning_rate * slope, at, gradient), x

    end, x = jax.lax.scan(step, start, None, length=config.num_steps)
    return Descent(jnp.append(x, network_value(end, config)), end.params, end.z)


def descend_direct(x0: Float[Array, ""], config: ToyConfig) -> Descent:
    """Gradient descent on x itself."""

    def step(x: Array, _: None) -> tuple[Array, Array]:
        return x - config.learning_rate * jax.grad(toy_loss)(x), x

    end, x = jax.lax.scan(step, x0, None, length=config.num_steps)
    return Descent(jnp.append(x, end))


def minimize_direct(
    x0: Float[Array, ""], method: Literal["gradient-descent", "lbfgs", "bfgs"], *, max_iterations: int = 1000
) -> Float[Array, ""]:
    """The direct form by a solver of jaxopt with its own line search.

    Args:
        x0: where to start.
        method: "gradient-descent" (with line search and momentum), "lbfgs" or "bfgs".
        max_iterations: at most so many.

    Returns:
        Where the solver ends.

    Raises:
        ValueError: the method is unknown.
    """
    solvers = {"gradient-descent": jaxopt.GradientDescent, "lbfgs": jaxopt.LBFGS, "bfgs": jaxopt.BFGS}
    if method not in solvers:
        raise ValueError(f"method: expected one of {', '.join(solvers)}, got {method!r}")
    return solvers[method](fun=toy_loss, maxiter=max_iterations).run(x0).params
