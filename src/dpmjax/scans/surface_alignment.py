"""Point-to-plane alignment of whole lidar scans on the host, coarse to fine, from a first guess of some metres.

`registration2d.icp` is the textbook method for any two clouds on any device. This one searches trees, shrinks the
radius of its pairs, samples all directions of normals alike, and pairs only surfaces whose normals agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from dpmjax.checks import require_count, require_positive
from dpmjax.geometry.planes import PlaneStep, geman_mcclure, motion_about, step_to_planes
from dpmjax.scans.surfaces import Surface

# A level ends after a step that turns less, radians, and is shorter, metres.
CONVERGED_RAD = 1e-4
CONVERGED_M = 2e-3

# Least width of the kernel.
MIN_KERNEL_M = 0.05

# Width of the Geman-McClure kernel, as a share of the radius.
KERNEL_SHARE = 1 / 6

# Smallest cosine between the normals of a pair; the part of the cosine above it is a factor of the weight of the pair.
PAIR_COSINE = 0.3

# Fewer pairs do not constrain a motion.
MIN_PAIRS = 20


@dataclass(frozen=True)
class AlignmentLevel:
    """One radius of the pairs.

    Attributes:
        radius_m: largest distance of a point from the point of the opposite surface that it is paired with.
        num_points: number of points that are paired.
        num_iterations: largest number of steps.
        kernel_m: width of the kernel; None for that of the configuration.
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


@dataclass(frozen=True)
class AlignmentConfig:
    """Settings of the alignment.

    Attributes:
        levels: coarse to fine.
    """

    levels: tuple[AlignmentLevel, ...] = (
        AlignmentLevel(3.0, 1500, 6),
        AlignmentLevel(1.0, 4000, 8),
        AlignmentLevel(0.4, 8000, 10),
    )

    def __post_init__(self) -> None:
        if not self.levels:
            raise ValueError("levels: expected one or more, got none")

    def kernel_width_m(self, level: AlignmentLevel) -> float:
        """Returns the width of the kernel at a level.

        Args:
            level: one of the levels.

        Returns:
            Metres.
        """
        return max(MIN_KERNEL_M, KERNEL_SHARE * level.radius_m) if level.kernel_m is None else level.kernel_m

    def is_converged(self, step: PlaneStep) -> Any:
        """Compares steps with the limits of convergence.

        Args:
            step: steps of any leading axes, of NumPy or of JAX.

        Returns:
            True for short steps.
        """
        length_squared, angle_squared = (
            (part**2).sum(axis=-1) for part in (step.tangent[..., :3], step.tangent[..., 3:])
        )
        return (length_squared < CONVERGED_M**2) & (angle_squared < CONVERGED_RAD**2)


class SurfaceAlignment(NamedTuple):
    """The aligned motion.

    Attributes:
        T_target_source: float64.
        rmse: weighted root mean square distance of the pairs to their planes, metres; infinite where there are too few.
        num_pairs: number of pairs in the last step.
    """

    T_target_source: Float[np.ndarray, "4 4"]
    rmse: float
    num_pairs: int


class PlanePairs(NamedTuple):
    """Source points and the planes of the target nearest to them.

    Attributes:
        points: (p, 3) source points in the frame of the target.
        residuals: (p,) signed distances to the planes, metres.
        normals: (p, 3) normals of the planes.
    """

    points: Float[np.ndarray, "p 3"]
    residuals: Float[np.ndarray, " p"]
    normals: Float[np.ndarray, "p 3"]


class NearestPlanes(NamedTuple):
    """Samples of the source under several motions, and the planes of the target nearest to them.

    Attributes:
        is_paired: (s, n) True if a point of the target is within the radius; all further fields are undefined where it
            is False.
        points: (s, n, 3) samples in the frame of the target.
        residuals: (s, n) signed distances to the planes, metres.
        normals: (s, n, 3) normals of the planes.
        cosines: (s, n) absolute cosine between the normals of both surfaces; 1 for a sample without a normal.
        flatness: (s, n) of the target's neighbourhood.
    """

    is_paired: Bool[np.ndarray, "s n"]
    points: Float[np.ndarray, "s n 3"]
    residuals: Float[np.ndarray, "s n"]
    normals: Float[np.ndarray, "s n 3"]
    cosines: Float[np.ndarray, "s n"]
    flatness: Float[np.ndarray, "s n"]

    @property
    def pairs(self) -> PlanePairs:
        """The paired samples."""
        return PlanePairs(*(values[self.is_paired] for values in self[1:4]))


def align_surfaces(
    source: Surface,
    target: Surface,
    T_target_source: Float[np.ndarray, "4 4"],
    config: AlignmentConfig = AlignmentConfig(),
) -> SurfaceAlignment:
    """Aligns two surfaces by the distances of points to planes (Chen and Medioni 1992), with a robust kernel.

    Args:
        source: surface of a scan.
        target: the second surface.
        T_target_source: first guess, within about 3 m and 10 degrees.
        config: levels and kernel.

    Returns:
        The motion; the first guess where there are too few pairs.
    """
    (found,) = align_surfaces_from(source, target, np.asarray(T_target_source)[None], config)
    return found


def align_surfaces_from(
    source: Surface,
    target: Surface,
    T_target_source: Float[np.ndarray, "s 4 4"],
    config: AlignmentConfig = AlignmentConfig(),
) -> list[SurfaceAlignment]:
    """Aligns two surfaces from several first guesses, in step: all of them look up their neighbours together.

    Args:
        source: surface of a scan.
        target: the second surface.
        T_target_source: first guesses; see `align_surfaces`.
        config: levels and kernel.

    Returns:
        One result of `align_surfaces` for each guess.
    """
    T = np.array(T_target_source, np.float64)
    rmse, num_pairs = np.full(len(T), np.inf), np.zeros(len(T), int)
    has_pairs = np.ones(len(T), bool)
    for level in config.levels:
        is_active = has_pairs.copy()
        for _ in range(level.num_iterations):
            rows = np.flatnonzero(is_active)
            pairs = nearest_planes(source, target, T[rows], level)
            num_pairs[rows] = pairs.is_paired.sum(axis=1)
            is_enough = num_pairs[rows] >= MIN_PAIRS
            lost = rows[~is_enough]
            rmse[lost], has_pairs[lost], is_active[lost] = np.inf, False, False
            if not is_enough.all():
                rows, pairs = rows[is_enough], NearestPlanes(*(values[is_enough] for values in pairs))
            if len(rows) == 0:
                break
            step, rmse[rows] = _step(pairs, level, config)
            T[rows] = motion_about(step) @ T[rows]
            is_active[rows] = ~config.is_converged(step)
    return [SurfaceAlignment(*found) for found in zip(T, rmse.tolist(), num_pairs.tolist(), strict=True)]


def nearest_planes(
    source: Surface,
    target: Surface,
    T_target_source: Float[np.ndarray, "s 4 4"],
    level: AlignmentLevel,
) -> NearestPlanes:
    """Finds the planes of the target nearest to the first samples of the source, under several motions.

    Args:
        source: surface of a scan.
        target: the second surface.
        T_target_source: motions of the source.
        level: radius and number of points.

    Returns:
        A plane for each sample under each motion.
    """
    rows, R_transposed = source.samples[: level.num_points], T_target_source[:, :3, :3].transpose(0, 2, 1)
    moved = source.points[rows] @ R_transposed + T_target_source[:, None, :3, 3]
    if len(target.points) == 0:
        nothing = np.zeros(moved.shape[:2])
        return NearestPlanes(nothing > 0, moved, nothing, np.zeros_like(moved), nothing, nothing)
    found, distances = target.tree.nearest(moved.reshape(-1, 3), 1)
    nearest, is_paired = found.reshape(moved.shape[:2]), distances.reshape(moved.shape[:2]) < level.radius_m
    normals, own = target.normals[nearest], source.normals[rows]
    cosines = np.abs(np.einsum("snd,snd->sn", own @ R_transposed, normals))
    return NearestPlanes(
        is_paired,
        points=moved,
        residuals=np.einsum("snd,snd->sn", moved - target.points[nearest], normals),
        normals=normals,
        cosines=np.where(own.any(axis=1), cosines, 1.0),
        flatness=target.flatness[nearest],
    )


def pair_with_planes(
    source: Surface, target: Surface, T_target_source: Float[np.ndarray, "4 4"], level: AlignmentLevel
) -> PlanePairs:
    """Pairs the first samples of the source with the nearest planes of the target.

    Args:
        source: surface of a scan.
        target: the second surface.
        T_target_source: motion of the source.
        level: radius and number of points.

    Returns:
        The pairs; points without a neighbour within the radius are left out.
    """
    return nearest_planes(source, target, np.asarray(T_target_source)[None], level).pairs


def _step(
    pairs: NearestPlanes, level: AlignmentLevel, config: AlignmentConfig
) -> tuple[PlaneStep, Float[np.ndarray, " s"]]:
    """Returns the step that brings points onto their planes, and the rmse before it."""
    weights = pairs.flatness * np.maximum(pairs.cosines - PAIR_COSINE, 0) * pairs.is_paired
    weights *= geman_mcclure(pairs.residuals, config.kernel_width_m(level))
    total = weights.sum(axis=1)
    squares = np.sum(weights * pairs.residuals**2, axis=1)
    rmse = np.sqrt(np.divide(squares, total, out=np.full(len(total), np.inf), where=total > 0))
    return step_to_planes(pairs.points, pairs.normals, pairs.residuals, weights), rmse
