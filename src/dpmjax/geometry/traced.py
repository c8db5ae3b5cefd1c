"""Rules of all kernels inside a traced program: which points and weights count, and how a loop starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dpmjax.types import AnyArray

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

# Sums of ten million squares of such numbers stay below the largest float32, 3.4e38.
LARGEST_COORDINATE = 1e15


def typed_jit(*static_argnames: str) -> Callable[[Kernel], Kernel]:
    """Compiles a kernel as `jax.jit` does; type checkers know its arguments and its result.

    Args:
        *static_argnames: names of the static arguments.

    Returns:
        The decorator.
    """

    def compile_kernel(kernel: Kernel) -> Kernel:
        return cast(Kernel, jax.jit(kernel, static_argnames=static_argnames))

    return compile_kernel


def is_usable(points: Float[AnyArray, "*n d"]) -> Bool[Array, "*n"]:
    """Returns True for points that count: all coordinates are numbers between -1e15 and 1e15.

    Args:
        points: any points.

    Returns:
        False for NaN, infinity and larger numbers.
    """
    return jnp.all(jnp.abs(points) <= LARGEST_COORDINATE, axis=-1)


def usable_weights(weights: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns weights relative to the largest one, without its derivative; only ratios of weights count.

    Args:
        weights: any numbers. One that is NaN, infinite or not above 0 counts as 0; so does one below the smallest
            normal number (1.2e-38 in float32), which processors may take as 0.

    Returns:
        Numbers from 0 to 1; the largest is 1 if one weight counts.
    """
    is_counted = (weights >= jnp.finfo(weights.dtype).tiny) & (weights < jnp.inf)
    weights = jnp.where(is_counted, weights, 0)
    largest = jax.lax.stop_gradient(jnp.max(weights, initial=0))
    return weights / jnp.where(largest > 0, largest, 1)


def with_axes_of(data: Any, start: Array) -> Array:
    """Returns the start of a loop as a number that depends on the data, though its value does not.

    `jax.shard_map` demands that the carry of a loop varies over the same devices before and after a step.

    Args:
        data: arrays that a step of the loop reads.
        start: a constant.

    Returns:
        `start`.
    """
    nothing = sum(jnp.sum(leaf.reshape(-1)[:0], dtype=jnp.int32) for leaf in jax.tree.leaves(data))
    return start + jnp.asarray(nothing, start.dtype)


def solution_tangent(
    balance: Callable[..., Float[Array, " k"]],
    data: tuple[Array, ...],
    tangents: tuple[Array, ...],
    *,
    num_unknowns: int,
    open_share: float,
) -> Float[Array, " k"]:
    """Returns the step by which a solution moves when the data move.

    The balance b(step, data) is zero at the solution, before and after the data have moved:
    d step = -(db / dstep)^-1 (db / ddata) ddata. Directions that the balance leaves open do not move.

    Args:
        balance: function of a step of the unknowns and of the data; zero at the solution, where the step is zero.
        data: the arguments of `balance` after the step, float arrays of JAX.
        tangents: their tangents.
        num_unknowns: k.
        open_share: share of the largest singular value of the balance's derivative below which a direction is open.

    Returns:
        The tangent of the step.
    """
    still = jnp.zeros(num_unknowns, jnp.result_type(*data))
    fixed = jax.tree.map(jnp.zeros_like, data)
    _, push = jax.linearize(balance, still, *data)
    derivative = jax.vmap(lambda step: push(step, *fixed))(jnp.eye(num_unknowns, dtype=still.dtype)).T
    change = push(still, *tangents)
    return -jnp.matmul(jnp.linalg.pinv(derivative, rtol=open_share), change, precision="highest")
