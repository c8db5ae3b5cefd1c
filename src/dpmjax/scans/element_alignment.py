"""Point-to-plane alignment of surface elements that are metres apart, such as those of descriptor clouds.

`surface_alignment` takes the same step for whole scans.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import HostTree
from dpmjax.geometry.planes import geman_mcclure, motion_about, step_to_planes
from dpmjax.scans.surface_alignment import MIN_PAIRS, PAIR_COSINE, is_converged
from dpmjax.scans.surfaces import MIN_FLATNESS
from dpmjax.types import AnyArray, Pose, SurfaceElements

# Radius of the pairs, width of the kernel in metres, and largest number of steps. Elements are metres apart and their
# planes are large, so the kernel shrinks, but the radius hardly. The last step is taken in any case.
LEVELS = ((3.0, 0.5, 3), (2.0, 0.33, 2), (2.0, 0.2, 3), (2.0, 0.1, 4), (2.0, 0.1, 1))


def align_elements(source: SurfaceElements, target: SurfaceElements, T_target_source: Float[AnyArray, "4 4"]) -> Pose:
    """Aligns two sets of surface elements from a first guess, by the distances of points to planes.

    Each element of the source is moved onto the plane of the nearest element of the target (Chen and Medioni 1992), and
    each element of the target is paired with the nearest plane of the source: the normals of both sides count, as in
    Rusinkiewicz 2019. A Geman-McClure kernel makes it robust. A pair is weighted by the planarity of the plane and by
    the cosine between both normals; elements of less than `MIN_FLATNESS` are left out.

    Args:
        source: elements in the source frame, metres, arrays of NumPy or of JAX; masked ones may hold anything.
        target: the same in the target frame.
        T_target_source: first guess, within about 3 m and 10 degrees.

    Returns:
        The motion in float64; the first guess where there are too few pairs.
    """
    source, target = _planes(source), _planes(target)
    trees = _search(source), _search(target)
    T = np.array(T_target_source, np.float64)
    for radius_m, kernel_m, num_steps in LEVELS:
        for _ in range(num_steps):
            moved = _moved(T, source)
            there = _pairs(moved, target, trees[1].near(moved.positions, radius_m), sign=1)
            found = trees[0].near(_moved(rigid.inverse(T), target).positions, radius_m)
            back = _pairs(target, moved, found, sign=-1)
            points, normals, residuals, weights = map(np.concatenate, zip(there, back, strict=True))
            if (weights > 0).sum() < MIN_PAIRS:
                return T
            step = step_to_planes(points, normals, residuals, weights * geman_mcclure(residuals, kernel_m))
            T = motion_about(step) @ T
            if is_converged(step):
                break
    return T


def _planes(side: SurfaceElements) -> SurfaceElements:
    """Returns the elements in float64; those that are no plane are masked, and 0."""
    positions, normals, planarity = (
        np.asarray(array, np.float64) for array in (side.positions, side.normals, side.planarity)
    )
    mask = np.asarray(side.mask) & (planarity > MIN_FLATNESS)
    positions, normals = (np.where(mask[:, None], vectors, 0) for vectors in (positions, normals))
    return SurfaceElements(positions, normals, np.where(mask, planarity, 0), mask)


class _Search(NamedTuple):
    # The valid rows of a side, and a tree of their positions.
    rows: Int[np.ndarray, " v"]
    tree: HostTree

    def near(self, queries: AnyArray, radius_m: float) -> tuple[Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
        """Returns the row of the nearest plane of each query, and True where it is near enough."""
        if len(self.rows) == 0:
            return np.zeros(len(queries), np.int64), np.zeros(len(queries), bool)
        found, distances = self.tree.nearest(np.asarray(queries), 1)
        return self.rows[found[:, 0]], distances[:, 0] < radius_m


def _search(side: SurfaceElements) -> _Search:
    rows = np.flatnonzero(side.mask)
    return _Search(rows, HostTree(np.asarray(side.positions)[rows]))


def _moved(T_new_old: Pose, side: SurfaceElements) -> SurfaceElements:
    positions, normals = ((T_new_old[:3, :3] * some[:, None, :]).sum(axis=2) for some in (side.positions, side.normals))
    return SurfaceElements(positions + T_new_old[:3, 3], normals, side.planarity, side.mask)


def _pairs(
    queries: SurfaceElements, side: SurfaceElements, found: tuple[np.ndarray, np.ndarray], *, sign: int
) -> tuple[Any, Any, Any, Any]:
    """Returns points, normals, residuals and weights; `sign` is 1 where the queries move, -1 where the planes do."""
    planes, is_pair = jax.tree.map(lambda leaf: leaf[found[0]], side), found[1]
    residuals = sign * ((queries.positions - planes.positions) * planes.normals).sum(axis=1)
    cosines = np.abs((queries.normals * planes.normals).sum(axis=1))
    weights = (is_pair & queries.mask) * planes.planarity * np.maximum(cosines - PAIR_COSINE, 0)
    return queries.positions, planes.normals, residuals, weights
