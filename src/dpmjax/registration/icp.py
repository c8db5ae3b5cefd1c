"""Iterated closest point for two clouds, planar or spatial: the textbook method, robust and honest about its result."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_points, require_shape
from dpmjax.geometry import rigid, se2, se3
from dpmjax.geometry.alignment import weighted_svd
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.normals import estimate_normals
from dpmjax.types import AnyArray

_NORMAL_NEIGHBOURS = 6
"""Points that a normal is fitted to, as in the published DeepMapping program."""


class IcpResult(NamedTuple):
    """What `icp` found.

    Attributes:
        T_target_source: homogeneous transform of source points into the target's frame.
        rmse: root mean square distance of the inlier pairs: to the point, or to the target's line or plane.
        num_inliers: pairs within three robust deviations.
        converged: the last step was smaller than a millionth of the cloud.
    """

    T_target_source: Float[Array, "d1 d1"]
    rmse: Float[Array, ""]
    num_inliers: Int[Array, ""]
    converged: Bool[Array, ""]


def icp(
    source: Float[AnyArray, "n d"],
    target: Float[AnyArray, "m d"],
    metric: Literal["point", "plane"] = "plane",
    init: Float[AnyArray, "d1 d1"] | None = None,
    *,
    max_iterations: int = 100,
) -> IcpResult:
    """Aligns two clouds from a first guess; planar (d = 2: "plane" means line) or spatial (d = 3).

    Each source point is paired with its nearest target point. Pairs are trusted by a Geman-McClure weight whose scale
    is three times the median distance of the pairs, so that what only one cloud has seen does not pull.

    Args:
        source: finite points.
        target: finite points, same unit.
        metric: distance to the nearest point (Besl and McKay), or to its line or plane (Chen and Medioni).
        init: first guess of T_target_source; None: identity. The basin is about as wide as the structures: some
            degrees.
        max_iterations: at most so many.

    Returns:
        IcpResult. With too few points to fix the motion it stays where the data leave it: near `init`, `converged`
        true.

    Raises:
        ValueError: wrong shapes, not finite, unknown metric, or an empty cloud.
    """
    source = as_points("source", source, dimensions=(2, 3))
    target = as_points("target", target, dimensions=source.shape[1:])
    start = jnp.eye(source.shape[1] + 1) if init is None else as_float("init", init)
    require_shape("init", start, (source.shape[1] + 1, source.shape[1] + 1))
    for name, array in (("source", source), ("target", target), ("init", start)):
        if len(array) == 0 or not bool(jnp.isfinite(array).all()):
            raise ValueError(f"{name}: expected one point or more and finite numbers; leave invalid points out")
    if metric not in ("point", "plane"):
        raise ValueError(f"metric: expected 'point' or 'plane', got {metric!r}")
    target, start = target.astype(source.dtype), start.astype(source.dtype)
    return _icp(source, target, start, jnp.asarray(max_iterations), metric=metric)


@partial(jax.jit, static_argnames="metric")
def _icp(
    source: Float[Array, "n d"], target: Float[Array, "m d"], start: Array, max_iterations: Array, *, metric: str
) -> IcpResult:
    size = jnp.sqrt(jnp.mean(jnp.sum((target - target.mean(0)) ** 2, -1)))
    normals = estimate_normals(target, _NORMAL_NEIGHBOURS)
    # Not below rounding, and its square is no zero: one point, or equal ones, have no size.
    rounding = jnp.finfo(source.dtype).eps * jnp.max(jnp.abs(target))
    tiny = jnp.maximum(jnp.maximum(1e-6 * size, rounding), 1e-12)

    def distances(T: Float[Array, "d1 d1"]) -> tuple[Array, Array, Array, Array]:
        moved = rigid.transform_points(T, source)
        nearest = k_nearest(moved, target, 1).indices[:, 0]
        apart = moved - target[nearest]
        pair_distance = jnp.linalg.norm(apart, axis=-1)
        # A point whose neighbourhood is no line or plane counts by its distance to the point itself.
        has_plane = normals.mask[nearest] & (metric == "plane")
        residual = jnp.where(has_plane, jnp.abs(jnp.sum(apart * normals.normals[nearest], -1)), pair_distance)
        scale = jnp.maximum(3.0 * jnp.median(pair_distance), tiny)
        weight = (scale**2 / (scale**2 + pair_distance**2)) ** 2
        return moved, nearest, residual, jnp.where(pair_distance <= 2.0 * scale, weight, 0.0)

    def iterate(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        T, _, count = carry
        moved, nearest, _, weight = distances(T)
        if metric == "point":
            T = weighted_svd(source, target[nearest], weight)
        else:
            step = _step_to_planes(moved, target[nearest], normals.normals[nearest], weight * normals.mask[nearest])
            T = rigid.compose(step, T)
        change = jnp.linalg.norm(rigid.transform_points(T, source) - moved, axis=-1).max()
        return T, change, count + 1

    begin = start, jnp.asarray(jnp.inf, source.dtype), jnp.asarray(0)
    T, change, _ = jax.lax.while_loop(lambda c: (c[1] > tiny) & (c[2] < max_iterations), iterate, begin)
    residual = distances(T)[2]
    is_inlier = residual <= jnp.maximum(3.0 * 1.4826 * jnp.median(residual), tiny)
    num_inliers = is_inlier.sum()
    rmse = jnp.sqrt(jnp.sum(jnp.where(is_inlier, residual**2, 0.0)) / jnp.maximum(num_inliers, 1))
    return IcpResult(T, rmse, num_inliers, change <= tiny)


def _step_to_planes(
    points: Float[Array, "n d"], matched: Float[Array, "n d"], normals: Float[Array, "n d"], weight: Float[Array, " n"]
) -> Float[Array, "d1 d1"]:
    """The small motion that brings points onto the lines or planes of their partners, about the points' mean."""
    dim = points.shape[1]
    centre = jnp.mean(points, axis=0)
    lever = points - centre
    i, j = np.array([[0], [1]] if dim == 2 else [[1, 2, 0], [2, 0, 1]])
    turning = lever[:, i] * normals[:, j] - lever[:, j] * normals[:, i]
    jacobian = jnp.concatenate([normals, turning], axis=-1)
    residual = jnp.sum((points - matched) * normals, -1)
    weighted = weight[:, None] * jacobian
    system = jnp.einsum("ni,nj->ij", weighted, jacobian, precision="highest")
    diagonal = jnp.diagonal(system)
    # Directions that no plane holds stay as they are.
    damping = 1e-4 * diagonal + 1e-6 * diagonal.max() + jnp.finfo(points.dtype).tiny
    gradient = jnp.einsum("ni,n->i", weighted, residual, precision="highest")
    step = jnp.linalg.solve(system + jnp.diag(damping), -gradient)
    motion = se2.exp(step) if dim == 2 else se3.exp(step)
    about_centre = centre - jnp.matmul(motion[:dim, :dim], centre, precision="highest")
    return motion.at[:dim, dim].add(about_centre)
