"""One step of point-to-plane alignment on given pairs, for arrays of NumPy and of JAX."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.types import AnyArray


class PlaneStep(NamedTuple):
    """A small motion about a centre; arrays of the kind and dtype of the points.

    Attributes:
        tangent: (..., 6) translation, then rotation vector.
        centre: (..., 3) centre of the rotation.
    """

    tangent: Any
    centre: Any


def geman_mcclure(residuals: Float[AnyArray, "*p"], width: float) -> Any:
    """Computes the weights of the Geman-McClure kernel, in (0, 1].

    Args:
        residuals: metres.
        width: residual of the weight 1/4, metres.

    Returns:
        Weights of the kind of the residuals.
    """
    return (width**2 / (width**2 + residuals**2)) ** 2


def step_to_planes(
    points: Float[AnyArray, "*b n 3"],
    normals: Float[AnyArray, "*b n 3"],
    residuals: Float[AnyArray, "*b n"],
    weights: Float[AnyArray, "*b n"],
) -> PlaneStep:
    """Solves the weighted normal equations of point-to-plane alignment (Chen and Medioni 1992).

    The step is that of `T <- motion_about(step) T`. A direction that no plane constrains does not move.

    Args:
        points: points where the moved side and the fixed planes are compared, in the fixed frame.
        normals: of the planes, same frame.
        residuals: signed distances of the moved side to the fixed one, along the normals.
        weights: weights of the pairs; the other arrays must be finite where a weight is 0 too.

    Returns:
        The step; 0 where no pair counts.
    """
    xp = jnp if isinstance(points, jax.Array) else np
    counted = (weights > 0).astype(points.dtype)
    count = xp.maximum(counted.sum(axis=-1), 1)[..., None]
    centre = _matmul(counted[..., None, :], points)[..., 0, :] / count
    levers = points - centre[..., None, :]
    (lx, ly, lz), (nx, ny, nz) = (xp.moveaxis(vectors, -1, 0) for vectors in (levers, normals))
    jacobian = xp.stack([nx, ny, nz, ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx], axis=-2)
    weighted = weights[..., None, :] * jacobian
    system = _matmul(weighted, xp.swapaxes(jacobian, -1, -2))
    diagonal = xp.diagonal(system, axis1=-2, axis2=-1)
    floor = max(1e-9, float(np.finfo(points.dtype).eps)) * diagonal.sum(axis=-1, keepdims=True)
    damping = 1e-6 * diagonal + floor + np.finfo(points.dtype).tiny
    gradient = _matmul(weighted, residuals[..., None])
    tangent = -xp.linalg.solve(system + damping[..., None] * np.eye(6, dtype=points.dtype), gradient)[..., 0]
    return PlaneStep(tangent, centre)


def motion_about(step: PlaneStep) -> Any:
    """Makes the motion of a step: a rotation about its centre, then its translation.

    Args:
        step: from `step_to_planes`.

    Returns:
        (..., 4, 4) homogeneous matrices of the kind of the step; the derivative is right at the zero step too.
    """
    tangent, centre = step
    xp = jnp if isinstance(tangent, jax.Array) else np
    x, y, z = xp.moveaxis(tangent[..., 3:], -1, 0)
    squared = (tangent[..., 3:] ** 2).sum(axis=-1)
    is_turned = squared > 0
    angle = xp.where(is_turned, xp.sqrt(xp.where(is_turned, squared, 1)), 0)[..., None, None]
    zero = xp.zeros_like(x)
    rows = ([zero, -z, y], [z, zero, -x], [-y, x, zero])
    cross = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)
    # Rodrigues; sinc(t) is sin(pi t) / (pi t), and half the square of sinc(t / 2) is (1 - cos) / angle^2.
    turn = xp.sinc(angle / np.pi) * cross + xp.sinc(angle / (2 * np.pi)) ** 2 / 2 * _matmul(cross, cross)
    translation = tangent[..., :3] - _matmul(turn, centre[..., None])[..., 0]
    top = xp.concatenate([turn + np.eye(3, dtype=tangent.dtype), translation[..., None]], axis=-1)
    last = xp.broadcast_to(np.array([0, 0, 0, 1], tangent.dtype), (*tangent.shape[:-1], 1, 4))
    return xp.concatenate([top, last], axis=-2)


def _matmul(first: Any, second: Any) -> Any:
    return jnp.matmul(first, second, precision="highest") if isinstance(first, jax.Array) else first @ second
