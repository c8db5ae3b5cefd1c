"""The maximum over neighbours of normalised differences: the inner loop of the encoder, with its own derivative.

The automatic derivative of gather, norm and maximum over (m, k, f) numbers takes fifteen times as long as the value on
a CPU. Here a loop over the neighbours computes the value for a derivative, on (m, f) numbers that stay in the cache.
The derivative handles (m, f) winners and (m, k) pairs, never both at once. The length |x| of each pair is stored, where
x = of_points + offset kernel. Its derivative is a mean of products of x, which is a sum of a few numbers for each point
and each pair. The rule is linear in the tangents, so JAX makes the backward pass from it.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from dpmjax.geometry.traced import with_axes_of
from dpmjax.nets.layers import NORM_EPSILON
from dpmjax.types import AnyArray

# Name of the (m, f) and (m, k) numbers that `jax.checkpoint` stores, to spare a second loop over the neighbours.
WINNERS = "winners"

_UNROLL = 4


@jax.custom_jvp
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


@functools.partial(maximum_of_normalised.defjvp, symbolic_zeros=True)
def _maximum_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    # With n = x / |x| of the winners: dn = (dx - n * mean over channels of (x . dx) / |x|) / |x|.
    of_points, offsets, kernel, neighbours, scale = primals
    to_points, to_offsets, to_kernel, _, to_scale = (
        None if isinstance(tangent, SymbolicZero) else tangent for tangent in tangents
    )
    winner, normalised, inverse = _winners(of_points, offsets, kernel, jnp.asarray(neighbours), scale)
    won = jnp.arange(len(winner))[:, None], winner
    # Parts of x . dx that are one number for each point, that are one vector for each point, and of pairs.
    products: list[jax.Array] = []
    vectors: list[jax.Array] = []
    of_pairs: list[jax.Array] = []
    change: list[jax.Array] = []
    if to_points is not None:
        products.append(jnp.sum(of_points * to_points, axis=1))
        vectors.append(_product(to_points, kernel.T))
        change.append(to_points[neighbours[won], jnp.arange(winner.shape[1])])
    if to_kernel is not None:
        vectors.append(_product(of_points, to_kernel.T))
        of_pairs.append(_dots(_product(offsets, _product(kernel, to_kernel.T)), offsets))
        change += [offsets[*won, axis] * to_kernel[axis] for axis in range(3)]
    if to_offsets is not None:
        x_kernel = _product(of_points, kernel.T)[neighbours] + _product(offsets, _product(kernel, kernel.T))
        of_pairs.append(_dots(x_kernel, to_offsets))
        change += [to_offsets[*won, axis] * kernel[axis] for axis in range(3)]
    if products:
        of_pairs.append(_sum(products)[neighbours])
    if vectors:
        of_pairs.append(_dots(offsets, _sum(vectors)[neighbours]))
    tangent = jnp.zeros_like(normalised) if to_scale is None else normalised * to_scale
    if change:
        shrink = inverse**2 * _sum(of_pairs) / winner.shape[1]
        tangent = tangent + scale * (inverse[won] * _sum(change) - normalised * shrink[won])
    return normalised * scale, tangent


def _sum(parts: list[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, parts)


def _dots(first: Float[Array, "m k 3"], second: Float[Array, "m k 3"]) -> Float[Array, "m k"]:
    return jnp.sum(first * second, axis=-1)


def _winners(
    of_points: Float[Array, "n f"],
    offsets: Float[Array, "m k 3"],
    kernel: Float[Array, "3 f"],
    neighbours: Int[Array, "m k"],
    scale: Float[Array, " f"],
) -> tuple[Int[Array, "m f"], Float[Array, "m f"], Float[Array, "m k"]]:
    """Returns the winner of each query and channel, its normalised number, and 1 / |x| of each pair."""

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

    num, shape = neighbours.shape[1], (len(neighbours), of_points.shape[1])
    dtype = jnp.result_type(of_points, offsets, kernel)
    zeros = with_axes_of((of_points, offsets, kernel, neighbours, scale), jnp.zeros(shape, dtype))
    lowest = zeros.astype(jnp.result_type(dtype, scale)) - jnp.inf
    inverses = jnp.broadcast_to(zeros[:, :1], (len(neighbours), num))
    start: tuple[jax.Array, ...] = lowest, zeros.astype(jnp.int32), zeros, inverses
    # A while loop, because checkpointing splits a loop of known length, and stores values of every iteration.
    at_once = max(size for size in range(1, _UNROLL + 1) if num % size == 0)

    def visit_some(state: tuple[jax.Array, tuple[jax.Array, ...]]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        first, best = state
        for j in range(at_once):
            best = visit(first + j, best)
        return first + at_once, best

    _, (_, *found) = lax.while_loop(lambda state: state[0] < num, visit_some, (jnp.zeros((), jnp.int32), start))
    winner, of_winner, inverses = (checkpoint_name(x, WINNERS) for x in found)
    return winner, of_winner, inverses


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
