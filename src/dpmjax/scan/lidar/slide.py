"""Directions in which the planes of two scans constrain a motion least: information of an alignment, and weak axes.

In a corridor almost all walls are parallel to its axis. They agree with any shift along the axis, and with a half-turn;
only the few elements that face the axis (end walls, pillars, door frames) distinguish motions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from dpmjax.geometry import rigid
from dpmjax.scan.lidar.pairs import PLANE_DISTANCE_M, Pairs, nearest_planes
from dpmjax.scan.lidar.preprocess import first_of_each_voxel
from dpmjax.scan.lidar.propose import STEEP_COSINE, T_level_lidar, planar_motion
from dpmjax.scan.lidar.surfaces import MIN_FLATNESS, Surface
from dpmjax.types import Information, Pose, Poses

MIN_SIGMA_M = 0.01

# Residuals are independent between cubes of this size, not within one.
CUBE_M = 8.0
# Errors of simulated pairs over those that the scatter of residuals explains: two scans do not measure the same planes.
SCATTER_FACTOR = 5.0

# Fewer planes constrain no motion.
MIN_PLANES = 6

# One normal of each voxel counts, so that many points of a near wall do not outweigh a far one.
VOXEL_M = 1.0

# Walls are parallel to an axis if the cosine between their normal and the horizontal direction across it is larger.
# Elements face the axis if the cosine between their normal and the axis is larger.
PARALLEL_COSINE, FACING_COSINE = 0.9, 0.6

# Least flatness of an element in a corridor. Beams graze its far walls and floor, and meet them in slices across the
# corridor. The corners of a slice seem to face the axis, and they move with the lidar.
FIRM_FLATNESS = 0.3

# A smaller share of the first elements may face an axis by chance.
NUM_FACED, MIN_FACING_SHARE = 1000, 0.01

# The components along the axis of a corridor are multiplied for paired normals of both scans. Normals face the axis
# alike if the sum of the products exceeds 6 standard deviations by chance, and if their mean exceeds 0.0005. Bare walls
# have sums up to 5 and means up to 0.0002; a relief of 3 cm has sums above 10 and a mean of 0.0015.
MIN_SIGNIFICANCE, MIN_ALIKE = 6.0, 0.0005

BIN_M, NUM_BINS, MAX_COUNT = 0.2, 301, 20.0
# Elements nearer to each other along the axis have one position.
POSITION_M = 0.5

EXTENT_PERCENT, MAX_REACH_M = 90.0, 25.0


class WeakDirection(NamedTuple):
    """The horizontal direction in which a motion is least certain.

    Attributes:
        direction: unit vector in the target frame, of either sign.
        sigma_m: standard deviation of the translation along it, metres.
    """

    direction: Float[np.ndarray, "3"]
    sigma_m: float


def diagonal_information(sigma_m: float, sigma_rad: float) -> Information:
    """Makes the information of a motion whose six errors are independent.

    Args:
        sigma_m: standard deviation of each translation.
        sigma_rad: standard deviation of each rotation.

    Returns:
        The inverse covariance, translation first.
    """
    return np.diag(np.repeat([sigma_m**-2.0, sigma_rad**-2.0], 3))


# Information without any plane.
UNKNOWN = diagonal_information(10.0, 1.0)


class _PlaneSystem(NamedTuple):
    """Residuals of an alignment to planes, over their standard deviation.

    Attributes:
        points: (m, 3) points that meet planes, in the frame of the source.
        jacobian: (m, 6) derivatives by the tangent of the source, translation first.
        residuals: (m,) distances to the planes.
    """

    points: Float[np.ndarray, "m 3"]
    jacobian: Float[np.ndarray, "m 6"]
    residuals: Float[np.ndarray, " m"]


def _plane_system(pairs: Pairs, T_target_source: Pose) -> _PlaneSystem:
    """Returns the system of the pairs that meet, of none below `MIN_PLANES`; arguments as in `plane_information`."""
    is_used = np.abs(pairs.residuals) < PLANE_DISTANCE_M
    is_used &= is_used.sum() >= MIN_PLANES
    normals = pairs.normals[is_used] @ T_target_source[:3, :3]
    points = (pairs.points[is_used] - T_target_source[:3, 3]) @ T_target_source[:3, :3]
    jacobian = np.concatenate([normals, np.cross(points, normals)], axis=1)
    residuals = pairs.residuals[is_used]
    sigma_m = max(float(np.linalg.norm(residuals)) / np.sqrt(max(len(residuals), 1)), MIN_SIGMA_M)
    return _PlaneSystem(points, jacobian / sigma_m, residuals / sigma_m)


def plane_information(pairs: Pairs, T_target_source: Pose) -> Information:
    """Computes the normal equations of point-to-plane residuals.

    Args:
        pairs: pairs under the motion; those farther apart than `PLANE_DISTANCE_M` meet no plane.
        T_target_source: the motion.

    Returns:
        Inverse covariance in the tangent of the source, translation first.
    """
    jacobian = _plane_system(pairs, T_target_source).jacobian
    # Number of independent pairs with the information of all pairs, because residuals are correlated.
    independent_share = min(200 / max(len(jacobian), 1), 1.0)
    return np.asarray(independent_share * jacobian.T @ jacobian + UNKNOWN)


def scattered_information(pairs: Pairs, T_target_source: Pose) -> Information:
    """Computes the inverse covariance of an alignment where parts of space disagree on the motion, as foliage does.

    The covariance of Liang and Zeger (1986) is that of the gradients of cubes of space. It is zero where one cube alone
    holds a direction, so that of `plane_information` is added.

    Args:
        pairs: pairs under the motion, as in `plane_information`.
        T_target_source: the motion.

    Returns:
        Inverse covariance in the tangent of the source, translation first.
    """
    points, jacobian, residuals = _plane_system(pairs, T_target_source)
    covariance = np.linalg.inv(jacobian.T @ jacobian + UNKNOWN)
    cubes, inverse = np.unique(np.floor(points / CUBE_M), axis=0, return_inverse=True)
    gradients = np.zeros((len(cubes), 6))
    np.add.at(gradients, inverse.ravel(), jacobian * residuals[:, None])
    scatter = SCATTER_FACTOR * covariance @ gradients.T
    return np.asarray(np.linalg.inv(np.linalg.inv(plane_information(pairs, T_target_source)) + scatter @ scatter.T))


def weakest_direction(source: Surface, target: Surface, T_target_source: Pose, radius_m: float) -> WeakDirection:
    """Finds the horizontal direction in which the translation of a motion is least certain, for any rotation.

    Normals across that direction have small components along it by noise alone; these do not count.

    Args:
        source: surface of a scan.
        target: surface of the second scan.
        T_target_source: the motion.
        radius_m: largest distance of an element from the element whose plane it meets.

    Returns:
        The direction and the standard deviation along it.
    """
    # All elements count: the first samples face all directions equally, but few elements of a corridor face its axis.
    pairs = nearest_planes(source, target, T_target_source[None], radius_m, len(source.samples))
    pairs = pairs.take(pairs.is_paired)
    R = T_target_source[:3, :3]
    covariance = R @ np.linalg.inv(plane_information(pairs, T_target_source))[:3, :3] @ R.T
    horizontal = np.linalg.svd(T_level_lidar(target)[2:3, :3])[2][1:]
    direction = np.linalg.eigh(horizontal @ covariance @ horizontal.T)[1][:, 1] @ horizontal
    along = pairs.normals @ direction
    held = _with_kept(pairs, direction, along * _faces(along, np.ones(len(along), bool)))
    return WeakDirection(direction, sigma_along(scattered_information(held, T_target_source), R.T @ direction))


def _faces(along: Float[np.ndarray, " p"], is_firm: Bool[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
    """Returns True for firm elements whose normals face an axis; for none where chance explains their number."""
    is_facing = is_firm & (np.abs(along) > FACING_COSINE)
    return is_facing & (is_facing.sum() > MIN_FACING_SHARE * is_firm.sum())


def _with_kept(pairs: Pairs, direction: Float[np.ndarray, "3"], kept: Float[np.ndarray, " p"]) -> Pairs:
    """Returns pairs whose normals have other components along a direction."""
    return pairs._replace(normals=pairs.normals + (kept - pairs.normals @ direction)[:, None] * direction)


def without_noise_along(pairs: Pairs, source: Surface, T_target_source: Pose, axis: Float[np.ndarray, "3"]) -> Pairs:
    """Removes from normals the component along an axis that is noise.

    Elements that face the axis count, if they are enough. If not, only the components that the normals of both scans
    share count. The noise of the two scans is independent, so the products have the mean zero. A relief of centimetres
    is the same in both scans.

    Args:
        pairs: a pair for each of the first samples of the source.
        source: surface of a scan.
        T_target_source: the motion of the pairs.
        axis: unit vector in the frame of the source.

    Returns:
        The paired ones, with normals that are shorter where they are noisy.
    """
    rows, R = source.samples[: len(pairs.points)][pairs.is_paired], T_target_source[:3, :3]
    pairs, own = pairs.take(pairs.is_paired), source.normals[rows] @ R.T
    along, own_along = pairs.normals @ R @ axis, source.normals[rows] @ axis
    is_firm = pairs.meets & (pairs.flatness > FIRM_FLATNESS) & (source.flatness[rows] > FIRM_FLATNESS)
    if not _faces(along[:NUM_FACED], is_firm[:NUM_FACED]).any():
        products = (np.sign((own * pairs.normals).sum(axis=1)) * own_along * along)[is_firm]
        alike, chance = products.sum(), np.sqrt(np.square(products).sum())
        is_known = alike > max(MIN_SIGNIFICANCE * chance, MIN_ALIKE * len(products))
        share = np.sqrt(min(alike / np.square(along[is_firm]).sum(), 1.0)) if is_known else 0.0
        return _with_kept(pairs, R @ axis, share * is_firm * along)
    return _with_kept(pairs, R @ axis, along * (is_firm & (np.abs(along) > FACING_COSINE)))


def with_least_covariance(information: Information, sigma_m: float, sigma_rad: float) -> Information:
    """Adds a constant diagonal covariance, which bounds the covariance of a pose from below.

    Args:
        information: inverse covariance.
        sigma_m: standard deviation of each translation that is added.
        sigma_rad: standard deviation of each rotation that is added.

    Returns:
        The inverse of the sum.
    """
    covariance = np.linalg.inv(information) + np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))
    after = np.linalg.inv(covariance)
    return np.asarray((after + after.T) / 2)


def sigma_along(information: Information, direction: Float[np.ndarray, "3"]) -> float:
    """Computes the standard deviation of a translation along a direction, for any rotation.

    Args:
        information: inverse covariance, translation first.
        direction: unit vector in the same frame.

    Returns:
        The standard deviation, metres.
    """
    return float(np.sqrt(direction @ np.linalg.inv(information)[:3, :3] @ direction))


class WallAxis(NamedTuple):
    """The horizontal direction that the walls of a scan constrain least.

    Attributes:
        T_level_lidar: motion that makes the ground level, at height 0.
        yaw: angle of the axis in the level frame, radians; either of two opposite directions.
        information: (2,) sums of squared components of the normals along the axis, and across it.
        profile: (b,) number of voxels of parallel walls by their position across the axis.
        extent_m: horizontal range of nine in ten voxels.
    """

    T_level_lidar: Pose
    yaw: float
    information: Float[np.ndarray, "2"]
    profile: Float[np.ndarray, " b"]
    extent_m: float

    @property
    def axis(self) -> Float[np.ndarray, "3"]:
        """The axis as a unit vector in the frame of the lidar."""
        return np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0]) @ self.T_level_lidar[:3, :3]


def wall_axis(surface: Surface) -> WallAxis:
    """Finds the weak axis of the walls of a scan.

    Args:
        surface: surface of the scan.

    Returns:
        The axis; the information is 0 where there is no wall.
    """
    T, points, normals = _walls(surface, MIN_FLATNESS)
    information, axes = np.linalg.eigh(normals.T @ normals)
    along, across = axes[:, 0], np.array([-axes[1, 0], axes[0, 0]])
    is_parallel = np.abs(normals @ across) > PARALLEL_COSINE
    edges = (np.arange(NUM_BINS + 1) - NUM_BINS / 2) * BIN_M
    counts = np.histogram((points @ across)[is_parallel], edges)[0]
    profile = gaussian_filter1d(np.minimum(counts, MAX_COUNT), 1.0, mode="constant")
    extent_m = float(np.percentile(np.linalg.norm(points, axis=1), EXTENT_PERCENT)) if len(points) else 0.0
    return WallAxis(T, float(np.arctan2(along[1], along[0])), np.maximum(information, 0), profile, extent_m)


def _walls(surface: Surface, min_flatness: float) -> tuple[Pose, Float[np.ndarray, "w 2"], Float[np.ndarray, "w 2"]]:
    """Returns T_level_lidar, and horizontal points and normals of walls, one of each voxel."""
    T = T_level_lidar(surface, min_flatness)
    normals = surface.normals @ T[:3, :3].T
    is_wall = (surface.flatness > min_flatness) & (np.abs(normals[:, 2]) < STEEP_COSINE)
    rows = np.flatnonzero(is_wall)
    rows = rows[first_of_each_voxel(surface.points[rows], VOXEL_M)]
    return T, (surface.points[rows] @ T[:3, :3].T)[:, :2], normals[rows, :2]


def weak_share(source: WallAxis, target: WallAxis) -> float:
    """Computes the share of the weak axis in the information of the walls of two scans.

    Args:
        source: axis of a scan.
        target: axis of the second scan.

    Returns:
        In [0, 0.5]: 0 for bare parallel walls, 0.5 where all directions are constrained alike, or a scan has no walls.
    """
    if min(source.information.sum(), target.information.sum()) == 0:
        return 0.5
    along, across = source.information + target.information
    return float(along / (along + across))


def corridor_axis(surface: Surface) -> Float[np.ndarray, "3"] | None:
    """Finds the axis of a corridor: few walls of the scan face it.

    Args:
        surface: surface of a scan.

    Returns:
        The axis as a unit vector in the frame of the lidar; None elsewhere.
    """
    T, _, normals = _walls(surface, FIRM_FLATNESS)
    information, axes = np.linalg.eigh(normals.T @ normals)
    # In a corridor, the axis of the walls has a smaller share of the information of their normals.
    if not len(normals) or information[0] >= 0.1 * information.sum():
        return None
    return np.append(axes[:, 0], 0.0) @ T[:3, :3]


def has_facing(surface: Surface, axis: Float[np.ndarray, "3"]) -> bool:
    """Returns True where more elements with a normal face an axis than may by chance.

    Args:
        surface: surface of a scan.
        axis: unit vector in the frame of the lidar.

    Returns:
        True for an end wall, pillars, door frames.
    """
    return bool(_faces(surface.normals @ axis, surface.flatness > 0).any())


def sliding_motions(source: WallAxis, target: WallAxis, step_m: float) -> Poses:
    """Makes motions that align the walls of both scans across the axis, for both headings, at regular shifts along it.

    Args:
        source: axis of a scan.
        target: axis of the second scan.
        step_m: length of a step; the motions reach as far as the scans, up to 25 m.

    Returns:
        T_target_source.
    """
    reach_m = min(max(source.extent_m, target.extent_m), MAX_REACH_M)
    along, up = np.array([np.cos(target.yaw), np.sin(target.yaw)]), rigid.inverse(target.T_level_lidar)
    motions = []
    for turn, profile in ((0.0, source.profile), (np.pi, source.profile[::-1])):
        lag = int(np.argmax(np.correlate(target.profile, profile, "full"))) - (NUM_BINS - 1)
        for distance_m in np.arange(-reach_m, reach_m + step_m, step_m):
            x, y = distance_m * along + lag * BIN_M * np.array([-along[1], along[0]])
            motions.append(up @ planar_motion(target.yaw - source.yaw + turn, x, y) @ source.T_level_lidar)
    return np.stack(motions)


def facing_samples(
    surface: Surface, axis: Float[np.ndarray, "3"], max_count: float
) -> tuple[Surface, Float[np.ndarray, " s"]]:
    """Selects the samples that face an axis, and weighs those at one position along it up to a limit together.

    Args:
        surface: surface of a scan.
        axis: unit vector in the frame of the lidar.
        max_count: largest sum of the weights at one position.

    Returns:
        The surface with fewer samples, and a weight in (0, 1] for each.
    """
    samples = surface.samples[np.abs(surface.normals[surface.samples] @ axis) > FACING_COSINE]
    positions = np.floor(surface.points[samples] @ axis / POSITION_M)
    _, position, counts = np.unique(positions, return_inverse=True, return_counts=True)
    return surface._replace(samples=samples), np.minimum(1.0, max_count / counts[position])
