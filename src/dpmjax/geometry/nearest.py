"""The nearest point alone, fast enough for the inner loop of an optimisation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def nearest_index(
    queries: Float[Array, "m d"], points: Float[Array, "n d"], mask: Bool[Array, " n"] | None = None
) -> Int[Array, " m"]:
    """Row of the nearest point of each query, by exhaustive search.

    An `argmin` walks through the distances one by one; a plain minimum of integers uses the whole width of the processor.
    So the row number replaces the last bits of each squared distance (positive floats sort like integers), and one
    integer minimum finds both. Distances that agree in all but those bits (log2(n) of the 23 of a float32: 3e-5
    relative for 256 points) count as equal, and the lower row wins: no matter for a loss, which measures the distance
    to the chosen point again. Where that matters, `k_nearest` is exact.

    Args:
        queries: float32, where to search, in the frame and unit of `points`.
        points: float32, what is searched; at most 2^20 rows.
        mask: False for points that are not there. If none is there every index is 0.

    Returns:
        Indices (m,), int32; not differentiable.
    """
    queries, points = jax.lax.stop_gradient((queries, points))
    num_points = points.shape[0]
    low_bits = (1 << (num_points - 1).bit_length()) - 1
    rows = jnp.arange(num_points, dtype=jnp.int32)
    squared = sum((queries[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(points.shape[1]))
    packed = (jax.lax.bitcast_convert_type(squared.astype(jnp.float32), jnp.int32) & ~low_bits) | rows
    if mask is not None:
        packed = jnp.where(mask, packed, jnp.iinfo(jnp.int32).max)
        return jnp.where(mask.any(), packed.min(-1) & low_bits, 0)
    return packed.min(-1) & low_bits
