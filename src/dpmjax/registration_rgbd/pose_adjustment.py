"""Adjustment of motions of depth images to the surfaces of other images.

It is Levenberg-Marquardt on the distances along z of points to the surfaces that they are projected to, with a robust
weight. A step counts only if it improves the projective consistency.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.geometry import rigid
from dpmjax.geometry.se3 import Motion, motion_matrices
from dpmjax.registration_rgbd.depth_images import DepthScans, PixelSample, SampledImages, surface_gap
from dpmjax.registration_rgbd.projective_consistency import consistency_of_pairs

# Damping as a share of the mean information: initial value, least value, divisor after an accepted step, and factor
# after a rejected step.
_DAMPING, _LEAST_DAMPING, _BETTER, _WORSE = 1e-3, 1e-5, 4.0, 8.0
# Longest step, in tolerances: of the typical range, and radians.
_LONGEST_STEP = 4.0


@partial(jax.jit, static_argnames=("num_iterations", "motion"))
def adjust_poses(
    T_world_camera: Float[Array, "n 4 4"],
    images: SampledImages,
    tolerance: Float[Array, ""] | float,
    *,
    num_iterations: int,
    motion: Motion,
) -> Float[Array, "n 4 4"]:
    """Adjusts poses to the surfaces of all other images, as long as the projective consistency grows.

    Args:
        T_world_camera: initial poses, with errors of few tolerances.
        images: depth images, unit of the poses.
        tolerance: share of the depth; unit of the residuals in `gap_equations`.
        num_iterations: number of steps.
        motion: degrees of freedom of the camera.

    Returns:
        Motions to right-multiply to the poses, T_world_camera @ motion; that of the first image is the identity.
    """
    scans, sample, unit = images
    tolerance, count = jnp.asarray(tolerance), T_world_camera.shape[0]
    scales, offsets = motion_scales(motion, unit, tolerance), jnp.arange(1, count // 2 + 1)
    # The first image is fixed.
    free = slice(len(scales), None)

    def with_first(motions: Float[Array, "m 4 4"]) -> Float[Array, "n 4 4"]:
        return jnp.concatenate([jnp.eye(4)[None], motions])

    def equations(motions: Float[Array, "m 4 4"]) -> tuple[Float[Array, "mk mk"], Float[Array, " mk"]]:
        T = rigid.compose(T_world_camera, with_first(motions))
        matrix, gradient = _normal_equations(T, scans, sample, scales, tolerance)
        return matrix[free, free], gradient[free]

    def score(motions: Float[Array, "m 4 4"]) -> Float[Array, ""]:
        T = rigid.compose(T_world_camera, with_first(motions))
        return consistency_of_pairs(T, sample, scans, offsets, tolerance)

    return with_first(improve_motions(equations, score, scales, count=count - 1, num_iterations=num_iterations))


def _normal_equations(
    T: Float[Array, "n 4 4"],
    scans: DepthScans,
    sample: PixelSample,
    scales: Float[Array, " k"],
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, "nk nk"], Float[Array, " nk"]]:
    """Computes the normal equations of the residuals of all pairs of images, in both directions."""
    count, freedom, surfaces = T.shape[0], len(scales), scans.surfaces

    def gaps(values: Float[Array, "2 k"], pair: Int[Array, "2"]) -> tuple[Float[Array, " p"], Bool[Array, " p"]]:
        camera, other = rigid.compose(T[pair], motion_matrices(scales * values))
        points = PixelSample(sample.points[pair[0]], sample.mask[pair[0]])
        T_other_camera = rigid.compose(rigid.inverse(other), camera)
        gap, is_visible = surface_gap(T_other_camera, points, surfaces[pair[1]], scans.pinhole)
        return gap / tolerance, is_visible

    def of_pair(pair: Int[Array, "2"]) -> tuple[Float[Array, "2 k 2 k"], Float[Array, "2 k"]]:
        here = jnp.zeros((2, freedom))
        gap, is_visible = gaps(here, pair)
        slopes, _ = jax.jacfwd(gaps, has_aux=True)(here, pair)
        return gap_equations(gap, is_visible, slopes)

    camera, other = jnp.nonzero(~jnp.eye(count, dtype=bool), size=count * (count - 1))
    pairs = jnp.stack([camera, other], axis=-1)
    blocks, slopes = jax.lax.map(of_pair, pairs, batch_size=count)
    matrix = jnp.zeros((count, freedom, count, freedom))
    rows, columns = pairs[:, :, None], pairs[:, None, :]
    matrix = matrix.at[rows, :, columns].add(blocks.transpose(0, 1, 3, 2, 4))
    gradient = jnp.zeros((count, freedom)).at[pairs].add(slopes)
    return matrix.reshape(count * freedom, -1), gradient.reshape(-1)


class _Progress(NamedTuple):
    """Current motions, the score of these, and the damping of the next step."""

    motions: Float[Array, "n 4 4"]
    score: Float[Array, ""]
    damping: Float[Array, ""]


def motion_scales(motion: Motion, unit: Float[Array, ""] | float, tolerance: Float[Array, ""]) -> Float[Array, " k"]:
    """Returns the unit of each value of a motion in an adjustment: translations in tolerances, angles in radians.

    Args:
        motion: degrees of freedom of the camera.
        unit: typical range of the images, unit of the points.
        tolerance: share of the depth.

    Returns:
        Three values, or six of a full motion.
    """
    return tolerance * (jnp.array([unit] * 2 + [1.0]) if motion == "planar" else jnp.array([unit] * 3 + [1.0] * 3))


def gap_equations(
    gap: Float[Array, " p"], weight: Float[Array, " p"] | Bool[Array, " p"], slopes: Float[Array, "p *k"]
) -> tuple[Float[Array, "*kk"], Float[Array, "*k"]]:
    """Computes the Gauss-Newton normal equations of surface residuals with Welsch weights.

    Args:
        gap: residuals in tolerances; the Welsch weight is 0.6 at 1 and 0.14 at 2.
        weight: further weight of each residual, 0 for invalid ones.
        slopes: derivatives of the residuals with respect to each value.

    Returns:
        The normal equations, (*k, *k) and (*k).
    """
    robust = weight * jnp.exp(-0.5 * gap**2)
    weighted = robust.reshape(-1, *[1] * (slopes.ndim - 1)) * slopes
    return jnp.tensordot(weighted, slopes, (0, 0)), jnp.tensordot(gap, weighted, (0, 0))


def improve_motions(
    equations: Callable[[Float[Array, "n 4 4"]], tuple[Float[Array, "nk nk"], Float[Array, " nk"]]],
    score: Callable[[Float[Array, "n 4 4"]], Float[Array, ""]],
    scales: Float[Array, " k"],
    *,
    count: int,
    num_iterations: int,
) -> Float[Array, "n 4 4"]:
    """Optimises motions from zero by Levenberg-Marquardt; a step is accepted only if the score grows.

    Args:
        equations: normal equations of values in `scales`, applied after given motions.
        score: score of motions; more is better.
        scales: unit of each value of a motion.
        count: number of motions.
        num_iterations: number of steps.

    Returns:
        The motions.
    """

    def iterate(progress: _Progress, _: None) -> tuple[_Progress, None]:
        matrix, gradient = equations(progress.motions)
        size = len(gradient)
        matrix += (progress.damping * jnp.trace(matrix) / size + _LEAST_DAMPING) * jnp.eye(size)
        values = jnp.linalg.solve(matrix, -gradient).reshape(count, -1)
        values *= jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(jnp.abs(values).max(), 1e-6))
        motions = rigid.compose(progress.motions, motion_matrices(scales * values))
        tried = _Progress(motions, score(motions), jnp.maximum(progress.damping / _BETTER, _LEAST_DAMPING))
        rejected = progress._replace(damping=progress.damping * _WORSE)
        return jax.tree.map(partial(jnp.where, tried.score > progress.score), tried, rejected), None

    none = jnp.broadcast_to(jnp.eye(4), (count, 4, 4))
    start = _Progress(none, score(none), jnp.asarray(_DAMPING))
    return jax.lax.scan(iterate, start, length=num_iterations)[0].motions
