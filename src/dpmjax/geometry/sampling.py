"""Choice of points: farthest from each other, one of each voxel, or free space on the beams of a range sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_count, require_positive, require_shape
from dpmjax.geometry.traced import is_usable, typed_jit, with_axes_of
from dpmjax.types import AnyArray


@typed_jit("num_samples")
def farthest_point_sample(
    points: Float[AnyArray, "n d"], num_samples: int, mask: Bool[AnyArray, " n"] | None = None
) -> Int[Array, " s"]:
    """Chooses points, each the farthest from all before it, from the first valid point on.

    Each valid point comes at most once, even where points coincide; of equally far ones the lower index comes first.
    With fewer valid points than samples, the remaining entries repeat the first index; without any valid point, all are
    0. The choice has no derivative.

    Args:
        points: candidates, n >= 1.
        num_samples: number of points to choose.
        mask: False for points that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.

    Returns:
        (num_samples,) int32 rows of the points.

    Raises:
        ValueError: there are no points, the shapes do not match, or `num_samples` is below 1.
    """
    points = as_points("points", points)
    if points.shape[0] == 0:
        raise ValueError("points: expected at least one point to choose from, got none")
    require_count("num_samples", num_samples)
    mask = as_mask("mask", mask, points.shape[:1])
    num_points, dim = points.shape
    mask = mask & is_usable(points)
    cleared = jnp.where(mask[:, None], lax.stop_gradient(points), 0)
    columns = [cleared[:, axis] for axis in range(dim)]
    rows = jnp.arange(num_points, dtype=jnp.int32)
    first = jnp.argmax(mask).astype(jnp.int32)

    # Squared distances are compared as integers: bits of floats that are not negative sort like the floats, and on a
    # CPU only a maximum of integers uses the width of the processor (twelve times faster). -1: out of the race.
    def choose(step: Int[Array, ""], state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        distance_bits, chosen = state
        last = chosen[step - 1]
        to_last = _as_bits(sum((column - column[last]) ** 2 for column in columns))
        distance_bits = jnp.where(rows == last, -1, jnp.minimum(distance_bits, to_last))
        largest = jnp.max(distance_bits)
        farthest = jnp.min(jnp.where(distance_bits == largest, rows, num_points))
        return distance_bits, chosen.at[step].set(jnp.where(largest >= 0, farthest, first))

    unseen = with_axes_of(points, _as_bits(jnp.full(num_points, jnp.inf, points.dtype)))
    chosen = with_axes_of(points, jnp.full(num_samples, first, jnp.int32))
    return lax.fori_loop(1, num_samples, choose, (jnp.where(mask, unseen, -1), chosen))[1]


def voxel_sample(
    points: Float[AnyArray, "n d"], voxel_size: float, mask: Bool[AnyArray, " n"] | None = None
) -> Bool[Array, " n"]:
    """True for the first valid point of each voxel, in the order of the array.

    The voxel of a point is `floor(point / voxel_size)`, computed in the dtype of the points and exact for up to 2^31
    voxels an axis. The shape is that of the input; changing the voxel size does not compile again.

    Args:
        points: the points.
        voxel_size: edge of a voxel, in the unit of the points.
        mask: False for points that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.

    Returns:
        (n,) True for the points that are kept.

    Raises:
        ValueError: the shapes do not match, or `voxel_size` is not above 0.
    """
    points = as_points("points", points)
    require_positive("voxel_size", voxel_size)
    mask = as_mask("mask", mask, points.shape[:1])
    return _voxel_sample(points, mask, jnp.asarray(voxel_size, points.dtype))


def _as_bits(values: jax.Array | int) -> jax.Array:
    values = jnp.asarray(values)
    return lax.bitcast_convert_type(values, f"int{8 * values.dtype.itemsize}")


@jax.jit
def _voxel_sample(
    points: Float[Array, "n d"], mask: Bool[Array, " n"], voxel_size: Float[Array, ""]
) -> Bool[Array, " n"]:
    num_points, dim = points.shape
    mask = mask & is_usable(points)
    voxels = jnp.floor(lax.stop_gradient(points) / voxel_size).astype(jnp.int32)
    # One sort by (valid first, voxel, place in the array): equal voxels stand together, the first one in front.
    columns = [~mask, *(voxels[:, axis] for axis in range(dim)), jnp.arange(num_points, dtype=jnp.int32)]
    is_masked, *sorted_voxels, index = lax.sort(columns, num_keys=dim + 1, is_stable=True)
    is_new = jnp.zeros(num_points, bool).at[:1].set(True)
    for column in sorted_voxels:
        is_new = is_new.at[1:].set(is_new[1:] | (column[1:] != column[:-1]))
    return jnp.zeros(num_points, bool).at[index].set(is_new & ~is_masked)


def sample_free_space(
    origin: Float[AnyArray, " d"], points: Float[AnyArray, "b d"], factors: Float[AnyArray, "*beams s"]
) -> Float[Array, "b s d"]:
    """Points on the segments from the sensor to its hits (DeepMapping section 3.2, figure 3).

    Args:
        origin: the sensor's centre, in the frame and unit of `points`.
        points: where the beams end.
        factors: fractions of the segments, in (0, 1), either (s,) shared by all beams or (b, s) for each beam.

    Returns:
        `origin + factor * (point - origin)` for every beam and factor.

    Raises:
        ValueError: the shapes do not match.
    """
    points = as_points("points", points)
    origin, factors = as_float("origin", origin), as_float("factors", factors)
    num_beams, dim = points.shape
    require_shape("origin", origin, (dim,))
    if factors.ndim not in (1, 2) or (factors.ndim == 2 and factors.shape[0] != num_beams):
        raise ValueError(f"factors: expected shape (s,) or ({num_beams}, s), got {factors.shape}")
    return origin + factors[..., None] * (points - origin)[:, None, :]


def typical_range(points: Float[AnyArray, "n *beams d"], mask: Bool[AnyArray, "n *beams"]) -> float:
    """The range that nine beams in ten of a scan stay below, as the median over the scans.

    Args:
        points: beam end points or pixels, each scan in its own sensor frame.
        mask: True where a beam measured something; scans without any do not count.

    Returns:
        The range, in the unit of the points.

    Raises:
        ValueError: no beam measured anything.
    """
    ranges, mask = np.linalg.norm(np.asarray(points), axis=-1), np.asarray(mask)
    of_scans = [
        np.percentile(beams[is_valid], 90) for beams, is_valid in zip(ranges, mask, strict=True) if is_valid.any()
    ]
    if not of_scans:
        raise ValueError("mask: expected at least one valid beam, got none")
    return float(np.median(of_scans))
