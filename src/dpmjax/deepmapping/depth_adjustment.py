"""Adjustment of the poses of depth images: all at once, so that points of each lie on the surfaces that others see.

Levenberg and Marquardt's steps on the distances of points in front of or behind surfaces. A point belongs to the
surface that it is projected to, and a large distance weighs little.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.deepmapping.config import Motion
from dpmjax.deepmapping.projective_consistency import (
    DepthScans,
    PixelSample,
    consistency_of_pairs,
    surface_gap,
)
from dpmjax.deepmapping.spatial import motion_matrices
from dpmjax.geometry import rigid

# Share of the mean information that is added to all, at first; divided after a better step, multiplied after a worse.
_DAMPING, _LEAST_DAMPING, _BETTER, _WORSE = 1e-3, 1e-5, 4.0, 8.0
# Longest step, in tolerances: of the typical range, and radians.
_LONGEST_STEP = 4.0


class _Progress(NamedTuple):
    """Motions after the poses so far, their projective consistency, and the damping of the next step."""

    motions: Float[Array, "n 4 4"]
    score: Float[Array, ""]
    damping: Float[Array, ""]


@partial(jax.jit, static_argnames=("num_iterations", "motion"))
def adjust_poses(
    T_world_camera: Float[Array, "n 4 4"],
    scans: DepthScans,
    sample: PixelSample,
    unit: Float[Array, ""] | float,
    tolerance: Float[Array, ""] | float,
    *,
    num_iterations: int,
    motion: Motion,
) -> Float[Array, "n 4 4"]:
    """Adjusts poses so that points lie on the surfaces of all other images, where that makes them more consistent.

    Args:
        T_world_camera: poses to start from, off by few tolerances.
        scans: depth images, unit of the poses.
        sample: some points of each image.
        unit: typical range of the images, unit of the points.
        tolerance: share of the depth at which a gap weighs 0.6; at twice of it 0.14.
        num_iterations: each one is kept only if the projective consistency grows.
        motion: degrees of freedom of the camera.

    Returns:
        Motions to apply after the poses, T_world_camera @ them; that of the first image is none.
    """
    tolerance, count = jnp.asarray(tolerance), T_world_camera.shape[0]
    scales = tolerance * (jnp.array([unit] * 2 + [1.0]) if motion == "planar" else jnp.array([unit] * 3 + [1.0] * 3))
    offsets = jnp.arange(1, count // 2 + 1)

    def score_of(motions: Float[Array, "n 4 4"]) -> Float[Array, ""]:
        return consistency_of_pairs(_times(T_world_camera, motions), sample, scans, offsets, tolerance)

    def iterate(progress: _Progress, _: None) -> tuple[_Progress, None]:
        T = _times(T_world_camera, progress.motions)
        matrix, gradient = _normal_equations(T, scans, sample, scales, tolerance)
        size = len(gradient)
        matrix += (progress.damping * jnp.trace(matrix) / size + _LEAST_DAMPING) * jnp.eye(size)
        # The first image stays.
        free = slice(len(scales), None)
        values = jnp.linalg.solve(matrix[free, free], -gradient[free]).reshape(count - 1, -1)
        values *= jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(jnp.abs(values).max(), 1e-6))
        steps = motion_matrices(scales * jnp.pad(values, ((1, 0), (0, 0))))
        motions = _times(progress.motions, steps)
        tried = _Progress(motions, score_of(motions), jnp.maximum(progress.damping / _BETTER, _LEAST_DAMPING))
        rejected = progress._replace(damping=progress.damping * _WORSE)
        return jax.tree.map(partial(jnp.where, tried.score > progress.score), tried, rejected), None

    none = jnp.broadcast_to(jnp.eye(4), T_world_camera.shape)
    start = _Progress(none, score_of(none), jnp.asarray(_DAMPING))
    return jax.lax.scan(iterate, start, length=num_iterations)[0].motions


def _times(A: Float[Array, "*n 4 4"], B: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    return jnp.matmul(A, B, precision=jax.lax.Precision.HIGHEST)


def _normal_equations(
    T: Float[Array, "n 4 4"],
    scans: DepthScans,
    sample: PixelSample,
    scales: Float[Array, " k"],
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, "nk nk"], Float[Array, " nk"]]:
    """Information and slope of the gaps of all pairs of images, each both ways, over motions after their poses."""
    count, freedom, surfaces = T.shape[0], len(scales), scans.surfaces

    def gaps(values: Float[Array, "2 k"], pair: Int[Array, "2"]) -> tuple[Float[Array, " p"], Bool[Array, " p"]]:
        camera, other = _times(T[pair], motion_matrices(scales * values))
        points = PixelSample(sample.points[pair[0]], sample.mask[pair[0]])
        gap, is_visible = surface_gap(_times(rigid.inverse(other), camera), points, surfaces[pair[1]], scans.pinhole)
        return gap / tolerance, is_visible

    def of_pair(pair: Int[Array, "2"]) -> tuple[Float[Array, "2 k 2 k"], Float[Array, "2 k"]]:
        here = jnp.zeros((2, freedom))
        gap, is_visible = gaps(here, pair)
        slopes, _ = jax.jacfwd(gaps, has_aux=True)(here, pair)
        weighted = jnp.where(is_visible, jnp.exp(-0.5 * gap**2), 0.0)[:, None, None] * slopes
        return jnp.tensordot(weighted, slopes, (0, 0)), jnp.tensordot(gap, weighted, (0, 0))

    camera, other = jnp.nonzero(~jnp.eye(count, dtype=bool), size=count * (count - 1))
    pairs = jnp.stack([camera, other], axis=-1)
    blocks, slopes = jax.lax.map(of_pair, pairs, batch_size=count)
    matrix = jnp.zeros((count, freedom, count, freedom))
    rows, columns = pairs[:, :, None], pairs[:, None, :]
    matrix = matrix.at[rows, :, columns].add(blocks.transpose(0, 1, 3, 2, 4))
    gradient = jnp.zeros((count, freedom)).at[pairs].add(slopes)
    return matrix.reshape(count * freedom, -1), gradient.reshape(-1)
