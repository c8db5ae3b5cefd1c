"""The maximum over neighbours of normalised differences: the inner loop of the encoder, with its own backward pass.

The automatic derivative of gather, norm and maximum over (m, k, f) numbers takes fifteen times as long as the value on
a CPU. The forward pass here visits the neighbours in turn, on (m, f) numbers that stay in the cache. The backward pass
handles (m, f) winners and (m, k) pairs, never both at once. The length |x| of each pair is stored. The derivative of
the norm is then a multiple of x = of_points + offset kernel, and its sums over the pairs are sums of numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int

from dpmjax.nets.layers import NORM_EPSILON
from dpmjax.types import AnyArray

# Name of the (m, f) and (m, k) numbers that `jax.checkpoint` stores, to spare a second loop over the neighbours.
WINNERS = "winners"

_UNROLL = 4


class Residuals(NamedTuple):
    """Values for the backward pass: the inputs; for each query and channel the winner and its normalised number; and
    for each pair 1 / |x|.
    """

    of_points: jax.Array
    offsets: jax.Array
    kernel: jax.Array
    neighbours: jax.Array
    scale: jax.Array
    winner: jax.Array
    normalised: jax.Array
    inverse: jax.Array


@jax.custom_vjp
def maximum_of_normalised(
    of_points: Float[Array, "n f"],
    offsets: Float[Array, "m k 3"],
    kernel: Float[Array, "3 f"],
    neighbours: Int[AnyArray, "m k"],
    scale: Float[Array, " f"],
) -> Float[Array, "m f"]:
    """Computes max_j scale * x_ij / |x_ij| with x_ij = of_points_j + offset_ij kernel, of zero mean over channels.

    |x| is the root of the mean square. Where several neighbours are equal, the derivative is that of the first.

    Args:
        of_points: one row for each point that may be a neighbour.
        offsets: offsets from each query to its neighbours, in units of the radius.
        kernel: linear map of the offsets.
        neighbours: rows of `of_points`, at least one for each query.
        scale: factor of each channel, after the norm.

    Returns:
        The maximum over the neighbours, for each query and channel.
    """
    x = _with_offsets(of_points[neighbours], offsets, kernel)
    return jnp.max(x * _inverse_length(x) * scale, axis=1)


def _forward(
    of_points: jax.Array, offsets: jax.Array, kernel: jax.Array, neighbours: jax.Array, scale: jax.Array
) -> tuple[jax.Array, Residuals]:
    neighbours, shape = jnp.asarray(neighbours), (len(neighbours), of_points.shape[1])

    def visit(j: jax.Array, best: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        value, winner, of_winner, inverses = best
        x = _with_offsets(of_points[neighbours[:, j]], offsets[:, j], kernel)
        inverse = _inverse_length(x)
        normalised = x * inverse
        candidate = normalised * scale
        has_won = candidate > value
        return (
            jnp.maximum(value, candidate),
            jnp.where(has_won, j, winner),
            jnp.where(has_won, normalised, of_winner),
            inverses.at[:, j].set(inverse[:, 0]),
        )

    zeros = jnp.zeros(shape, of_points.dtype)
    empty = jnp.zeros(neighbours.shape, of_points.dtype)
    start: tuple[jax.Array, ...] = zeros - jnp.inf, jnp.zeros(shape, jnp.int32), zeros, empty
    # A while loop, because checkpointing splits a loop of known length, and stores values of every iteration.
    num = neighbours.shape[1]
    at_once = max(size for size in range(1, _UNROLL + 1) if num % size == 0)

    def visit_some(state: tuple[jax.Array, tuple[jax.Array, ...]]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        first, best = state
        for j in range(at_once):
            best = visit(first + j, best)
        return first + at_once, best

    _, (_, *found) = lax.while_loop(lambda state: state[0] < num, visit_some, (jnp.zeros((), jnp.int32), start))
    winner, of_winner, inverses = (checkpoint_name(x, WINNERS) for x in found)
    return of_winner * scale, Residuals(of_points, offsets, kernel, neighbours, scale, winner, of_winner, inverses)


def _backward(residuals: Residuals, gradient: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, None, jax.Array]:
    # With g = gradient * scale at the winners and 0 elsewhere, the derivative by x of a pair is
    #     inverse * g - weight * x,   weight = inverse^2 * mean over channels of (g * normalised).
    # The compiler removes unused outputs, such as those to the offsets.
    of_points, offsets, kernel, neighbours, scale, winner, normalised, inverse = residuals
    num_queries, num_channels = winner.shape
    queries, channels = jnp.arange(num_queries)[:, None], jnp.arange(num_channels)
    weighted = gradient * scale
    along = jnp.zeros_like(inverse).at[queries, winner].add(weighted * normalised) / num_channels
    weight = inverse**2 * along
    won = weighted * inverse[queries, winner]
    weighted_offsets = weight[..., None] * offsets
    to_points = jnp.zeros_like(of_points).at[neighbours[queries, winner], channels].add(won)
    weight_of_points = jnp.zeros(len(of_points), weight.dtype).at[neighbours].add(weight)
    offsets_of_points = jnp.zeros((len(of_points), 3), weight.dtype).at[neighbours].add(weighted_offsets)
    to_points -= _with_offsets(weight_of_points[:, None] * of_points, offsets_of_points, kernel)
    to_kernel = jnp.stack([jnp.sum(won * offsets[queries, winner, axis], axis=0) for axis in range(3)])
    squares = _product(weighted_offsets.reshape(-1, 3).T, offsets.reshape(-1, 3))
    to_kernel -= _product(offsets_of_points.T, of_points) + _product(squares, kernel)
    of_x = _product(of_points, kernel.T)[neighbours] + _product(offsets, _product(kernel, kernel.T))
    to_offsets = jnp.zeros_like(offsets).at[queries, winner].add(won[..., None] * kernel.T)
    to_offsets -= weight[..., None] * of_x
    return to_points, to_offsets, to_kernel, None, jnp.sum(gradient * normalised, axis=0)


def _with_offsets(
    of_points: Float[Array, "... f"], offsets: Float[Array, "... 3"], kernel: Float[Array, "3 f"]
) -> Float[Array, "... f"]:
    # Three separate products fuse with the operations after them; a matrix product would be written out first.
    for axis in range(3):
        of_points = of_points + offsets[..., axis, None] * kernel[axis]
    return of_points


def _product(a: Float[Array, "... k"], b: Float[Array, "k n"]) -> Float[Array, "... n"]:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def _inverse_length(x: Float[Array, "... f"]) -> Float[Array, "... 1"]:
    return lax.rsqrt(jnp.mean(x**2, axis=-1, keepdims=True) + NORM_EPSILON)


maximum_of_normalised.defvjp(_forward, _backward)
