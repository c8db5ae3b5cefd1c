"""Robust point-to-plane alignment of surface elements, coarse to fine, in the plane (d = 2) or in space (d = 3).

    found = align(source, target, T_target_source)                       # jit, vmap, grad
    found = jax.vmap(align, (None, None, 0))(source, target, T_starts)   # many starts at once
    found = align_on_host(source, target, T_starts, LEVELS)              # trees: faster on a CPU

Both pair each element of the source with the nearest one of the target and take the same Gauss-Newton
step (Chen and Medioni 1992) with a Geman-McClure kernel. They differ in the search of neighbours and in the dtype only.
"""

from __future__ import annotations

import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import along_curve, k_nearest
from dpmjax.geometry.planes import PlaneStep, geman_mcclure, motion_about, step_to_planes
from dpmjax.scan.lidar.pairs import Pairs, Planes, find_planes, in_columns, move_elements, pair_planes
from dpmjax.scan.lidar.surfaces import MIN_FLATNESS, Surface
from dpmjax.types import AnyArray, SurfaceElements

# A level ends after a step that turns less, radians, and is shorter, metres.
CONVERGED_RAD, CONVERGED_M = 1e-4, 2e-3

# Largest ratio of two steps by which the next is lengthened: a larger one overshoots where pairs change. Metres that
# count as much as a radian of a step.
MAX_RATIO, LEVER_M = 0.67, 10.0

# Least width of the kernel, and its width as a share of the radius.
MIN_KERNEL_M, KERNEL_SHARE = 0.05, 1 / 6

# Fewer pairs do not constrain a motion.
MIN_PAIRS = 20


class AlignmentLevel(NamedTuple):
    """One radius of the pairs.

    Attributes:
        radius_m: largest distance of a point from the point of the opposite surface that it is paired with.
        num_points: number of points that are paired.
        num_iterations: largest number of steps.
        kernel_m: width of the Geman-McClure kernel; None for a sixth of the radius, at least 5 cm.
    """

    radius_m: float
    num_points: int
    num_iterations: int
    kernel_m: float | None = None

    @property
    def kernel_width_m(self) -> float:
        """Width of the kernel, metres."""
        return max(MIN_KERNEL_M, KERNEL_SHARE * self.radius_m) if self.kernel_m is None else self.kernel_m


ALL = 1 << 20

# Sparse elements are metres apart and their planes are large, so the kernel shrinks, but the radius hardly.
LEVELS = (
    AlignmentLevel(3.0, ALL, 3, kernel_m=0.5),
    AlignmentLevel(2.0, ALL, 2, kernel_m=0.33),
    AlignmentLevel(2.0, ALL, 3, kernel_m=0.2),
    AlignmentLevel(2.0, ALL, 4, kernel_m=0.1),
)


class AlignedMotion(NamedTuple):
    """The aligned motion; failure is data. Arrays of NumPy from the host, with one row a start; else of JAX.

    Attributes:
        T_target_source: motion from source to target; that of the step before where there are too few pairs.
        rmse: weighted root mean square distance of the pairs to their planes before the last step; infinite where
            there are too few.
    """

    T_target_source: Any
    rmse: Any


def _solve(pairs: Pairs, kernel: Any) -> tuple[PlaneStep, Any]:
    """Computes a Gauss-Newton step, 0 where there are too few pairs, and the error before it."""
    xp = rigid.namespace_of(pairs.residuals)
    # Smallest cosine between the normals of a pair; the part of the cosine above it is a factor of the weight of the
    # pair.
    weights = pairs.is_paired * pairs.flatness * xp.maximum(pairs.cosines - 0.3, 0)
    is_enough = (weights > 0).sum(axis=-1) >= MIN_PAIRS
    weights = weights * geman_mcclure(pairs.residuals, kernel)
    if xp is jnp:
        weights = lax.stop_gradient(weights)
    step = step_to_planes(pairs.points, pairs.normals, pairs.residuals, weights)
    step = step._replace(tangent=xp.where(is_enough[..., None], step.tangent, 0))
    total = xp.maximum(weights.sum(axis=-1), np.finfo(weights.dtype).tiny)
    rmse = rigid.safe_sqrt((weights * pairs.residuals**2).sum(axis=-1) / total)
    return step, xp.where(is_enough, rmse, np.inf)


@jax.jit
def align(
    source: SurfaceElements,
    target: SurfaceElements,
    T_target_source: Float[AnyArray, "d1 d1"],
) -> AlignedMotion:
    """Aligns two sets of surface elements from a first guess, by exhaustive search on any device.

    Elements of less than `MIN_FLATNESS` are left out. The derivative is that of the last step with its pairs and
    weights held fixed: at convergence, that of the solution.

    Args:
        source: elements in the source frame; masked ones may hold anything.
        target: the same in the target frame.
        T_target_source: first guess, within the first radius and about 10 degrees.

    Returns:
        The motion.
    """
    source, target = (_flat(jax.tree.map(jnp.asarray, side)) for side in (source, target))
    T = jnp.asarray(T_target_source, source.positions.dtype)
    steps = [(level.radius_m, level.kernel_width_m) for level in LEVELS for _ in range(level.num_iterations)]
    schedule = jnp.array(steps, T.dtype)

    def step_from(source: SurfaceElements, target: SurfaceElements, T: Any, scale: Any) -> AlignedMotion:
        moved = move_elements((source.positions, source.normals), T)
        near = k_nearest(*lax.stop_gradient((moved[0], target.positions)), 1, target.mask)
        is_there, row = near.mask[:, 0] & source.mask, near.indices[:, 0]
        distances = jnp.where(is_there, jnp.sqrt(jnp.where(is_there, near.squared_distances[:, 0], 1)), jnp.inf)
        planes = Planes(target.positions[row], target.normals[row], target.planarity[row], distances)
        step, rmse = _solve(pair_planes(moved, planes, scale[0]), scale[1])
        return AlignedMotion(rigid.matmul(motion_about(step), T), rmse)

    still = lax.stop_gradient((source, target))
    T = lax.stop_gradient(T)
    T, _ = lax.scan(lambda T, scale: (step_from(*still, T, scale).T_target_source, None), T, schedule)
    return step_from(source, target, lax.stop_gradient(T), schedule[-1])


def _flat(side: SurfaceElements) -> SurfaceElements:
    """Returns the elements of a side; those that are no plane are masked, and 0."""
    mask = side.mask & (side.planarity > MIN_FLATNESS)
    positions, normals = (jnp.where(mask[:, None], vectors, 0) for vectors in (side.positions, side.normals))
    return SurfaceElements(positions, normals, jnp.where(mask, side.planarity, 0), mask)


def align_on_host(
    source: Surface,
    target: Surface,
    T_target_source: Float[AnyArray, "s d1 d1"],
    levels: tuple[AlignmentLevel, ...],
) -> AlignedMotion:
    """Aligns two surfaces in float64 from several first guesses, which proceed in step: one search serves all.

    Args:
        source: surface of a scan; its first samples are paired.
        target: the second surface.
        T_target_source: first guesses (s, d+1, d+1), within about the first radius and 10 degrees.
        levels: coarse to fine.

    Returns:
        The motion from each first guess.
    """
    T, rmse = np.array(T_target_source, np.float64), np.full(len(T_target_source), np.inf)
    target = in_columns(target)
    has_pairs = np.full(len(T), len(target.points) > 0 and len(source.samples) >= MIN_PAIRS)
    for level in levels:
        own, active = _first_elements(source, level.num_points), _Active(np.flatnonzero(has_pairs))
        for _ in range(level.num_iterations):
            rows = active.rows
            if len(rows) == 0:
                break
            moved = move_elements(own, T[rows])
            at, planes = _nearest_again(target, moved[0], active)
            step, rmse[rows] = _solve(pair_planes(moved, planes, level.radius_m), level.kernel_width_m)
            longer, factor = _lengthened(step, active)
            T[rows] = rigid.matmul(motion_about(longer), T[rows])
            has_pairs[rows] = np.isfinite(rmse[rows])
            goes_on = has_pairs[rows] & ~_is_converged(step)
            active = _Active(rows, at, planes, step.tangent, factor)
            if not goes_on.all():
                active = jax.tree.map(operator.itemgetter(goes_on), active)
    return AlignedMotion(T, rmse)


def _first_elements(source: Surface, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points and normals of the first samples, near ones one after another: a tree is searched faster."""
    rows = source.samples[:num_points]
    rows = rows.take(along_curve(source.points.take(rows, axis=0)))
    return source.points.take(rows, axis=0), source.normals.take(rows, axis=0)


class _Active(NamedTuple):
    # Starts that are not converged: their rows, the points where their planes were searched, these, and the last step.
    rows: Any
    at: Any = None
    planes: Planes | None = None
    tangent: Any = None
    factor: Any = None


def _nearest_again(target: Surface, points: np.ndarray, active: _Active) -> tuple[np.ndarray, Planes]:
    """Finds the nearest elements of points (s, n, d), or keeps those of starts that have hardly moved since."""
    at, planes = active.at, active.planes
    if planes is None:
        return points, find_planes(target, points)
    # Pairs are searched again once the points have moved farther, in the mean: a larger distance keeps wrong pairs, a
    # smaller one searches in vain.
    has_moved = np.abs(points - at).mean(axis=(1, 2)) > 0.02
    if has_moved.all():
        return points, find_planes(target, points)
    if has_moved.any():
        at[has_moved] = points[has_moved]
        for values, new in zip(planes, find_planes(target, points[has_moved]), strict=True):
            values[has_moved] = new
    return at, planes


def _lengthened(step: PlaneStep, active: _Active) -> tuple[PlaneStep, np.ndarray]:
    """Extrapolates steps that shorten slowly, by their ratio (Aitken): each step changes only some pairs."""
    tangent, dim = step.tangent, step.centre.shape[-1]
    if active.tangent is None:
        return step, np.ones(len(tangent))
    squares = np.repeat([1.0, LEVER_M**2], [dim, tangent.shape[-1] - dim])
    before = active.tangent * squares
    shortening = (tangent * before).sum(axis=-1) / np.maximum((active.tangent * before).sum(axis=-1), 1e-12)
    factor = 1 / (1 - np.clip(1 - (1 - shortening) / active.factor, 0, MAX_RATIO))
    return PlaneStep(factor[:, None] * tangent, step.centre), factor


def _is_converged(taken: PlaneStep) -> np.ndarray:
    """Returns True for short steps."""
    dim = taken.centre.shape[-1]
    shift, turn = (np.linalg.norm(part, axis=-1) for part in (taken.tangent[..., :dim], taken.tangent[..., dim:]))
    return (shift < CONVERGED_M) & (turn < CONVERGED_RAD)
