"""The best rigid motion between paired points, in closed form, with a derivative that is finite everywhere.

With weighted means removed, the rotation that maximises trace(R H) for the cross covariance H = sum_i w_i s_i t_i^T
comes from H = U S V^T as R = V diag(1, .., det) U^T (Kabsch 1976, Umeyama 1991; DeepPointMap section 3.3). The
derivative of the singular vectors has poles wherever two singular values meet; that of R has them only where their
signed *sum* is zero, that is where R itself is ambiguous. So R carries a derivative of its own.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpmjax.checks import as_float, as_points, require_shape
from dpmjax.types import AnyArray

DEGENERATE_IN_EPS = 32
"""Relative to the largest, how small a singular value (in units of the dtype's epsilon) counts as zero."""


def weighted_svd(
    source: Float[AnyArray, "n d"], target: Float[AnyArray, "n d"], weights: Float[AnyArray, " n"]
) -> Float[Array, "d1 d1"]:
    """The rigid motion `T_target_source` that minimises sum_i weights[i] * |T source[i] - target[i]|^2.

    The rotation is proper (determinant +1) even where a reflection would fit better. Where the data leave it open
    (all points on one line in 3-D; one pair; a perfect mirror image) it is a best one, near the identity; so one
    valid pair gives a translation, and none gives the identity. Value and gradient are finite in all these cases:
    along directions that the data leave open the derivative is zero.

    Args:
        source: (n, 2) or (n, 3), in the source frame.
        target: the same number of points, in the target frame and the same unit.
        weights: of each pair; zero, negative and NaN weights leave it out, and its points may then hold anything.
            Only ratios count.

    Returns:
        Homogeneous matrix (d+1, d+1), dtype of the inputs.

    Raises:
        ValueError: the shapes do not match.
    """
    source = as_points("source", source, dimensions=(2, 3))
    target, weights = as_points("target", target), as_float("weights", weights)
    require_shape("target", target, source.shape)
    require_shape("weights", weights, source.shape[:1])
    return _weighted_svd(source, target, weights)


@jax.jit
def _weighted_svd(source: jax.Array, target: jax.Array, weights: jax.Array) -> jax.Array:
    dim = source.shape[1]
    if source.shape[0] == 0:
        return jnp.eye(dim + 1, dtype=source.dtype)
    is_used = weights > 0
    # Only ratios count: scaled by the largest, weights of any size are safe to square.
    heaviest = lax.stop_gradient(jnp.max(jnp.where(is_used, weights, 0)))
    weights = jnp.where(is_used, weights, 0) / jnp.where(heaviest > 0, heaviest, 1)
    source, target = (jnp.where(is_used[:, None], points, 0) for points in (source, target))
    mean_source, mean_target = _weighted_mean(source, weights), _weighted_mean(target, weights)
    centred_source = jnp.where(is_used[:, None], source - mean_source, 0)
    centred_target = jnp.where(is_used[:, None], target - mean_target, 0)
    covariance = jnp.einsum("n,ni,nj->ij", weights, centred_source, centred_target, precision=lax.Precision.HIGHEST)
    R = _best_rotation_2d(covariance) if dim == 2 else _best_rotation_3d(covariance)
    translation = mean_target - jnp.sum(R * mean_source, axis=1)
    bottom = jnp.zeros((1, dim + 1), source.dtype).at[0, dim].set(1)
    return jnp.concatenate([jnp.concatenate([R, translation[:, None]], axis=1), bottom])


def _weighted_mean(points: Float[Array, "n d"], weights: Float[Array, " n"]) -> Float[Array, " d"]:
    # Relative to the heaviest point: a single pair then has exactly no spread, and no digit is lost far out.
    anchor = lax.stop_gradient(points[jnp.argmax(weights)])
    total = jnp.sum(weights)
    return anchor + jnp.sum(weights[:, None] * (points - anchor), axis=0) / jnp.where(total > 0, total, 1)


def _scaled(covariance: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Returns the matrix with its largest entry at one: the rotation does not depend on the scale."""
    largest = lax.stop_gradient(jnp.max(jnp.abs(covariance)))
    return covariance / jnp.where(largest > 0, largest, 1)


def _degenerate_tolerance(dtype: jnp.dtype) -> float:
    return DEGENERATE_IN_EPS * float(jnp.finfo(dtype).eps)


def _best_rotation_2d(covariance: Float[Array, "2 2"]) -> Float[Array, "2 2"]:
    H = _scaled(covariance)
    cos, sin = H[0, 0] + H[1, 1], H[0, 1] - H[1, 0]
    squared_length = cos**2 + sin**2
    is_open = squared_length <= _degenerate_tolerance(H.dtype) ** 2
    length = jnp.sqrt(jnp.where(is_open, 1, squared_length))
    cos, sin = jnp.where(is_open, 1, cos / length), jnp.where(is_open, 0, sin / length)
    return jnp.stack([jnp.stack([cos, -sin]), jnp.stack([sin, cos])])


def _best_rotation_3d(covariance: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    H = _scaled(covariance)
    tolerance = _degenerate_tolerance(H.dtype)
    # The 2x2 minors measure the product of the two largest singular values: none left means rank one or zero.
    minors = jnp.cross(H, jnp.roll(H, -1, axis=0))
    is_rank_one = jnp.sum(minors**2) <= (tolerance / 4) ** 2
    # There, a small pull towards the identity settles what the data leave open.
    return _nearest_rotation(jnp.where(is_rank_one, H + tolerance * jnp.eye(3, dtype=H.dtype), H))


@jax.custom_jvp
def _nearest_rotation(H: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Returns the rotation R that maximises trace(R H)."""
    U, singular_values, V = _signed_svd(H)
    del singular_values
    return jnp.matmul(V, U.T, precision=lax.Precision.HIGHEST)


@_nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    # R H stays symmetric as H moves. With dR = W R, W skew, that is W M + M W = (R dH)^T - R dH for M = R H, and in
    # the basis V, where M is diagonal: W_ij = (B_ji - B_ij) / (s_i + s_j) with B = V^T R dH V.
    (H,), (dH,) = primals, tangents
    U, singular_values, V = _signed_svd(H)
    R = jnp.matmul(V, U.T, precision=lax.Precision.HIGHEST)
    B = jnp.linalg.multi_dot([U.T, dH, V], precision=lax.Precision.HIGHEST)
    sums = singular_values[:, None] + singular_values[None, :]
    is_open = sums <= 4 * _degenerate_tolerance(H.dtype) * singular_values[0]
    W = jnp.where(is_open, 0, (B.T - B) / jnp.where(is_open, 1, sums))
    return R, jnp.linalg.multi_dot([V, W, V.T, R], precision=lax.Precision.HIGHEST)


def _signed_svd(H: Float[Array, "3 3"]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns U, s, V with H = U diag(s) V^T and V U^T a rotation: the last singular value takes the sign of det H."""
    U, singular_values, Vt = jnp.linalg.svd(H)
    is_mirrored = jnp.linalg.det(U) * jnp.linalg.det(Vt) < 0
    sign = jnp.where(is_mirrored, -1, 1).astype(H.dtype) * jnp.array([0, 0, 1], H.dtype) + jnp.array([1, 1, 0], H.dtype)
    return U, singular_values * sign, Vt.T * sign
