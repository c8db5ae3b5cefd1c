"""Projective consistency of depth images at given poses, and adjustment of the poses by it.

The consistency is the share of matching pixels less the cost of contradictions.

Correspondences come from projection instead of a nearest-neighbour search. Two images are compared by one projection in
each direction. A point is compared with the interpolated surface between the pixels, not with the nearest pixel.

The adjustment is Levenberg-Marquardt on the distances along z of points to the surfaces that they are projected to,
with a robust weight. A step counts only if it improves the consistency.
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
from dpmjax.registration_rgbd.depth_images import DepthScans, Pinhole, PixelSample, SampledImages, Views, surface_gap

# Cost of a contradiction in matches, and least cost, at coarse tolerances; tolerance up to which the full cost holds.
# Along a bare wall a wrong pose matches nearly everywhere. At a coarse tolerance inexact poses cause contradictions.
_CONTRADICTION, _LEAST_CONTRADICTION, _FULL_TOLERANCE = 18.0, 3.0, 0.02
# Cost of a point that any image contradicts, in explained points. Such a point lies twice the second share of its depth
# in front of a surface, beyond the error of nearly correct poses. The tolerance of near points is that at the third
# share of the typical range, because an error of position is a larger share of a smaller depth.
_CONTRADICTED_POINT, _CLEAR, _NEAR = 20.0, 0.04, 0.25
# Matches are normalised by the visible points, because normalisation by all points would favour overlap. This share of
# all points is added to the visible ones, so that matches in a small overlap have a low score.
_UNSEEN = 0.1
# Damping as a share of the mean information: initial value, least value, divisor after an accepted step, and factor
# after a rejected step.
_DAMPING, _LEAST_DAMPING, _BETTER, _WORSE = 1e-3, 1e-5, 4.0, 8.0
# Longest step, in tolerances: of the typical range, and radians.
_LONGEST_STEP = 4.0


class Agreement(NamedTuple):
    """Agreement of points with depth images: `total / comparable` is the consistency, -18 to 1.

    Attributes:
        total: matches less the cost of contradictions.
        comparable: number of visible points, plus a share of all points.
    """

    total: Float[Array, "..."]
    comparable: Float[Array, "..."]

    def consistency(self) -> Float[Array, ""]:
        """Consistency of all comparisons together; 0 where no point is visible."""
        return self.total.sum() / jnp.maximum(self.comparable.sum(), 1.0)


def image_agreement(
    T_other_camera: Float[Array, "4 4"],
    sample: PixelSample,
    surface_other: Float[Array, "4 r c"],
    pinhole: Pinhole,
    tolerance: Float[Array, ""],
) -> Agreement:
    """Computes matches less contradictions of points with the depth image of another camera.

    A point on the surface of the image matches. A point in front of that surface contradicts it, because the other
    camera looked through it. This is the self-contradictory occupancy of DeepMapping figure 3, tested on the image
    instead of the map. A point behind the surface is occluded and counts 0.

    Args:
        T_other_camera: motion of the points into the frame of a second camera.
        sample: points of one image.
        surface_other: `image_surface` of that camera.
        pinhole: pinhole of that camera.
        tolerance: tolerance of matching points as a share of the depth.

    Returns:
        Agreement, two numbers.
    """
    gap, is_visible = surface_gap(T_other_camera, sample, surface_other, pinhole)
    gap /= tolerance
    match, contradiction = _match_and_contradiction(gap)
    cost = jnp.clip(_CONTRADICTION * _FULL_TOLERANCE / tolerance, _LEAST_CONTRADICTION, _CONTRADICTION)
    score = jnp.where(is_visible, match - cost * contradiction, 0.0)
    # Fully masked images are not compared.
    unseen = jnp.where((surface_other[0] > 0.0).any(), _UNSEEN * sample.mask.sum(), 0.0)
    return Agreement(score.sum(), is_visible.sum() + unseen)


def _match_and_contradiction(gap: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Computes match and contradiction of points with a surface, 0 to 1 each; the gap is in tolerances."""
    return jnp.exp(-(gap**2)), jax.nn.sigmoid(3.0 * (gap - 2.0))


def both_ways(
    T_other_camera: Float[Array, "4 4"], view: Views, other: Views, pinhole: Pinhole, tolerance: Float[Array, ""]
) -> Agreement:
    """Computes the agreement of a pair of images, in both directions.

    Args:
        T_other_camera: motion of points of the first image into the frame of the second camera.
        view: the first image.
        other: the second image.
        pinhole: pinhole of both cameras.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        The sum of both agreements.
    """
    there = image_agreement(T_other_camera, view.sample, other.surfaces, pinhole, tolerance)
    back = image_agreement(rigid.inverse(T_other_camera), other.sample, view.surfaces, pinhole, tolerance)
    return Agreement(there.total + back.total, there.comparable + back.comparable)


def consistency_of_pairs(
    T_world_camera: Float[Array, "n 4 4"],
    sample: PixelSample,
    scans: DepthScans,
    offsets: Int[Array, " o"],
    tolerance: Float[Array, ""],
) -> Float[Array, ""]:
    """Computes the consistency of each image with those `offsets` later, cyclically; each pair once.

    All comparisons are pooled, because the mean over pairs would favour views of places that many images overlap with.

    Args:
        T_world_camera: poses.
        sample: sampled points of each image.
        scans: depth images, unit of the poses.
        offsets: distinct numbers, 1 to n // 2; these offsets cover every pair.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        The consistency, -18 to 1.
    """
    count, surfaces = T_world_camera.shape[0], scans.surfaces

    def compare(offset: Int[Array, ""]) -> Agreement:
        other = (jnp.arange(count) + offset) % count
        T_other_camera = rigid.compose(rigid.inverse(T_world_camera[other]), T_world_camera)
        others = PixelSample(sample.points[other], sample.mask[other])
        agreements = jax.vmap(both_ways, in_axes=(0, 0, 0, None, None))(
            T_other_camera, Views(sample, surfaces), Views(others, surfaces[other]), scans.pinhole, tolerance
        )
        # At offset n / 2 the second half of the images repeats the pairs of the first half.
        is_new = (2 * offset != count) | (jnp.arange(count) < offset)
        return Agreement(*(jnp.sum(jnp.where(is_new, values, 0.0)) for values in agreements))

    return Agreement(*jax.lax.map(compare, offsets)).consistency()


def explained_share(
    T_world_camera: Float[Array, "n 4 4"], images: SampledImages, tolerance: Float[Array, ""]
) -> Float[Array, ""]:
    """Computes the share of the points that another image explains, less the cost of contradicted points.

    Each point counts once, with the best match and the largest contradiction over all images, so views of one place by
    many images are not favoured. The limit of contradictions does not depend on the tolerance: a pose error of one
    tolerance keeps nearly all matches and causes no contradiction.

    Args:
        T_world_camera: poses.
        images: depth images, unit of the poses.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        -20 to 1.
    """
    scans, sample, unit = images
    rows, surfaces = jnp.arange(T_world_camera.shape[0]), scans.surfaces

    def explain(row: Int[Array, ""]) -> Float[Array, ""]:
        points = PixelSample(sample.points[row], sample.mask[row])

        def by(other: Int[Array, ""]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
            T_other_camera = rigid.compose(rigid.inverse(T_world_camera[other]), T_world_camera[row])
            gap, is_visible = surface_gap(T_other_camera, points, surfaces[other], scans.pinhole)
            depth = rigid.transform_points(T_other_camera, points.points)[:, 2]
            leeway = _CLEAR * jnp.maximum(1.0, _NEAR * unit / jnp.maximum(depth, 1e-3))
            (match, _), (_, contradiction) = (_match_and_contradiction(gap / t) for t in (tolerance, leeway))
            counts = is_visible & (other != row)
            return jnp.where(counts, match, 0.0), jnp.where(counts, contradiction, 0.0)

        match, contradiction = jax.vmap(by)(rows)
        return (match.max(axis=0) - _CONTRADICTED_POINT * contradiction.max(axis=0)).sum()

    return jax.lax.map(explain, rows).sum() / jnp.maximum(sample.mask.sum(), 1)


@jax.jit
def projective_consistency(
    scans: DepthScans, T_world_camera: Float[Array, "n 4 4"], tolerance: Float[Array, ""] | float = 0.02
) -> Float[Array, ""]:
    """Computes the consistency of all pairs of images with all pixels, without ground truth.

    Args:
        scans: depth images.
        T_world_camera: poses of the images, unit of the points.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        -18 (every point contradicts an image) to 1; 0 without any overlap.
    """
    offsets = jnp.arange(1, scans.mask.shape[0] // 2 + 1)
    T = jnp.asarray(T_world_camera, scans.points.dtype)
    return consistency_of_pairs(T, scans.pixels, scans, offsets, jnp.asarray(tolerance))


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
        matrix, gradient = _normal_equations(T, images, scales, tolerance)
        return matrix[free, free], gradient[free]

    def score(motions: Float[Array, "m 4 4"]) -> Float[Array, ""]:
        T = rigid.compose(T_world_camera, with_first(motions))
        return consistency_of_pairs(T, sample, scans, offsets, tolerance)

    return with_first(improve_motions(equations, score, scales, count=count - 1, num_iterations=num_iterations))


def _normal_equations(
    T: Float[Array, "n 4 4"], images: SampledImages, scales: Float[Array, " k"], tolerance: Float[Array, ""]
) -> tuple[Float[Array, "nk nk"], Float[Array, " nk"]]:
    """Computes the normal equations of the residuals of all pairs of images, in both directions."""
    scans, sample, _ = images
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
