"""Pairs of surface elements and the planes nearest to them, under motions: an alignment and a comparison use them.

The same functions serve arrays of NumPy and of JAX, in the plane (d = 2) and in space (d = 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dpmjax.geometry import rigid
from dpmjax.scan.lidar.surfaces import Surface
from dpmjax.types import Poses

# Largest distance of a point from a plane that it meets, and least cosine between the normals of both.
PLANE_DISTANCE_M, MIN_COSINE = 0.15, 0.7


class Pairs(NamedTuple):
    """Elements of the source under motions, and the planes of the target nearest to them; arrays of one kind.

    Attributes:
        is_paired: (..., n) True if an element of the target is within the radius; where it is False, all further fields
            but `points` are undefined.
        points: (..., n, d) elements in the frame of the target.
        residuals: (..., n) signed distances to the planes.
        normals: (..., n, d) normals of the planes.
        cosines: (..., n) absolute cosine between the normals of both; 1 for an element without a normal.
        flatness: (..., n) of the target's neighbourhood.
    """

    is_paired: Any
    points: Any
    residuals: Any
    normals: Any
    cosines: Any
    flatness: Any

    @property
    def meets(self) -> Any:
        """True for an element that meets a plane: it is near, and the normals of both surfaces agree."""
        return self.is_paired & (np.abs(self.residuals) < PLANE_DISTANCE_M) & (self.cosines > MIN_COSINE)

    def take(self, chosen: Any) -> Pairs:
        """Returns chosen rows of all fields."""
        return Pairs(*(values[chosen] for values in self))


class Planes(NamedTuple):
    """The element of a surface that is nearest to each point.

    Attributes:
        positions: (..., n, d) positions of the elements.
        normals: (..., n, d) normals; 0 where there is no plane.
        flatness: (..., n) flatness of their neighbourhoods.
        distances: (..., n) distances of the points; infinite where there is no element.
    """

    positions: Any
    normals: Any
    flatness: Any
    distances: Any


def move_elements(source: tuple[Any, Any], T_target_source: Any) -> tuple[Any, Any]:
    """Moves points and normals.

    Args:
        source: points (n, d), and normals (n, d), 0 where there is none.
        T_target_source: motions (..., d+1, d+1).

    Returns:
        Points and normals (..., n, d). Coordinates lie behind one another in memory: NumPy is several times faster.
    """
    xp, dim = rigid.namespace_of(T_target_source), T_target_source.shape[-1] - 1
    turn = T_target_source[..., :dim, :dim]
    points, normals = (xp.swapaxes(rigid.matmul(turn, values.T), -1, -2) for values in source)
    return points + T_target_source[..., None, :dim, dim], normals


def pair_planes(moved: tuple[Any, Any], planes: Planes, radius: Any) -> Pairs:
    """Pairs moved elements with the nearest planes.

    Args:
        moved: result of `move_elements`.
        planes: planes nearest to the points.
        radius: largest distance of a pair.

    Returns:
        The pairs.
    """
    xp, (points, own) = rigid.namespace_of(moved[0]), moved
    normals, is_bare = planes.normals, (own == 0).all(axis=-1)
    residuals = ((points - planes.positions) * normals).sum(axis=-1)
    cosines = xp.where(is_bare, 1.0, xp.abs((own * normals).sum(axis=-1)))
    return Pairs(planes.distances < radius, points, residuals, normals, cosines, planes.flatness)


def nearest_planes(source: Surface, target: Surface, T_target_source: Poses, radius_m: float, num_points: int) -> Pairs:
    """Pairs the first samples of the source with the planes of the target nearest to them, under several motions.

    Args:
        source: surface of a scan.
        target: the second surface.
        T_target_source: motions of the source.
        radius_m: largest distance of a point from the point of the target that it is paired with.
        num_points: number of points that are paired.

    Returns:
        A pair for each sample under each motion, in the order of the samples.
    """
    rows = source.samples[:num_points]
    own = source.points.take(rows, axis=0), source.normals.take(rows, axis=0)
    moved = move_elements(own, np.asarray(T_target_source))
    return pair_planes(moved, find_planes(in_columns(target), moved[0]), radius_m)


def in_columns(target: Surface) -> Surface:
    """Returns the surface with coordinates behind one another in memory, of which few are taken faster."""
    return target._replace(points=np.asfortranarray(target.points), normals=np.asfortranarray(target.normals))


def find_planes(target: Surface, points: np.ndarray) -> Planes:
    """Finds the nearest elements by the tree of a surface.

    Args:
        target: the surface; `in_columns` makes the search faster.
        points: (..., n, d) points in its frame.

    Returns:
        The elements.
    """
    shape, dim = points.shape[:-1], points.shape[-1]
    if len(target.points) == 0:
        return Planes(np.zeros_like(points), np.zeros_like(points), np.zeros(shape), np.full(shape, np.inf))
    rows, distances = (values[:, 0] for values in target.tree.nearest(points.reshape(-1, dim), 1))
    positions, normals = (
        np.moveaxis(np.stack([column.take(rows) for column in values.T]).reshape(dim, *shape), 0, -1)
        for values in (target.points, target.normals)
    )
    return Planes(positions, normals, target.flatness.take(rows).reshape(shape), distances.reshape(shape))
