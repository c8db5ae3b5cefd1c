"""Surface normals: by principal components of the nearest points, and of neighbouring pixels."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from dpmjax.checks import as_mask, as_points, require_count, require_value
from dpmjax.geometry.neighbours import k_nearest
from dpmjax.geometry.planes import fit_planes
from dpmjax.geometry.traced import is_usable, typed_jit
from dpmjax.types import AnyArray, Neighbours, PointPyramid, SurfaceElements, with_short_repr

# Neighbouring pixels whose depths differ by more than this share lie on different surfaces.
_SAME_SURFACE = 0.3


@with_short_repr
class Normals(NamedTuple):
    """Normals of a cloud.

    Attributes:
        normals: unit vectors that face the origin of the frame (the sensor); zero where `mask` is False.
        flatness: linearity (2-D) or planarity (3-D) of the neighbourhood in [0, 1]. With l1, l2, l3 the eigenvalues of
            its covariance, smallest first, it is (l2 - l1) / l2 in 2-D. It is (l2 - l1) / l3 in 3-D. Zero where `mask`
            is False.
        mask: True where the point is valid and has d valid neighbours or more (itself included) that do not coincide.
    """

    normals: Float[Array, "n d"]
    flatness: Float[Array, " n"]
    mask: Bool[Array, " n"]


def image_normals(
    points: Float[np.ndarray, "*b h w 3"], mask: Bool[np.ndarray, "*b h w"]
) -> tuple[Float[np.ndarray, "*b h-1 w-1 3"], Bool[np.ndarray, "*b h-1 w-1"]]:
    """Normals of organised clouds: of the plane through each pixel, the one right of it and the one below it.

    Args:
        points: points in the camera frame, depth along z.
        mask: True where something was measured.

    Returns:
        Unit normals, 0 where the three do not lie on one surface; and where they do.
    """
    cloud = np.asarray(points, np.float64)
    here, right, below = cloud[..., :-1, :-1, :], cloud[..., :-1, 1:, :], cloud[..., 1:, :-1, :]
    depth = np.stack([here[..., 2], right[..., 2], below[..., 2]])
    is_surface = mask[..., :-1, :-1] & mask[..., :-1, 1:] & mask[..., 1:, :-1]
    is_surface = is_surface & (np.ptp(depth, axis=0) < _SAME_SURFACE * depth.max(axis=0))
    normals = np.cross(right - here, below - here)
    length = np.maximum(np.linalg.norm(normals, axis=-1), 1e-12)
    return np.where(is_surface[..., None], normals / length[..., None], 0), is_surface


@typed_jit("k")
def estimate_normals(points: Float[AnyArray, "n d"], k: int, mask: Bool[AnyArray, " n"] | None = None) -> Normals:
    """The direction in which the k nearest points (the point itself among them) spread least.

    In 3-D a neighbourhood on one line has no normal of its own: it gets one that is normal to the line, flatness 0.
    Normals are constants of the data: their derivative is zero.

    Args:
        points: (n, 2) or (n, 3), in the sensor's frame.
        k: number of neighbours; more average more noise away and round more corners.
        mask: False for points that are not there; they may hold anything. A point with a coordinate that
            is not a number from -1e15 to 1e15 is not there either.

    Returns:
        A unit normal for each point, how flat its neighbourhood is, and where there is one.

    Raises:
        ValueError: the shapes do not match, or k is below d.
    """
    points = as_points("points", points, dimensions=(2, 3))
    require_count("k", k)
    require_value(k >= points.shape[1], "k", f"at least {points.shape[1]} neighbours in {points.shape[1]}-D", k)
    is_there: Bool[Array, " n"] = as_mask("mask", mask, points.shape[:1]) & is_usable(points)
    points = jnp.where(is_there[:, None], lax.stop_gradient(points), 0)
    near = k_nearest(points, points, k, is_there)
    weights = near.mask.astype(points.dtype)
    covariance, spread = _covariance(points, near, weights)
    # Equal coordinates leave only rounding behind; scaled to its own size, the covariance is safe to decompose.
    is_valid = is_there & (jnp.sum(weights, axis=1) >= points.shape[1]) & (spread > 0)
    covariance = jnp.where(is_valid[:, None, None], covariance / jnp.where(is_valid, spread, 1)[:, None, None], 0)
    normals, flatness = _smallest_axis_2d(covariance) if points.shape[1] == 2 else _smallest_axis_3d(covariance)
    faces_away = jnp.sum(normals * points, axis=1) > 0
    normals = jnp.where(faces_away[:, None], -normals, normals)
    return Normals(
        normals=jnp.where(is_valid[:, None], normals, 0), flatness=jnp.where(is_valid, flatness, 0), mask=is_valid
    )


def _covariance(
    points: Float[Array, "n d"], near: Neighbours, weights: Float[Array, "n k"]
) -> tuple[Float[Array, "n d d"], Float[Array, " n"]]:
    """Returns the scatter of each neighbourhood about its mean, and its trace."""
    difference = jnp.where(weights[..., None] > 0, points[near.indices] - points[:, None], 0)
    count = jnp.maximum(jnp.sum(weights, axis=1), 1)
    centred = difference - (jnp.sum(difference, axis=1) / count[:, None])[:, None]
    centred = centred * weights[..., None]
    covariance = jnp.einsum("nki,nkj->nij", centred, centred, precision=lax.Precision.HIGHEST)
    return covariance, jnp.trace(covariance, axis1=1, axis2=2)


def _smallest_axis_2d(covariance: Float[Array, "n 2 2"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    along = jnp.arctan2(2 * xy, xx - yy) / 2
    gap = jnp.hypot(xx - yy, 2 * xy)
    largest = (xx + yy + gap) / 2
    return jnp.stack([-jnp.sin(along), jnp.cos(along)], axis=1), gap / jnp.where(largest > 0, largest, 1)


def _smallest_axis_3d(covariance: Float[Array, "n 3 3"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    eigenvalues, eigenvectors = jnp.linalg.eigh(covariance)
    smallest, middle, largest = eigenvalues[:, 0], eigenvalues[:, 1], eigenvalues[:, 2]
    flatness = (middle - smallest) / jnp.where(largest > 0, largest, 1)
    return eigenvectors[:, :, 0], jnp.clip(flatness, 0, 1)


# A plane needs this many neighbours, the point itself among them.
MIN_NEIGHBOURS = 4


def pyramid_elements(pyramid: PointPyramid, num_elements: int) -> SurfaceElements:
    """Fits a plane to each of the first points of level 1, through their neighbours in the input of the pyramid.

    No further search is needed: the neighbours are those of the first block. The points of every coarser level are the
    first of level 1, in the order of farthest points.

    Args:
        pyramid: one scan; masked points may hold anything.
        num_elements: number of elements, at most the number of points of level 1.

    Returns:
        Elements in the frame and the unit of the pyramid. Normals face the origin and have no derivative; they are 0
        where there are too few neighbours for a plane.

    Raises:
        ValueError: if level 1 has fewer points.
    """
    points, level = pyramid.levels[0], pyramid.levels[1]
    require_value(1 <= num_elements <= len(level.mask), "num_elements", f"from 1 to {len(level.mask)}", num_elements)
    positions, mask = jnp.asarray(level.positions)[:num_elements], jnp.asarray(level.mask)[:num_elements]
    rows = jnp.asarray(level.neighbours[0])[:num_elements]
    offsets = lax.stop_gradient(jnp.asarray(points.positions)[rows] - positions[:, None])
    offsets = jnp.where(mask[:, None, None], offsets, 0)
    # Neighbours beyond the radius of the block were replaced by the nearest, which is the point itself.
    is_near = (rows != rows[:, :1]).at[:, 0].set(True)
    fit = fit_planes((offsets[..., 0], offsets[..., 1], offsets[..., 2]), is_near)
    positions = jnp.where(mask[:, None], positions, 0)
    faces_away = jnp.sum(fit.normals * positions, axis=1) > 0
    normals = jnp.where(faces_away[:, None], -fit.normals, fit.normals)
    is_plane = mask & (jnp.sum(is_near, axis=1) >= MIN_NEIGHBOURS)
    normals, planarity = jnp.where(is_plane[:, None], normals, 0), jnp.where(is_plane, fit.flatness, 0)
    return SurfaceElements(positions, normals, planarity, mask)
