"""Point-to-plane alignment of whole lidar scans on the host, coarse to fine, from a first guess of some metres.

`registration.icp` is the textbook method for any two clouds on any device. This one searches trees, shrinks the radius
of its pairs, samples all directions of normals alike, and pairs only surfaces whose normals agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from dpmjax.checks import require_count, require_fields, require_positive
from dpmjax.scans.surfaces import Surface

MIN_PAIRS = 20
"""Fewer pairs tell nothing about a motion."""

MIN_POINTS_FOR_THREADS = 2000
"""To start threads takes longer than to find the neighbours of fewer points."""


@dataclass(frozen=True)
class AlignmentLevel:
    """One radius of the pairs.

    Attributes:
        radius_m: a point is paired with the nearest point of the other surface within this distance.
        num_points: number of points that are paired.
        num_iterations: largest number of steps.
    """

    radius_m: float
    num_points: int
    num_iterations: int

    def __post_init__(self) -> None:
        require_positive("radius_m", self.radius_m)
        require_count("num_points", self.num_points)
        require_count("num_iterations", self.num_iterations)


@dataclass(frozen=True)
class AlignmentConfig:
    """Settings of the alignment.

    Attributes:
        levels: coarse to fine.
        min_cosine: surfaces are paired if the cosine between their normals is larger; it weighs the pair.
        kernel_share: width of the Geman-McClure kernel, as a share of the radius ...
        min_kernel_m: ... and at least this.
        converged_m: a level ends after a shorter step.
        converged_rad: the same for the rotation.
    """

    levels: tuple[AlignmentLevel, ...] = (
        AlignmentLevel(3.0, 1500, 6),
        AlignmentLevel(1.0, 4000, 8),
        AlignmentLevel(0.4, 8000, 10),
    )
    min_cosine: float = 0.3
    kernel_share: float = 1 / 6
    min_kernel_m: float = 0.05
    converged_m: float = 2e-3
    converged_rad: float = 1e-4

    def __post_init__(self) -> None:
        require_fields(self, "min_cosine", low=0, high=1)
        require_fields(self, "kernel_share", "min_kernel_m", "converged_m", "converged_rad", low=1e-9)


class SurfaceAlignment(NamedTuple):
    """The aligned motion.

    Attributes:
        T_target_source: float64.
        rmse_m: weighted root mean square distance of the pairs to their planes; infinite where there are too few.
        num_pairs: number of pairs in the last step.
    """

    T_target_source: Float[np.ndarray, "4 4"]
    rmse_m: float
    num_pairs: int


class PlanePairs(NamedTuple):
    """Source points and the planes of the target nearest to them.

    Attributes:
        points: (p, 3) source points in the frame of the target.
        residuals: (p,) signed distances to the planes, metres.
        normals: (p, 3) normals of the planes.
        cosines: (p,) absolute cosine between the normals of both surfaces.
        flatness: (p,) of the target's neighbourhood.
    """

    points: Float[np.ndarray, "p 3"]
    residuals: Float[np.ndarray, " p"]
    normals: Float[np.ndarray, "p 3"]
    cosines: Float[np.ndarray, " p"]
    flatness: Float[np.ndarray, " p"]


def align_surfaces(
    source: Surface,
    target: Surface,
    T_target_source: Float[np.ndarray, "4 4"],
    config: AlignmentConfig = AlignmentConfig(),
    *,
    num_threads: int = 2,
) -> SurfaceAlignment:
    """Aligns two surfaces by the distances of points to planes (Chen and Medioni 1992), with a robust kernel.

    Args:
        source: surface of a scan.
        target: the other.
        T_target_source: first guess, within about 3 m and 10 degrees.
        config: levels and kernel.
        num_threads: threads of the neighbour search.

    Returns:
        The motion; the first guess where there are too few pairs.
    """
    T, rmse_m, num_pairs = np.array(T_target_source, np.float64), np.inf, 0
    for level in config.levels:
        width = max(config.min_kernel_m, config.kernel_share * level.radius_m)
        for _ in range(level.num_iterations):
            pairs = pair_with_planes(source, target, T, level, num_threads=num_threads)
            num_pairs = len(pairs.residuals)
            if num_pairs < MIN_PAIRS:
                return SurfaceAlignment(T, np.inf, num_pairs)
            weights = pairs.flatness * np.maximum(pairs.cosines - config.min_cosine, 0)
            weights *= (width**2 / (width**2 + pairs.residuals**2)) ** 2
            total = weights.sum()
            rmse_m = float(np.sqrt(np.sum(weights * pairs.residuals**2) / total)) if total > 0 else np.inf
            step = _step_to_planes(pairs, weights)
            T = _motion(step, pairs.points.mean(axis=0)) @ T
            if np.linalg.norm(step[:3]) < config.converged_m and np.linalg.norm(step[3:]) < config.converged_rad:
                break
    return SurfaceAlignment(T, rmse_m, num_pairs)


def pair_with_planes(
    source: Surface,
    target: Surface,
    T_target_source: Float[np.ndarray, "4 4"],
    level: AlignmentLevel,
    *,
    num_threads: int = 1,
) -> PlanePairs:
    """Pairs the first samples of the source with the nearest planes of the target.

    Args:
        source: surface of a scan.
        target: the other.
        T_target_source: motion of the source.
        level: radius and number of points.
        num_threads: threads of the neighbour search.

    Returns:
        The pairs; points without a neighbour within the radius are left out.
    """
    rows, R = source.samples[: level.num_points], T_target_source[:3, :3]
    moved = source.points[rows] @ R.T + T_target_source[:3, 3]
    if len(rows) == 0 or len(target.points) == 0:
        empty = np.zeros((0, 3))
        return PlanePairs(empty, np.zeros(0), empty, np.zeros(0), np.zeros(0))
    workers = num_threads if len(moved) >= MIN_POINTS_FOR_THREADS else 1
    found = target.tree.query(moved, distance_upper_bound=level.radius_m, workers=workers)
    distances, nearest = map(np.asarray, found)
    is_paired = np.isfinite(distances)
    rows, moved, nearest = rows[is_paired], moved[is_paired], nearest[is_paired]
    normals = target.normals[nearest]
    return PlanePairs(
        points=moved,
        residuals=np.sum((moved - target.points[nearest]) * normals, axis=1),
        normals=normals,
        cosines=np.abs(np.sum((source.normals[rows] @ R.T) * normals, axis=1)),
        flatness=target.flatness[nearest],
    )


def _step_to_planes(pairs: PlanePairs, weights: Float[np.ndarray, " p"]) -> Float[np.ndarray, " 6"]:
    """Returns the small translation and rotation, about the points' mean, that brings points onto their planes."""
    levers = pairs.points - pairs.points.mean(axis=0)
    jacobian = np.concatenate([pairs.normals, np.cross(levers, pairs.normals)], axis=1)
    weighted = weights[:, None] * jacobian
    system = weighted.T @ jacobian
    # Directions that no plane holds stay as they are.
    damping = 1e-6 * np.diag(system) + 1e-9 * np.trace(system) + np.finfo(float).tiny
    return -np.linalg.solve(system + np.diag(damping), weighted.T @ pairs.residuals)


def _motion(step: Float[np.ndarray, " 6"], centre: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
    T[:3, 3] = step[:3] + centre - T[:3, :3] @ centre
    return T
