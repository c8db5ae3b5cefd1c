"""Information of an alignment by the planes that points meet: a corridor is weak along its axis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.scans.surface_alignment import PlanePairs

UNKNOWN = np.diag(np.repeat([10.0**-2, 1.0**-2], 3))
"""Information without any plane: standard deviations of 10 m and 1 rad."""

NUM_INDEPENDENT = 200
"""The pairs count as that many independent ones, for their residuals are correlated."""

MIN_SIGMA_M = 0.01
MIN_FACING_COSINE = 0.6


class WeakDirection(NamedTuple):
    """The horizontal direction in which a motion is known least.

    Attributes:
        direction: unit vector in the target frame, either sign.
        sigma_m: standard deviation of the translation along it, metres.
    """

    direction: Float[np.ndarray, "3"]
    sigma_m: float


def plane_information(
    pairs: PlanePairs, T_target_source: Float[np.ndarray, "4 4"], *, max_residual_m: float
) -> Float[np.ndarray, "6 6"]:
    """Computes the normal equations of point-to-plane residuals.

    Args:
        pairs: under the motion.
        T_target_source: the motion.
        max_residual_m: pairs with a larger residual meet no plane.

    Returns:
        Inverse covariance in the tangent of the source, translation first.
    """
    is_used = np.abs(pairs.residuals) < max_residual_m
    if is_used.sum() < 6:
        return UNKNOWN.copy()
    normals = pairs.normals[is_used] @ T_target_source[:3, :3]
    points = (pairs.points[is_used] - T_target_source[:3, 3]) @ T_target_source[:3, :3]
    jacobian = np.concatenate([normals, np.cross(points, normals)], axis=1)
    variance = max(float(np.mean(pairs.residuals[is_used] ** 2)), MIN_SIGMA_M**2)
    system = NUM_INDEPENDENT / len(jacobian) / variance * jacobian.T @ jacobian
    return np.asarray(system + UNKNOWN)


def weakest_direction(
    pairs: PlanePairs,
    T_target_source: Float[np.ndarray, "4 4"],
    up: Float[np.ndarray, "3"],
    *,
    max_residual_m: float,
) -> WeakDirection:
    """Finds the horizontal direction in which the translation is known least, whatever the rotation is.

    Normals across that direction have small components along it by noise alone, which tell nothing; they do not count.

    Args:
        pairs: under the motion.
        T_target_source: the motion.
        up: unit vector in the target frame.
        max_residual_m: pairs with a larger residual meet no plane.

    Returns:
        The direction and the standard deviation along it.
    """

    def covariance_in_target(some: PlanePairs) -> Float[np.ndarray, "3 3"]:
        inverse = np.linalg.inv(plane_information(some, T_target_source, max_residual_m=max_residual_m))
        return T_target_source[:3, :3] @ inverse[:3, :3] @ T_target_source[:3, :3].T

    horizontal = np.linalg.svd(up[None])[2][1:]
    direction = np.linalg.eigh(horizontal @ covariance_in_target(pairs) @ horizontal.T)[1][:, 1] @ horizontal
    along = pairs.normals @ direction
    noise = np.where(np.abs(along) < MIN_FACING_COSINE, along, 0)
    held = pairs._replace(normals=pairs.normals - noise[:, None] * direction)
    return WeakDirection(direction, float(np.sqrt(direction @ covariance_in_target(held) @ direction)))


def with_least_covariance(
    information: Float[np.ndarray, "6 6"], sigma_m: float, sigma_rad: float
) -> Float[np.ndarray, "6 6"]:
    """Adds a constant diagonal covariance, which bounds the covariance of a pose from below.

    Args:
        information: inverse covariance.
        sigma_m: standard deviation of each translation that is added.
        sigma_rad: of each rotation.

    Returns:
        The inverse of the sum.
    """
    covariance = np.linalg.inv(information) + np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))
    after = np.linalg.inv(covariance)
    return np.asarray((after + after.T) / 2)
