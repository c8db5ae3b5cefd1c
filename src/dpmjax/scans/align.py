"""Robust point-to-plane alignment of surface elements, coarse to fine, in the plane (d = 2) or in space (d = 3).

    found = align(source, target, T_target_source)                       # jit, vmap, grad
    found = jax.vmap(align, (None, None, 0))(source, target, T_starts)   # many starts at once
    found = align_on_host(source, target, T_starts, LEVELS)              # trees: faster on a CPU

Both pair each element of the source with the nearest one of the target and take the same Gauss-Newton
step (Chen and Medioni 1992) with a Geman-McClure kernel. They differ in the search of neighbours and in the dtype only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from dpmjax.checks import require_count, require_positive
from dpmjax.geometry import rigid
from dpmjax.geometry.neighbours import along_curve, k_nearest
from dpmjax.geometry.planes import PlaneStep, geman_mcclure, motion_about, step_to_planes
from dpmjax.scans.surfaces import MIN_FLATNESS, Surface
from dpmjax.types import AnyArray, Poses, SurfaceElements

# A level ends after a step that turns less, radians, and is shorter, metres.
CONVERGED_RAD, CONVERGED_M = 1e-4, 2e-3

# Pairs are searched again once the points have moved farther, in the mean: a larger distance keeps wrong pairs, a
# smaller one searches in vain.
SEARCHED_AGAIN_M = 0.02

# Least width of the kernel, and its width as a share of the radius.
MIN_KERNEL_M, KERNEL_SHARE = 0.05, 1 / 6

# Smallest cosine between the normals of a pair; the part of the cosine above it is a factor of the weight of the pair.
PAIR_COSINE = 0.3

# Fewer pairs do not constrain a motion.
MIN_PAIRS = 20

# Largest distance of a point from a plane that it meets, and least cosine between the normals of both.
PLANE_DISTANCE_M, MIN_COSINE = 0.15, 0.7


@dataclass(frozen=True)
class AlignmentLevel:
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

    def __post_init__(self) -> None:
        require_positive("radius_m", self.radius_m)
        require_positive("kernel_m", 1.0 if self.kernel_m is None else self.kernel_m)
        require_count("num_points", self.num_points)
        require_count("num_iterations", self.num_iterations)

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


class Prior(NamedTuple):
    """Expected motion, which holds the directions that no plane holds.

    Attributes:
        T_target_source: (d+1, d+1).
        information: (k, k) inverse covariance of the shift, then of the turn about the centre of the pairs, in the
            frame of the target and in units of the weight of one pair per squared unit of length.
    """

    T_target_source: Any
    information: Any


class AlignedMotion(NamedTuple):
    """The aligned motion; failure is data. Arrays of NumPy from the host, with one row a start; else of JAX.

    Attributes:
        T_target_source: motion from source to target; that of the step before where there are too few pairs.
        rmse: weighted root mean square distance of the pairs to their planes before the last step; infinite where
            there are too few.
        num_pairs: number of pairs of the last step.
        information: (k, k) sum of the weighted squares of the derivatives about the centre of the pairs, shift first.
    """

    T_target_source: Any
    rmse: Any
    num_pairs: Any
    information: Any


class _Planes(NamedTuple):
    # The nearest element of the target of each point: where it is, its normal and flatness, and its distance.
    positions: Any
    normals: Any
    flatness: Any
    distances: Any


def _moved(source: tuple[Any, Any], T_target_source: Any) -> tuple[Any, Any]:
    """Moves points and normals (n, d); coordinates lie behind one another in memory: NumPy is several times faster."""
    xp, dim = rigid.namespace_of(T_target_source), T_target_source.shape[-1] - 1
    turn = T_target_source[..., :dim, :dim]
    points, normals = (xp.swapaxes(rigid.matmul(turn, values.T), -1, -2) for values in source)
    return points + T_target_source[..., None, :dim, dim], normals


def _pair(moved: tuple[Any, Any], planes: _Planes, radius: Any) -> Pairs:
    """Pairs moved points and normals with the nearest planes."""
    xp, (points, own) = rigid.namespace_of(moved[0]), moved
    normals, is_bare = planes.normals, (own == 0).all(axis=-1)
    residuals = ((points - planes.positions) * normals).sum(axis=-1)
    cosines = xp.where(is_bare, 1.0, xp.abs((own * normals).sum(axis=-1)))
    return Pairs(planes.distances < radius, points, residuals, normals, cosines, planes.flatness)


def step(
    pairs: Pairs, T_target_source: Any, kernel: Any, prior: Prior | None = None
) -> tuple[AlignedMotion, PlaneStep]:
    """Takes one Gauss-Newton step.

    Args:
        pairs: pairs under the motions.
        T_target_source: motions (..., d+1, d+1) before the step.
        kernel: width of the Geman-McClure kernel.
        prior: expected motion.

    Returns:
        The motions after the step, with the numbers of the pairs before it, and the step.
    """
    xp = rigid.namespace_of(T_target_source)
    weights = pairs.is_paired * pairs.flatness * xp.maximum(pairs.cosines - PAIR_COSINE, 0)
    num_pairs = (weights > 0).sum(axis=-1)
    weights = weights * geman_mcclure(pairs.residuals, kernel)
    if xp is jnp:
        weights = lax.stop_gradient(weights)
    about = None if prior is None else (T_target_source, *prior)
    found, information = step_to_planes(pairs.points, pairs.normals, pairs.residuals, weights, about)
    is_enough = num_pairs >= MIN_PAIRS
    found = PlaneStep(xp.where(is_enough[..., None], found.tangent, 0), found.centre)
    total = xp.maximum(weights.sum(axis=-1), np.finfo(weights.dtype).tiny)
    rmse = rigid.safe_sqrt((weights * pairs.residuals**2).sum(axis=-1) / total)
    T = rigid.matmul(motion_about(found), T_target_source)
    return AlignedMotion(T, xp.where(is_enough, rmse, np.inf), num_pairs, information), found


def schedule_of(levels: tuple[AlignmentLevel, ...]) -> Float[np.ndarray, "k 2"]:
    """Returns the radius and the width of the kernel of each step of all levels, for `align`."""
    rows = [[level.radius_m, level.kernel_width_m] for level in levels for _ in range(level.num_iterations)]
    return np.array(rows, np.float32)


@jax.jit
def align(
    source: SurfaceElements,
    target: SurfaceElements,
    T_target_source: Float[AnyArray, "d1 d1"],
    schedule: Float[AnyArray, "k 2"] | None = None,
    prior: Prior | None = None,
) -> AlignedMotion:
    """Aligns two sets of surface elements from a first guess, by exhaustive search on any device.

    Elements of less than `MIN_FLATNESS` are left out. The derivative is that of the last step with its pairs and
    weights held fixed: at convergence, that of the solution.

    Args:
        source: elements in the source frame; masked ones may hold anything.
        target: the same in the target frame.
        T_target_source: first guess, within the first radius and about 10 degrees.
        schedule: largest distance of a pair, and width of the kernel, of each step; other numbers compile nothing.
            None takes that of `LEVELS`.
        prior: expected motion, for directions that no plane holds.

    Returns:
        The motion.
    """
    schedule = schedule_of(LEVELS) if schedule is None else schedule
    source, target = (_flat(jax.tree.map(jnp.asarray, side)) for side in (source, target))
    T, schedule = jnp.asarray(T_target_source, source.positions.dtype), jnp.asarray(schedule, source.positions.dtype)

    def step_from(source: SurfaceElements, target: SurfaceElements, T: Any, scale: Any) -> AlignedMotion:
        moved = _moved((source.positions, source.normals), T)
        near = k_nearest(*lax.stop_gradient((moved[0], target.positions)), 1, target.mask)
        is_there, row = near.mask[:, 0] & source.mask, near.indices[:, 0]
        distances = jnp.where(is_there, jnp.sqrt(jnp.where(is_there, near.squared_distances[:, 0], 1)), jnp.inf)
        planes = _Planes(target.positions[row], target.normals[row], target.planarity[row], distances)
        return step(_pair(moved, planes, scale[0]), T, scale[1], prior)[0]

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
    prior: Prior | None = None,
) -> AlignedMotion:
    """Aligns two surfaces in float64 from several first guesses, which proceed in step: one search serves all.

    Args:
        source: surface of a scan; its first samples are paired.
        target: the second surface.
        T_target_source: first guesses (s, d+1, d+1), within about the first radius and 10 degrees.
        levels: coarse to fine.
        prior: expected motion, for directions that no plane holds.

    Returns:
        The motion from each first guess.
    """
    T, size = np.array(T_target_source, np.float64), len(T_target_source)
    num_free = 3 * (T.shape[-1] - 2)
    found = AlignedMotion(T, np.full(size, np.inf), np.zeros(size, int), np.zeros((size, num_free, num_free)))
    target = _in_columns(target)
    has_pairs = np.full(size, len(target.points) > 0 and len(source.samples) >= MIN_PAIRS)
    for level in levels:
        own = _first_elements(source, level.num_points)
        rows, at, planes = np.flatnonzero(has_pairs), None, None
        for _ in range(level.num_iterations):
            if len(rows) == 0:
                break
            moved = _moved(own, T[rows])
            at, planes = _nearest_again(target, moved[0], at, planes)
            after, taken = step(_pair(moved, planes, level.radius_m), T[rows], level.kernel_width_m, prior)
            for values, new in zip(found, after, strict=True):
                values[rows] = new
            has_pairs[rows] = np.isfinite(after.rmse)
            is_active = has_pairs[rows] & ~_is_converged(taken)
            if not is_active.all():
                rows, at, planes = rows[is_active], at[is_active], _Planes(*(values[is_active] for values in planes))
    return found


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
    moved = _moved(own, np.asarray(T_target_source))
    return _pair(moved, _nearest(_in_columns(target), moved[0]), radius_m)


def _in_columns(target: Surface) -> Surface:
    """Returns the surface with coordinates behind one another in memory, of which few are taken faster."""
    return target._replace(points=np.asfortranarray(target.points), normals=np.asfortranarray(target.normals))


def _first_elements(source: Surface, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points and normals of the first samples, near ones one after another: a tree is searched faster."""
    rows = source.samples[:num_points]
    rows = rows.take(along_curve(source.points.take(rows, axis=0)))
    return source.points.take(rows, axis=0), source.normals.take(rows, axis=0)


def _nearest(target: Surface, points: np.ndarray) -> _Planes:
    """Finds the nearest element of each point (..., d); at an infinite distance where there is none."""
    shape, dim = points.shape[:-1], points.shape[-1]
    if len(target.points) == 0:
        return _Planes(np.zeros_like(points), np.zeros_like(points), np.zeros(shape), np.full(shape, np.inf))
    rows, distances = (values[:, 0] for values in target.tree.nearest(points.reshape(-1, dim), 1))
    positions, normals = (
        np.moveaxis(np.stack([column.take(rows) for column in values.T]).reshape(dim, *shape), 0, -1)
        for values in (target.points, target.normals)
    )
    return _Planes(positions, normals, target.flatness.take(rows).reshape(shape), distances.reshape(shape))


def _nearest_again(
    target: Surface, points: np.ndarray, at: np.ndarray | None, planes: _Planes | None
) -> tuple[np.ndarray, _Planes]:
    """Finds the nearest elements of points (s, n, d), or keeps those of starts that have hardly moved since `at`."""
    if at is None or planes is None:
        return points, _nearest(target, points)
    has_moved = np.abs(points - at).mean(axis=(1, 2)) > SEARCHED_AGAIN_M
    if has_moved.all():
        return points, _nearest(target, points)
    if has_moved.any():
        at[has_moved] = points[has_moved]
        for values, new in zip(planes, _nearest(target, points[has_moved]), strict=True):
            values[has_moved] = new
    return at, planes


def _is_converged(taken: PlaneStep) -> np.ndarray:
    """Returns True for short steps."""
    dim = taken.centre.shape[-1]
    shift, turn = (np.linalg.norm(part, axis=-1) for part in (taken.tangent[..., :dim], taken.tangent[..., dim:]))
    return (shift < CONVERGED_M) & (turn < CONVERGED_RAD)
