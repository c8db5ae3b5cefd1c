"""Point-to-plane alignment of surface elements: a pure function of JAX, and the same with trees on the host.

    found = align_elements(source, target, T_target_source)                       # jit, vmap, grad
    found = jax.vmap(align_elements, (None, None, 0))(source, target, T_starts)   # many starts at once
    found = align_elements_on_host(source, target, T_target_source)               # faster on a CPU

The two functions differ in the search of neighbours and in the dtype only. `surface_alignment` takes the same step for
whole scans.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import HostTree, k_nearest
from dpmjax.geometry.planes import PlaneStep, geman_mcclure, motion_about, step_to_planes
from dpmjax.scans.surface_alignment import MIN_PAIRS, PAIR_COSINE, AlignmentLevel, is_converged
from dpmjax.scans.surfaces import MIN_FLATNESS
from dpmjax.types import AnyArray, SurfaceElements

ALL = 1 << 20

# Elements are metres apart and their planes are large, so the kernel shrinks, but the radius hardly.
LEVELS = (
    AlignmentLevel(3.0, ALL, 3, kernel_m=0.5),
    AlignmentLevel(2.0, ALL, 2, kernel_m=0.33),
    AlignmentLevel(2.0, ALL, 3, kernel_m=0.2),
    AlignmentLevel(2.0, ALL, 4, kernel_m=0.1),
)


class ElementAlignment(NamedTuple):
    """The aligned motion; failure is data. Arrays of NumPy from the host, else of JAX.

    Attributes:
        T_target_source: motion from source to target; that of the step before where there are too few pairs.
        rmse: weighted root mean square distance of the pairs to their planes before the last step; infinite where
            there are too few.
        num_pairs: number of pairs of the last step, of both directions.
    """

    T_target_source: Float[AnyArray, "4 4"]
    rmse: Float[AnyArray, ""]
    num_pairs: Int[AnyArray, ""]


class _Step(NamedTuple):
    after: ElementAlignment
    step: PlaneStep


@jax.jit
def align_elements(
    source: SurfaceElements, target: SurfaceElements, T_target_source: Float[AnyArray, "4 4"]
) -> ElementAlignment:
    """Aligns two sets of surface elements from a first guess, by the distances of points to planes.

    Each element of the source is moved onto the plane of the nearest element of the target (Chen and Medioni 1992), and
    each element of the target is paired with the nearest plane of the source: the normals of both sides count, as in
    Rusinkiewicz 2019. A Geman-McClure kernel makes it robust. A pair is weighted by the planarity of the plane and by
    the cosine between both normals; elements of less than `MIN_FLATNESS` are left out.

    The derivative is that of the last step with its pairs and weights held fixed: at convergence, that of the solution.

    Args:
        source: elements in the source frame, metres; masked ones may hold anything.
        target: the same in the target frame.
        T_target_source: first guess, within about 3 m and 10 degrees.

    Returns:
        The motion.
    """
    source, target = (jax.tree.map(jnp.asarray, side) for side in (source, target))
    T = lax.stop_gradient(jnp.asarray(T_target_source, source.positions.dtype))
    for level in LEVELS:
        step_from = _stepper(*lax.stop_gradient((source, target)), level)
        T = _descend(step_from, T, level)
    return _stepper(source, target, LEVELS[-1])(T).after


def align_elements_on_host(
    source: SurfaceElements, target: SurfaceElements, T_target_source: Float[AnyArray, "4 4"]
) -> ElementAlignment:
    """Returns what `align_elements` returns, in float64: trees find the neighbours.

    Args:
        source: see `align_elements`; arrays of NumPy or of JAX.
        target: the same in the target frame.
        T_target_source: first guess.

    Returns:
        The motion, as arrays of NumPy.
    """
    source, target = (jax.tree.map(_on_host, side) for side in (source, target))
    T: AnyArray = np.array(T_target_source, np.float64)
    for level in LEVELS:
        step_from = _stepper(source, target, level)
        for _ in range(level.num_iterations):
            found = step_from(T)
            T = found.after.T_target_source
            if is_converged(found.step):
                break
    return step_from(T).after


def _on_host(leaf: AnyArray) -> np.ndarray:
    array = np.asarray(leaf)
    return array if array.dtype == bool else array.astype(np.float64)


def _descend(
    step_from: Callable[[Any], _Step], T: Float[jax.Array, "4 4"], level: AlignmentLevel
) -> Float[jax.Array, "4 4"]:
    def take(carry: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        T, count, _ = carry
        found = step_from(T)
        return found.after.T_target_source, count + 1, is_converged(found.step)

    start = T, jnp.asarray(0), jnp.asarray(False)
    return lax.while_loop(lambda carry: (carry[1] < level.num_iterations) & ~carry[2], take, start)[0]


def _stepper(source: SurfaceElements, target: SurfaceElements, level: AlignmentLevel) -> Callable[[Any], _Step]:
    """Returns the function that takes one step from a motion, on arrays of NumPy or of JAX."""
    source, target = _planes(source), _planes(target)
    near_source, near_target = _search(source, level.radius_m), _search(target, level.radius_m)

    def step_from(T_target_source: Any) -> _Step:
        moved = _moved(T_target_source, source)
        rows, is_pair = near_target(moved.positions)
        there = _pairs(moved, _rows(target, rows), is_pair, sign=1)
        rows, is_pair = near_source(_moved(rigid.inverse(T_target_source), target).positions)
        back = _pairs(target, _rows(moved, rows), is_pair, sign=-1)
        pairs = jax.tree.map(lambda *parts: rigid.namespace_of(parts[0]).concatenate(parts), there, back)
        return _solve(pairs, T_target_source, level.kernel_width_m)

    return step_from


def _planes(side: SurfaceElements) -> SurfaceElements:
    """Returns the elements of a side; those that are no plane are masked, and 0."""
    xp, mask = rigid.namespace_of(side.positions), side.mask & (side.planarity > MIN_FLATNESS)
    positions, normals = (xp.where(mask[:, None], vectors, 0) for vectors in (side.positions, side.normals))
    return SurfaceElements(positions, normals, xp.where(mask, side.planarity, 0), mask)


def _rows(side: SurfaceElements, rows: Any) -> SurfaceElements:
    return jax.tree.map(lambda leaf: leaf[rows], side)


def _search(side: SurfaceElements, radius_m: float) -> Callable[[Any], tuple[Any, Any]]:
    """Returns the function that maps queries to the row of the nearest plane, and to True where it is near enough."""
    if isinstance(side.positions, jax.Array):

        def near_on_device(queries: Any) -> tuple[Any, Any]:
            near = k_nearest(*lax.stop_gradient((queries, side.positions)), 1, side.mask)
            return near.indices[:, 0], near.mask[:, 0] & (near.squared_distances[:, 0] < radius_m**2)

        return near_on_device
    valid = np.flatnonzero(side.mask)
    tree = HostTree(side.positions[valid])

    def near_on_host(queries: Any) -> tuple[Any, Any]:
        if len(valid) == 0:
            return np.zeros(len(queries), np.int64), np.zeros(len(queries), bool)
        rows, distances = tree.nearest(queries, 1)
        return valid[rows[:, 0]], distances[:, 0] < radius_m

    return near_on_host


def _moved(T_new_old: Any, side: SurfaceElements) -> SurfaceElements:
    # Products and sums instead of a contraction: full precision on every device.
    turn, translation = T_new_old[:3, :3], T_new_old[:3, 3]
    positions, normals = ((turn * vectors[:, None, :]).sum(axis=2) for vectors in (side.positions, side.normals))
    return SurfaceElements(positions + translation, normals, side.planarity, side.mask)


class _Pairs(NamedTuple):
    # In the frame of the target: where a residual is measured, along which normal, and how much it counts at zero.
    points: Any
    normals: Any
    residuals: Any
    weights: Any


def _pairs(queries: SurfaceElements, planes: SurfaceElements, is_pair: Any, *, sign: int) -> _Pairs:
    """Pairs queries with planes, row for row; `sign` is 1 where the queries move, and -1 where the planes do."""
    xp = rigid.namespace_of(queries.positions)
    residuals = sign * ((queries.positions - planes.positions) * planes.normals).sum(axis=1)
    cosines = xp.abs((queries.normals * planes.normals).sum(axis=1))
    weights = (is_pair & queries.mask) * planes.planarity * xp.maximum(cosines - PAIR_COSINE, 0)
    return _Pairs(queries.positions, planes.normals, residuals, weights)


def _solve(pairs: _Pairs, T_target_source: Any, kernel_m: float) -> _Step:
    xp = rigid.namespace_of(pairs.points)
    num_pairs = (pairs.weights > 0).sum()
    is_enough = num_pairs >= MIN_PAIRS
    weights = pairs.weights * geman_mcclure(pairs.residuals, kernel_m)
    if xp is jnp:
        weights = lax.stop_gradient(weights)
    step = step_to_planes(pairs.points, pairs.normals, pairs.residuals, weights)
    step = PlaneStep(xp.where(is_enough, step.tangent, 0), step.centre)
    mean_square = (weights * pairs.residuals**2).sum() / xp.maximum(weights.sum(), np.finfo(weights.dtype).tiny)
    rmse = xp.where(is_enough, rigid.safe_sqrt(mean_square), np.inf)
    T = rigid.matmul(motion_about(step), T_target_source)
    return _Step(ElementAlignment(T, rmse, num_pairs), step)
