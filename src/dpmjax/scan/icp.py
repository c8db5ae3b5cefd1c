"""Iterative closest point for two clouds, planar or spatial, with robust weights."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dpmjax.checks import as_float, as_mask, as_points, require_shape
from dpmjax.geometry import rigid
from dpmjax.geometry.alignment import weighted_svd
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.normals import estimate_normals
from dpmjax.geometry.planes import PlaneStep, motion_about, step_to_planes
from dpmjax.geometry.rigid import safe_sqrt
from dpmjax.geometry.traced import is_usable, solution_tangent, with_axes_of
from dpmjax.types import AnyArray, with_short_repr

_NORMAL_NEIGHBOURS = 6
"""Points that a normal is fitted to, as in the published DeepMapping program."""

_MAX_ITERATIONS = 100
_MAX_DISTANCE = 1e4
"""Largest coordinate as a multiple of the extent of a cloud, of which float32 then holds a thousandth."""
_OPEN_SHARE = 1e-5
"""Share of the largest singular value of the balance's derivative below which a direction counts as unconstrained."""


@with_short_repr
class IcpResult(NamedTuple):
    """Result of `icp`.

    Attributes:
        T_target_source: homogeneous transform of source points into the target's frame.
        rmse: root mean square distance of the inlier pairs, to the point, or to the target's line or plane. Infinite
            without inliers.
        num_inliers: number of pairs within three robust deviations.
        converged: True if the last step was smaller than a millionth of the cloud.
    """

    T_target_source: Float[Array, "d1 d1"]
    rmse: Float[Array, ""]
    num_inliers: Int[Array, ""]
    converged: Bool[Array, ""]


def icp(
    source: Float[AnyArray, "n d"],
    target: Float[AnyArray, "m d"],
    metric: Literal["point", "plane"] = "plane",
    T_init: Float[AnyArray, "d1 d1"] | None = None,
    source_mask: Bool[AnyArray, " n"] | None = None,
    target_mask: Bool[AnyArray, " m"] | None = None,
) -> IcpResult:
    """Aligns two clouds from an initial transform; planar (d = 2: "plane" means line) or spatial (d = 3).

    Each source point is paired with its nearest target point. The pairs have Geman-McClure weights, whose scale is
    three times the median distance of the pairs, so that points outside the overlap have little weight. The loop ends
    after up to 100 iterations.

    The gradient is that of the solution, by the implicit function theorem (Blondel et al. 2022, section 2.1). The
    weighted residuals balance at the solution, also after the points have moved a little. Pairs and normals are
    constants of the derivative. The gradient is zero along unconstrained directions and with respect to `T_init`. It
    holds locally: it jumps where pairs change, with "plane" more than with "point". Compare it with finite differences
    of several lengths.

    Args:
        source: points.
        target: points, same unit.
        metric: distance to the nearest point (Besl and McKay), or to its line or plane (Chen and Medioni); static
            under `jit`.
        T_init: initial T_target_source; None: identity. The basin of convergence is about as wide as the structures:
            some degrees.
        source_mask: False for invalid source points, which may have any values.
        target_mask: False for invalid target points.

    Returns:
        IcpResult. With too few points to constrain the motion, the result stays near `T_init`, with `converged` True.

    Raises:
        ValueError: wrong shapes, unknown metric, or an empty cloud. Outside of traced calls also: numbers that are not
            finite, float32 points far from the origin, or a `T_init` that is no rigid motion. In a traced call a point
            with a coordinate that is not a number from -1e15 to 1e15 counts as invalid.
    """
    source = as_points("source", source, dimensions=(2, 3))
    target = as_points("target", target, dimensions=source.shape[1:]).astype(source.dtype)
    start = jnp.eye(source.shape[1] + 1) if T_init is None else as_float("T_init", T_init)
    require_shape("T_init", start, (source.shape[1] + 1, source.shape[1] + 1))
    if metric not in ("point", "plane"):
        raise ValueError(f"metric: expected 'point' or 'plane', got {metric!r}")
    clouds = (
        _Cloud(source, as_mask("source_mask", source_mask, source.shape[:1])),
        _Cloud(target, as_mask("target_mask", target_mask, target.shape[:1])),
    )
    _require_finite_cloud("source", clouds[0])
    _require_finite_cloud("target", clouds[1])
    if not isinstance(start, jax.core.Tracer):
        _require_motion(np.asarray(start))
    return _icp(*clouds, start.astype(source.dtype), metric=metric)


class _Cloud(NamedTuple):
    points: Float[Array, "n d"]
    mask: Bool[Array, " n"]


class _Pairs(NamedTuple):
    """Each source point under a motion, and its nearest target point.

    Attributes:
        points: source points in the frame of the target.
        apart: vectors from the target points to the source points.
        matched: target points.
        normals: of the target points; zero where a point has none, and for the metric "point".
        residuals: distance to the line or plane, or to the point where there is no normal.
        weights: robust weights, 0 to 1.
        mask: True for valid pairs.
    """

    points: Float[Array, "n d"]
    apart: Float[Array, "n d"]
    matched: Float[Array, "n d"]
    normals: Float[Array, "n d"]
    residuals: Float[Array, " n"]
    weights: Float[Array, " n"]
    mask: Bool[Array, " n"]


def _require_finite_cloud(name: str, cloud: _Cloud) -> None:
    is_known = not any(isinstance(value, jax.core.Tracer) for value in cloud)
    if len(cloud.points) == 0 or (is_known and not np.isfinite(np.asarray(cloud.points)[np.asarray(cloud.mask)]).all()):
        raise ValueError(f"{name}: expected one point or more and finite numbers; leave invalid points out")
    if is_known and cloud.points.dtype == jnp.float32:
        points = np.asarray(cloud.points, np.float64)[np.asarray(cloud.mask)]
        extent = np.ptp(points, axis=0).max(initial=0.0) if len(points) else 0.0
        if extent > 0 and np.abs(points).max() > _MAX_DISTANCE * extent:
            raise ValueError(f"{name}: the points are too far from the origin for float32; subtract their mean first")


def _require_motion(T_init: np.ndarray) -> None:
    if not np.isfinite(T_init).all():
        raise ValueError("T_init: expected finite numbers, got NaN or infinity")
    R = T_init[:-1, :-1]
    last_row = np.abs(T_init[-1] - np.eye(len(T_init))[-1]).max()
    if max(np.abs(R @ R.T - np.eye(len(R))).max(), last_row) > 1e-3 or np.linalg.det(R) < 0:
        raise ValueError("T_init: expected a rigid motion, got a matrix that scales, shears or reflects")


@partial(jax.jit, static_argnames="metric")
def _icp(source: _Cloud, target: _Cloud, start: Array, *, metric: str) -> IcpResult:
    source, target = (_Cloud(points, mask & is_usable(points)) for points, mask in (source, target))
    source, target = (_Cloud(jnp.where(mask[:, None], points, 0), mask) for points, mask in (source, target))
    if metric == "plane":
        normals = estimate_normals(target.points, _NORMAL_NEIGHBOURS, target.mask).normals
    else:
        normals = jnp.zeros_like(target.points)
    T, change = _solve(metric, source, target, normals, start)
    converged = jax.lax.stop_gradient(change) <= _resolution(target)
    pairs = _find_pairs(source, target, normals, T)
    limit = 3.0 * 1.4826 * jax.lax.stop_gradient(_median(pairs.residuals, pairs.mask))
    is_inlier = pairs.mask & (pairs.residuals <= jnp.maximum(limit, _resolution(target)))
    num_inliers = is_inlier.sum()
    mean_square = jnp.sum(jnp.where(is_inlier, pairs.residuals**2, 0.0)) / jnp.maximum(num_inliers, 1)
    return IcpResult(T, jnp.where(num_inliers > 0, safe_sqrt(mean_square), jnp.inf), num_inliers, converged)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(metric: str, source: _Cloud, target: _Cloud, normals: Array, start: Array) -> tuple[Array, Array]:
    """Returns the motion, and how far the last step moved a point."""
    resolution = _resolution(target)

    def iterate(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        T, _, count = carry
        pairs = _find_pairs(source, target, normals, T)
        if metric == "plane":
            residuals = jnp.sum(pairs.apart * pairs.normals, axis=-1)
            T_new = motion_about(step_to_planes(pairs.points, pairs.normals, residuals, pairs.weights))
            T_new = rigid.matmul(T_new, T)
        else:
            T_new = jnp.where(pairs.weights.any(), weighted_svd(source.points, pairs.matched, pairs.weights), T)
        change = jnp.linalg.norm(rigid.transform_points(T_new, source.points) - pairs.points, axis=-1)
        return T_new, jnp.where(source.mask, change, 0.0).max(), count + 1

    varying = partial(with_axes_of, (source, target, normals, start))
    begin = varying(start), varying(jnp.asarray(jnp.inf, start.dtype)), varying(jnp.asarray(0))
    T, change, _ = jax.lax.while_loop(lambda c: (c[1] > resolution) & (c[2] < _MAX_ITERATIONS), iterate, begin)
    return T, change


@_solve.defjvp
def _solve_jvp(metric: str, primals: Any, tangents: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    source, target, normals, _ = primals
    T, last_change = _solve(metric, *primals)
    centre, size, least = rigid.transform_points(T, _mean(source)[None])[0], _size(source), _resolution(target)
    dim = source.points.shape[1]
    # Angles count in lengths at the rim of the cloud, so that all directions have one unit. A cloud without extent
    # constrains none.
    of_angles = jnp.where(size > least, 1.0 / jnp.maximum(size, least), 0.0)
    scales = jnp.where(jnp.arange(dim * (dim + 1) // 2) < dim, 1.0, of_angles).astype(T.dtype)

    def moved(step: Array) -> Array:
        return rigid.matmul(motion_about(PlaneStep(scales * step, centre)), T)

    def balance(step: Array, source_points: Array, target_points: Array) -> Array:
        clouds = source._replace(points=source_points), target._replace(points=target_points)
        pairs = _find_pairs(*clouds, normals, moved(step))
        forces = pairs.apart
        if metric == "plane":
            forces = pairs.normals * jnp.sum(pairs.normals * pairs.apart, axis=-1, keepdims=True)
        forces = pairs.weights[:, None] * forces
        return scales * jnp.concatenate([forces, _turning(pairs.points - centre, forces)], axis=-1).sum(0)

    step = solution_tangent(
        balance,
        (source.points, target.points),
        (tangents[0].points, tangents[1].points),
        num_unknowns=len(scales),
        open_share=_OPEN_SHARE,
    )
    _, T_tangent = jax.jvp(moved, (jnp.zeros_like(scales),), (step,))
    return (T, last_change), (T_tangent, with_axes_of(last_change, jnp.zeros_like(last_change)))


def _find_pairs(source: _Cloud, target: _Cloud, normals: Float[Array, "m d"], T: Float[Array, "d1 d1"]) -> _Pairs:
    points = rigid.transform_points(T, source.points)
    nearest = k_nearest(points, target.points, 1, target.mask).indices[:, 0]
    apart, normals = points - target.points[nearest], normals[nearest]
    distances = safe_sqrt(jnp.sum(apart**2, axis=-1))
    # A point whose neighbourhood is no line or plane counts by its distance to the point itself.
    has_plane = jnp.any(normals != 0.0, axis=-1)
    residuals = jnp.where(has_plane, jnp.abs(jnp.sum(apart * normals, axis=-1)), distances)
    mask = source.mask & target.mask.any()
    scale = jnp.maximum(3.0 * _median(distances, mask), _resolution(target))
    weights = (scale**2 / (scale**2 + distances**2)) ** 2
    weights = jnp.where(mask & (distances <= 2.0 * scale), weights, 0.0)
    return _Pairs(points, apart, target.points[nearest], normals, residuals, weights, mask)


def _turning(lever: Float[Array, "n d"], vectors: Float[Array, "n d"]) -> Float[Array, "n r"]:
    """Computes torques, the cross products of levers and vectors; in the plane a torque is one number."""
    i, j = np.array([[0], [1]] if lever.shape[1] == 2 else [[1, 2, 0], [2, 0, 1]])
    return lever[:, i] * vectors[:, j] - lever[:, j] * vectors[:, i]


def _mean(cloud: _Cloud) -> Float[Array, " d"]:
    return jnp.sum(jnp.where(cloud.mask[:, None], cloud.points, 0), axis=0) / jnp.maximum(cloud.mask.sum(), 1)


def _size(cloud: _Cloud) -> Float[Array, ""]:
    """Returns the root mean square distance of the points from their mean."""
    squared = jnp.sum((cloud.points - _mean(cloud)) ** 2, axis=-1)
    return safe_sqrt(jnp.sum(jnp.where(cloud.mask, squared, 0)) / jnp.maximum(cloud.mask.sum(), 1))


def _resolution(target: _Cloud) -> Float[Array, ""]:
    """Returns a millionth of the cloud's size or the rounding error, the larger one, above 0; without a derivative."""
    target = _Cloud(jax.lax.stop_gradient(target.points), target.mask)
    rounding = jnp.finfo(target.points.dtype).eps * jnp.max(jnp.abs(target.points))
    return jnp.maximum(jnp.maximum(1e-6 * _size(target), rounding), 1e-12)


def _median(values: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    """Returns the median of the valid values; 0 without any."""
    return jnp.nan_to_num(jnp.nanmedian(jnp.where(mask, values, jnp.nan)))
