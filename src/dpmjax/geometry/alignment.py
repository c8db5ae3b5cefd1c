"""The best rigid motion between paired points, in closed form, with a derivative that is finite everywhere.

The weighted means are removed first. The cross covariance is H = sum_i w_i s_i t_i^T = U S V^T. The rotation that
maximises trace(R H) is R = V diag(1, .., det) U^T (Kabsch 1976, Umeyama 1991; DeepPointMap section 3.3). The derivative
of the singular vectors has poles wherever two singular values meet. The derivative of R has poles only where their
signed *sum* is zero, and there R itself is ambiguous. So R carries a derivative of its own.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dpmjax.checks import as_float, as_points, require_shape
from dpmjax.geometry.rigid import matmul, namespace_of
from dpmjax.geometry.traced import is_usable, typed_jit, usable_weights
from dpmjax.types import AnyArray

# Largest singular value that counts as zero, relative to the largest one, in epsilons of the dtype.
DEGENERATE_IN_EPS = 32


@typed_jit()
def weighted_svd(
    source: Float[AnyArray, "n d"], target: Float[AnyArray, "n d"], weights: Float[AnyArray, " n"]
) -> Float[Array, "d1 d1"]:
    """Computes the rigid motion `T_target_source` that minimises sum_i weights[i] * |T source[i] - target[i]|^2.

    The rotation is proper (determinant +1) even if a reflection would fit better. Several motions may fit equally well:
    all points on one line in 3-D, one pair, or a perfect mirror image. The result is then a motion near the identity.
    One valid pair gives a translation, no pair gives the identity. Value and gradient are finite in all these cases.
    The derivative is zero along directions that the data leave open.

    Args:
        source: (n, 2) or (n, 3), in the source frame.
        target: the same number of points, in the target frame and the same unit.
        weights: weight of each pair; only ratios count. A weight that is not finite or not above 0 leaves the pair
            out, and so does one below the smallest normal number (1.2e-38 in float32). The points of a pair that is
            left out may hold anything. A pair with a coordinate that is not a number from -1e15 to 1e15 is left out.

    Returns:
        Homogeneous matrix (d+1, d+1), dtype of the inputs.

    Raises:
        ValueError: the shapes do not match.
    """
    source = as_points("source", source, dimensions=(2, 3))
    target, weights = as_points("target", target), as_float("weights", weights)
    require_shape("target", target, source.shape)
    require_shape("weights", weights, source.shape[:1])
    weights = usable_weights(jnp.where(is_usable(source) & is_usable(target), weights, 0))
    motion: jax.Array = _motion(source, target, weights)
    return motion


def best_motion(source: Any, target: Any, weights: Any) -> Any:
    """Computes `weighted_svd` for finite points that are not checked, of NumPy or JAX.

    Args:
        source: (n, 2) or (n, 3), in the source frame.
        target: the same number of points, in the target frame.
        weights: (n,) of each pair, from 0 to 1.

    Returns:
        `T_target_source`, (d+1, d+1): of NumPy in the dtype of the points if all arrays are NumPy's, else of JAX.
    """
    xp = namespace_of(source, target, weights)
    return (_motion if xp is np else _compiled_motion)(source, target, weights)


def _motion(source: Any, target: Any, weights: Any) -> Any:
    xp, dim = namespace_of(source, target, weights), source.shape[1]
    if source.shape[0] == 0:
        return xp.eye(dim + 1, dtype=source.dtype)
    is_used = weights > 0
    weights = xp.where(is_used, weights, 0)
    source, target = (xp.where(is_used[:, None], points, 0) for points in (source, target))
    mean_source, mean_target = (_weighted_mean(points, weights, xp) for points in (source, target))
    centred_source = xp.where(is_used[:, None], source - mean_source, 0)
    centred_target = xp.where(is_used[:, None], target - mean_target, 0)
    H = _scaled(matmul((weights[:, None] * centred_source).T, centred_target), xp)
    R = _best_rotation_2d(H, xp) if dim == 2 else _best_rotation_3d(H, xp)
    translation = mean_target - xp.sum(R * mean_source, axis=1)
    top = xp.concatenate([R, translation[:, None]], axis=1)
    return xp.concatenate([top, xp.eye(dim + 1, dtype=source.dtype)[dim:]])


_compiled_motion = jax.jit(_motion)


def motions_of_weights(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weights: Float[Array, "s n"]
) -> Float[Array, "s 4 4"]:
    """Computes `weighted_svd` of the same pairs for many sets of weights at once, from the moments of the pairs.

    One matrix product replaces the passes over all pairs of each set. Its rounding error is a millionth of the extent
    of all points. Without derivative.

    Args:
        source: finite points in the source frame.
        target: finite points in the target frame.
        weights: not negative; a set of zeros gives any rigid motion.

    Returns:
        `T_target_source` of each set.
    """
    anchors = source.mean(axis=0), target.mean(axis=0)
    source, target = source - anchors[0], target - anchors[1]
    products = (source[:, :, None] * target[:, None, :]).reshape(-1, 9)
    sums = matmul(weights, jnp.concatenate([source, target, products], axis=1))
    means = sums / jnp.maximum(weights.sum(axis=1), jnp.finfo(weights.dtype).tiny)[:, None]
    mean_source, mean_target = means[:, :3], means[:, 3:6]
    H = means[:, 6:].reshape(-1, 3, 3) - mean_source[:, :, None] * mean_target[:, None, :]
    R = jax.vmap(lambda H: _best_rotation_3d(_scaled(H, jnp), jnp))(H)
    translation = mean_target + anchors[1] - matmul(R, (mean_source + anchors[0])[:, :, None])[:, :, 0]
    top = jnp.concatenate([R, translation[:, :, None]], axis=2)
    last = jnp.broadcast_to(jnp.eye(4, dtype=R.dtype)[3:], (len(R), 1, 4))
    return jnp.concatenate([top, last], axis=1)


def _constant(value: Any) -> Any:
    """Returns the value without its derivative."""
    return lax.stop_gradient(value) if isinstance(value, jax.Array) else value


def _weighted_mean(points: Any, weights: Any, xp: ModuleType) -> Any:
    # Relative to the heaviest point: a single pair then has exactly no spread, and no digit is lost far out.
    anchor = _constant(points[xp.argmax(weights)])
    total = xp.sum(weights)
    return anchor + xp.sum(weights[:, None] * (points - anchor), axis=0) / xp.where(total > 0, total, 1)


def _scaled(covariance: Any, xp: ModuleType) -> Any:
    """Returns the matrix with its largest entry at one: the rotation does not depend on the scale."""
    largest = _constant(xp.max(xp.abs(covariance)))
    return covariance / xp.where(largest > 0, largest, 1)


def _degenerate_tolerance(dtype: Any) -> float:
    return DEGENERATE_IN_EPS * float(jnp.finfo(dtype).eps)


def _best_rotation_2d(H: Any, xp: ModuleType) -> Any:
    cos, sin = H[0, 0] + H[1, 1], H[0, 1] - H[1, 0]
    squared_length = cos**2 + sin**2
    is_open = squared_length <= _degenerate_tolerance(H.dtype) ** 2
    length = xp.sqrt(xp.where(is_open, 1, squared_length))
    cos, sin = xp.where(is_open, 1, cos / length), xp.where(is_open, 0, sin / length)
    return xp.stack([xp.stack([cos, -sin]), xp.stack([sin, cos])])


def _best_rotation_3d(H: Any, xp: ModuleType) -> Any:
    tolerance = _degenerate_tolerance(H.dtype)
    # The 2x2 minors measure the product of the two largest singular values: none left means rank one or zero.
    minors = xp.cross(H, xp.roll(H, -1, axis=0))
    is_rank_one = xp.sum(minors**2) <= (tolerance / 4) ** 2
    # There, a small pull towards the identity selects one of the solutions.
    H = xp.where(is_rank_one, H + tolerance * xp.eye(3, dtype=H.dtype), H)
    return _nearest_rotation(H) if xp is jnp else _rotation_and_parts(H)[0]


@jax.custom_jvp
def _nearest_rotation(H: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Returns the rotation R that maximises trace(R H)."""
    return _rotation_and_parts(H)[0]


@_nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    # R H stays symmetric as H moves. With dR = W R, W skew, that is W M + M W = (R dH)^T - R dH for M = R H, and in
    # the basis V, where M is diagonal: W_ij = (B_ji - B_ij) / (s_i + s_j) with B = V^T R dH V.
    (H,), (dH,) = primals, tangents
    R, U, singular_values, V = _rotation_and_parts(H)
    B = jnp.linalg.multi_dot([U.T, dH, V], precision=lax.Precision.HIGHEST)
    sums = singular_values[:, None] + singular_values[None, :]
    is_open = sums <= 4 * _degenerate_tolerance(H.dtype) * singular_values[0]
    W = jnp.where(is_open, 0, (B.T - B) / jnp.where(is_open, 1, sums))
    return R, jnp.linalg.multi_dot([V, W, V.T, R], precision=lax.Precision.HIGHEST)


def _rotation_and_parts(H: Any) -> tuple[Any, Any, Any, Any]:
    """Returns R, U, s, V: H = U diag(s) V^T, R = V U^T a rotation, the last singular value with the sign of det H."""
    xp = namespace_of(H)
    U, singular_values, Vt = xp.linalg.svd(H)
    is_mirrored = xp.linalg.det(U) * xp.linalg.det(Vt) < 0
    sign = xp.where(is_mirrored, xp.array([1, 1, -1], H.dtype), xp.ones(3, H.dtype))
    V = Vt.T * sign
    return matmul(V, U.T), U, singular_values * sign, V
