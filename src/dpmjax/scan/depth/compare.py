"""Projective consistency of depth images at given poses.

The consistency is the share of matching pixels less the cost of contradictions.

Correspondences come from projection instead of a nearest-neighbour search. Two images are compared by one projection in
each direction. A point is compared with the interpolated surface between the pixels, not with the nearest pixel.

"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dpmjax.geometry import rigid
from dpmjax.scan.depth.record import DepthScans, Pinhole, PixelSample, Views, surface_gap

# Cost of a contradiction in matches, and least cost, at coarse tolerances; tolerance up to which the full cost holds.
# Along a bare wall a wrong pose matches nearly everywhere. At a coarse tolerance inexact poses cause contradictions.
_CONTRADICTION, _LEAST_CONTRADICTION, _FULL_TOLERANCE = 18.0, 3.0, 0.02
# A point clearly contradicts a surface twice this share of its depth in front of it, beyond the error of nearly correct
# poses. Nearer points than this share of the typical range have its limit, because an error of position is a larger
# share of a smaller depth.
_CLEAR, _NEAR = 0.04, 0.25
# Matches are normalised by the visible points, because normalisation by all points would favour overlap. This share of
# all points is added to the visible ones, so that matches in a small overlap have a low score.
UNSEEN_SHARE = 0.1


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

    A point on the surface of the image matches. A point in front of that surface contradicts it, because the second
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
    return agreement_of_gaps(gap / tolerance, is_visible, sample.mask, surface_other, tolerance)


def agreement_of_gaps(
    gap: Float[Array, " p"],
    is_visible: Bool[Array, " p"],
    mask: Bool[Array, " p"],
    surface_other: Float[Array, "4 r c"],
    tolerance: Float[Array, ""],
) -> Agreement:
    """Computes the agreement of `image_agreement` from the gaps between points and a surface.

    Args:
        gap: distances in front of the surface, in tolerances.
        is_visible: True for points that are projected to the surface.
        mask: False for invalid points.
        surface_other: the surface.
        tolerance: as `image_agreement`.

    Returns:
        Agreement, two numbers.
    """
    match, contradiction = _match_and_contradiction(gap)
    cost = jnp.clip(_CONTRADICTION * _FULL_TOLERANCE / tolerance, _LEAST_CONTRADICTION, _CONTRADICTION)
    score = jnp.where(is_visible, match - cost * contradiction, 0.0)
    # Fully masked images are not compared.
    unseen = jnp.where((surface_other[0] > 0.0).any(), UNSEEN_SHARE * mask.sum(), 0.0)
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
        T_other_camera = rigid.matmul(rigid.inverse(T_world_camera[other]), T_world_camera)
        others = PixelSample(sample.points[other], sample.mask[other])
        agreements = jax.vmap(both_ways, in_axes=(0, 0, 0, None, None))(
            T_other_camera, Views(sample, surfaces), Views(others, surfaces[other]), scans.pinhole, tolerance
        )
        # At offset n / 2 the second half of the images repeats the pairs of the first half.
        is_new = (2 * offset != count) | (jnp.arange(count) < offset)
        return Agreement(*(jnp.sum(jnp.where(is_new, values, 0.0)) for values in agreements))

    return Agreement(*jax.lax.map(compare, offsets)).consistency()


def explain_points(
    T_other_camera: Float[Array, "4 4"],
    points: Float[Array, "p 3"],
    gap: Float[Array, " p"],
    is_visible: Bool[Array, " p"],
    unit: Float[Array, ""],
    tolerance: Float[Array, ""],
) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Computes the match of each point with a surface, and its clear contradiction.

    The limit of contradictions does not depend on the tolerance: a pose error of one tolerance keeps nearly all matches
    and contradicts nothing.

    Args:
        T_other_camera: motion of the points into the frame of the second camera.
        points: points of one image.
        gap: distance of each point in front of the surface, as a share of the depth.
        is_visible: True for points that are projected to the surface.
        unit: typical range of the images, unit of the points.
        tolerance: share of the depth by which matching points may differ.

    Returns:
        Match and contradiction, 0 to 1; 0 for points that are not visible.
    """
    depth = rigid.transform_points(T_other_camera, points)[:, 2]
    leeway = _CLEAR * jnp.maximum(1.0, _NEAR * unit / jnp.maximum(depth, 1e-3))
    (match, _), (_, contradiction) = (_match_and_contradiction(gap / limit) for limit in (tolerance, leeway))
    return jnp.where(is_visible, match, 0.0), jnp.where(is_visible, contradiction, 0.0)


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
