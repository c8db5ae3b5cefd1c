"""The maximum over neighbours of normalised differences: the inner loop of the encoder, with its own backward pass.

The automatic derivative of gather, norm and maximum over (m, k, f) numbers takes fifteen times as long as the value on
a CPU. Both passes here visit one neighbour after the other, on (m, f) numbers that stay in the cache.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from dpmjax.nets.layers import NORM_EPSILON
from dpmjax.types import AnyArray

_UNROLL = 4

Residuals = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


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
        offsets: from each query to its neighbours, in units of the radius.
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

    def look_at(j: jax.Array, best: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        value, winner = best
        x = _with_offsets(of_points[neighbours[:, j]], offsets[:, j], kernel)
        candidate = x * _inverse_length(x) * scale
        return jnp.maximum(value, candidate), jnp.where(candidate > value, j, winner)

    start = jnp.full(shape, -jnp.inf, of_points.dtype), jnp.zeros(shape, jnp.int32)
    value, winner = lax.fori_loop(0, neighbours.shape[1], look_at, start, unroll=_UNROLL)
    return value, (of_points, offsets, kernel, neighbours, scale, winner)


def _backward(residuals: Residuals, gradient: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, None, jax.Array]:
    of_points, offsets, kernel, neighbours, scale, winner = residuals
    weighted = gradient * scale

    def pass_to(j: jax.Array, sums: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        to_points, to_offsets, to_kernel, to_scale = sums
        rows = neighbours[:, j]
        x = _with_offsets(of_points[rows], offsets[:, j], kernel)
        inverse = _inverse_length(x)
        normalised = x * inverse
        has_won = winner == j
        won = jnp.where(has_won, weighted, 0)
        # The component along x only changes its length, which the norm removes.
        along = jnp.mean(won * normalised, axis=-1, keepdims=True)
        share = inverse * (won - normalised * along)
        return (
            to_points.at[rows].add(share),
            to_offsets.at[:, j].set(_product(share, kernel.T)),
            to_kernel + _product(offsets[:, j].T, share),
            to_scale + jnp.where(has_won, gradient * normalised, 0),
        )

    zeros = tuple(jnp.zeros_like(x) for x in (of_points, offsets, kernel, gradient))
    sums = lax.fori_loop(0, neighbours.shape[1], pass_to, zeros, unroll=_UNROLL)
    to_points, to_offsets, to_kernel, to_scale = sums
    return to_points, to_offsets, to_kernel, None, jnp.sum(to_scale, axis=0)


def _with_offsets(
    of_points: Float[Array, "... f"], offsets: Float[Array, "... 3"], kernel: Float[Array, "3 f"]
) -> Float[Array, "... f"]:
    # Three separate products fuse with the operations after them; a matrix product would be written out first.
    for axis in range(3):
        of_points = of_points + offsets[..., axis, None] * kernel[axis]
    return of_points


def _product(a: Float[Array, "m k"], b: Float[Array, "k n"]) -> Float[Array, "m n"]:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def _inverse_length(x: Float[Array, "... f"]) -> Float[Array, "... 1"]:
    return lax.rsqrt(jnp.mean(x**2, axis=-1, keepdims=True) + NORM_EPSILON)


maximum_of_normalised.defvjp(_forward, _backward)
