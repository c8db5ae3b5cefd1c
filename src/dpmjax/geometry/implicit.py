"""Derivatives of solutions by the implicit function theorem (Blondel et al. 2022, section 2.1)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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
