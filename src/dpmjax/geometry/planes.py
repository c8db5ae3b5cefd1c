"""Planes: fits to neighbourhoods, and one step of point-to-plane alignment, for arrays of NumPy and of JAX."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.geometry import rigid
from dpmjax.types import AnyArray

# Derivatives of a rotation matrix by the three components of a small rotation vector.
GENERATORS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)


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
        is_near: True for neighbours that count; at least one of each point.

    Returns:
        Normals and flatness.
    """
    # Sums of products, because a contraction of JAX has a lower precision on some devices.
    xp, tiny = rigid.namespace_of(xyz[0]), np.finfo(xyz[0].dtype).tiny
    counts = is_near.sum(axis=1).astype(xyz[0].dtype)
    centred = []
    for column in xyz:
        kept = xp.where(is_near, column, 0.0)
        centred.append((kept - (kept.sum(axis=1) / counts)[:, None]) * is_near)
    xx, xy, xz, yy, yz, zz = ((centred[i] * centred[j]).sum(axis=1) / counts for i in range(3) for j in range(i, 3))
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


def _kernels(*matrix_and_value: Float[AnyArray, " n"]) -> Any:
    """Returns the eigenvectors of symmetric matrices, given by their upper triangles, to an eigenvalue each.

    The rows of the matrix less the eigenvalue span a plane; the longest cross product of two of them is taken.
    """
    xx, xy, xz, yy, yz, zz, value = matrix_and_value
    xp = rigid.namespace_of(xx)
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


class PlaneStep(NamedTuple):
    """A small motion about a centre; arrays of the kind and dtype of the points, k is 3 in the plane and 6 in space.

    Attributes:
        tangent: (..., k) translation, then rotation.
        centre: (..., d) centre of the rotation.
    """

    tangent: Any
    centre: Any


def geman_mcclure(residuals: Float[AnyArray, "*p"], width: Any) -> Any:
    """Computes the weights of the Geman-McClure kernel, in (0, 1].

    Args:
        residuals: metres.
        width: residual of the weight 1/4, metres.

    Returns:
        Weights of the kind of the residuals.
    """
    return (width**2 / (width**2 + residuals**2)) ** 2


def step_to_planes(
    points: Float[AnyArray, "*b n d"],
    normals: Float[AnyArray, "*b n d"],
    residuals: Float[AnyArray, "*b n"],
    weights: Float[AnyArray, "*b n"],
) -> PlaneStep:
    """Solves the weighted normal equations of point-to-plane alignment (Chen and Medioni 1992), d = 2 or 3.

    The step is that of `T <- motion_about(step) T`. A direction that no plane constrains does not move.

    Args:
        points: points where the moved side and the fixed planes are compared, in the fixed frame.
        normals: normals of the planes, same frame.
        residuals: signed distances of the moved side to the fixed one, along the normals.
        weights: weights of the pairs; all arrays must be finite, also where a weight is 0.

    Returns:
        The step, 0 where no pair counts.
    """
    xp = rigid.namespace_of(points)
    counted = (weights > 0).astype(points.dtype)
    count = xp.maximum(counted.sum(axis=-1), 1)[..., None]
    centre = rigid.matmul(counted[..., None, :], points)[..., 0, :] / count
    jacobian = xp.concatenate([xp.swapaxes(normals, -1, -2), _torques(points - centre[..., None, :], normals)], axis=-2)
    weighted = weights[..., None, :] * jacobian
    system, gradient = (
        rigid.matmul(weighted, xp.swapaxes(jacobian, -1, -2)),
        rigid.matmul(weighted, residuals[..., None]),
    )
    diagonal = xp.diagonal(system, axis1=-2, axis2=-1)
    floor = max(1e-9, float(np.finfo(points.dtype).eps)) * diagonal.sum(axis=-1, keepdims=True)
    damping = 1e-6 * diagonal + floor + np.finfo(points.dtype).tiny
    tangent = -xp.linalg.solve(system + damping[..., None] * np.eye(system.shape[-1], dtype=points.dtype), gradient)
    return PlaneStep(tangent[..., 0], centre)


def _torques(levers: Any, forces: Any) -> Any:
    """Returns cross products (..., 1, n) in the plane, (..., 3, n) in space, of vectors (..., n, d)."""
    xp, dim = rigid.namespace_of(levers, forces), levers.shape[-1]
    axes = [(0, 1)] if dim == 2 else [(1, 2), (2, 0), (0, 1)]
    return xp.stack([levers[..., i] * forces[..., j] - levers[..., j] * forces[..., i] for i, j in axes], axis=-2)


def motion_about(step: PlaneStep) -> Any:
    """Makes the motion of a step: a rotation about its centre, then its translation.

    Args:
        step: result of `step_to_planes`.

    Returns:
        (..., d+1, d+1) homogeneous matrices of the kind of the step; the derivative is right at the zero step too.
    """
    tangent, centre = step
    xp, dim = rigid.namespace_of(tangent), centre.shape[-1]
    squared = (tangent[..., dim:] ** 2).sum(axis=-1)
    is_turned = squared > 0
    angle = xp.where(is_turned, xp.sqrt(xp.where(is_turned, squared, 1)), 0)[..., None, None]
    generators = GENERATORS.astype(tangent.dtype) if dim == 3 else GENERATORS[2:, :2, :2].astype(tangent.dtype)
    cross = (tangent[..., dim:, None, None] * generators).sum(axis=-3)
    # Rodrigues; sinc(t) is sin(pi t) / (pi t), and half the square of sinc(t / 2) is (1 - cos) / angle^2.
    turn = xp.sinc(angle / np.pi) * cross + xp.sinc(angle / (2 * np.pi)) ** 2 / 2 * rigid.matmul(cross, cross)
    translation = tangent[..., :dim] - rigid.matmul(turn, centre[..., None])[..., 0]
    top = xp.concatenate([turn + np.eye(dim, dtype=tangent.dtype), translation[..., None]], axis=-1)
    last = xp.broadcast_to(np.eye(dim + 1, dtype=tangent.dtype)[dim:], (*tangent.shape[:-1], 1, dim + 1))
    return xp.concatenate([top, last], axis=-2)
