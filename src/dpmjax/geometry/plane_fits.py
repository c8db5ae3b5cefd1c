"""Planes through the neighbourhoods of many points at once, for arrays of NumPy and of JAX."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dpmjax.types import AnyArray


class PlaneFits(NamedTuple):
    """The plane of each neighbourhood, in arrays of the kind and dtype of the coordinates.

    Attributes:
        normals: (n, 3) unit vectors along which the neighbours spread least, either side; any where all directions are
            alike, and 0 where fewer than two neighbours differ.
        flatness: (n,) in [0, 1]: (l2 - l1) / l3 of the eigenvalues of the covariance, smallest first.
    """

    normals: Any
    flatness: Any


Columns = tuple[Float[AnyArray, "n k"], Float[AnyArray, "n k"], Float[AnyArray, "n k"]]


def fit_planes(xyz: Columns, is_near: Bool[AnyArray, "n k"]) -> PlaneFits:
    """Fits a plane to each neighbourhood.

    The eigenvalues of the 3 x 3 covariances are the roots of their characteristic polynomial in closed form (Smith
    1961), eight times faster than an iteration over so small matrices.

    Args:
        xyz: coordinates of k neighbours of n points, relative to each point, metres; any where `is_near` is False.
        is_near: which neighbours count; at least one of each point.

    Returns:
        Normals and flatness.
    """
    xp, tiny = _array_module(xyz[0]), np.finfo(xyz[0].dtype).tiny
    counts = is_near.sum(axis=1)
    centred = []
    for column in xyz:
        kept = xp.where(is_near, column, 0.0)
        centred.append((kept - (kept.sum(axis=1) / counts)[:, None]) * is_near)
    xx, xy, xz, yy, yz, zz = (_dots(centred[i], centred[j]) / counts for i in range(3) for j in range(i, 3))
    mean = (xx + yy + zz) / 3
    off_diagonal = xy**2 + xz**2 + yz**2
    radius = xp.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off_diagonal) / 6)
    safe = xp.maximum(radius, tiny)
    a, b, c, d, e, f = (xx - mean) / safe, xy / safe, xz / safe, (yy - mean) / safe, yz / safe, (zz - mean) / safe
    angle = xp.arccos(xp.clip((a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)) / 2, -1, 1)) / 3
    largest, smallest = mean + 2 * radius * xp.cos(angle), mean + 2 * radius * xp.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - largest - smallest
    flatness = xp.clip((middle - smallest) / xp.maximum(largest, tiny), 0, 1)
    return PlaneFits(_kernels(a, b, c, d, e, f, 2 * xp.cos(angle + 2 * np.pi / 3)), flatness)


def _array_module(array: AnyArray) -> Any:
    return jnp if isinstance(array, jax.Array) else np


def _dots(first: Float[AnyArray, "n k"], second: Float[AnyArray, "n k"]) -> Any:
    # JAX would make a contraction of it, at lower precision on some devices.
    return jnp.sum(first * second, axis=1) if isinstance(first, jax.Array) else np.einsum("nk,nk->n", first, second)


def _kernels(*matrix_and_value: Float[AnyArray, " n"]) -> Any:
    """Returns the eigenvectors of symmetric matrices, given by their upper triangles, to an eigenvalue each.

    The rows of the matrix less the eigenvalue span a plane; the longest cross product of two of them is taken.
    """
    xx, xy, xz, yy, yz, zz, value = matrix_and_value
    xp = _array_module(xx)
    a, d, f = xx - value, yy - value, zz - value
    products = xp.stack(
        [
            xp.stack([xy * yz - xz * d, xz * xy - a * yz, a * d - xy * xy]),
            xp.stack([d * f - yz * yz, yz * xz - xy * f, xy * yz - xz * d]),
            xp.stack([xz * yz - xy * f, a * f - xz * xz, xy * xz - a * yz]),
        ]
    )
    squared = (products**2).sum(axis=1)
    rows = np.arange(len(value))
    longest = xp.argmax(squared, axis=0)
    lengths = xp.sqrt(xp.maximum(squared[longest, rows], np.finfo(xx.dtype).tiny))
    return products[longest, :, rows] / lengths[:, None]
