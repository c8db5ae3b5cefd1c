"""Surface elements of a scan: the points of a pyramid, and the planes through the neighbours that it has found."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax

from dpmjax.geometry.planes import fit_planes
from dpmjax.types import PointPyramid, SurfaceElements

MIN_NEIGHBOURS = 4
"""A plane needs this many neighbours, the point itself among them."""


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
    if not 1 <= num_elements <= len(level.mask):
        raise ValueError(f"num_elements: expected from 1 to {len(level.mask)}, got {num_elements}")
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
    return SurfaceElements(
        positions=positions,
        normals=jnp.where(is_plane[:, None], normals, 0),
        planarity=jnp.where(is_plane, fit.flatness, 0),
        mask=mask,
    )
