"""Point-to-plane geometry on the host: thins scans, and aligns them with the local map."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.geometry.se3 import orthonormal
from dpmjax.scan.apart import apart
from dpmjax.scan.lidar.align import ALL, AlignmentLevel, align_on_host
from dpmjax.scan.lidar.compare import contradicted_shares, matched_shares
from dpmjax.scan.lidar.pairs import Pairs, nearest_planes
from dpmjax.scan.lidar.record import Scan, lidar_scan
from dpmjax.scan.lidar.slide import plane_information, with_least_covariance, without_noise_along
from dpmjax.sequences import homogeneous
from dpmjax.slam.interfaces import Alignment
from dpmjax.slam.local_map import LocalMap
from dpmjax.types import Information, Pose, Poses

# Turns about the x and y axes among the further starts.
TILTS_DEG = (-8.0, 8.0)

# Turns about the vertical among the further starts.
TURNS_DEG = (-10.0, 10.0, -20.0, 20.0, -35.0, 35.0, -50.0, 50.0)

# Turns on the spot, of a robot between two scans.
SPINS_DEG = (-80.0, 80.0, -110.0, 110.0, -145.0, 145.0, 180.0)

# Number of surface elements that the score of a pose compares.
NUM_SAMPLES = 1000

# Weight of the share of points in free space in the score.
CONTRADICTION_WEIGHT = 2.0

# Factors of the predicted step among the further starts.
STEP_FACTORS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)

# Steps along the x axis of the lidar among the further starts, as shares of the extent.
AHEAD_SHARES = (-0.08, 0.08, 0.16)

# Lower bound of the standard deviation of a translation.
FLOOR_M = 0.01

# Lower bound of the standard deviation of a rotation.
FLOOR_RAD = 0.001

# Largest number of coarse poses of a search that are aligned finely, and largest distance and turn between two of them
# that are one: with a larger one, a start in another valley may be lost.
NUM_FINE, SAME_M, SAME_RAD = 3, 0.1, 0.02

# Alignment from a first guess that is nearly right, and from other starts.
NARROW = (AlignmentLevel(1.0, 1000, 10), AlignmentLevel(1.0, 4000, 12, kernel_m=0.1))
WIDE = (AlignmentLevel(3.0, 300, 10),)


class SurfaceGeometry:
    """Point-to-plane alignment of surface elements.

    Args:
        model_config: preprocessing and pyramid of the encoder.
    """

    def __init__(self, model_config: ModelConfig) -> None:
        self._model_config = model_config

    def thin(self, points: Float[np.ndarray, "n 3"]) -> Scan | None:
        """Thins a scan as the encoder does, and estimates its surface; see `Geometry`.

        Args:
            points: finite, metres, in the frame of the lidar.

        Returns:
            The thinned scan; None if it is empty.
        """
        return lidar_scan(points, self._model_config.preprocess)

    def align(self, local_map: LocalMap, scan: Scan, T_map_scan: Pose) -> Alignment:
        """Aligns from a first guess that is nearly right; see `Geometry`.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guess.

        Returns:
            The pose.
        """
        return _aligned(local_map, scan, T_map_scan[None])[0]

    def search(self, local_map: LocalMap, scan: Scan, T_map_scan: Poses) -> Alignment:
        """Aligns all first guesses coarsely and the best of them finely; see `Geometry`.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guesses.

        Returns:
            The pose of the highest score: most elements meet planes, and fewest lie in free space.
        """
        coarse = align_on_host(scan.surface, local_map.surface, T_map_scan, WIDE).T_target_source
        matched = matched_shares(scan.surface, _planes(local_map, scan, coarse, NUM_SAMPLES // 3))
        best = _distinct(coarse[np.argsort(-matched, kind="stable")])
        return max(_aligned(local_map, scan, best), key=lambda found: found.score)

    def other_motions(self, T_last_scan: Pose, extent_m: float) -> Poses:
        """Returns variants of the predicted step, steps straight ahead, and turns on the spot; see `Geometry`.

        Args:
            T_last_scan: the predicted motion.
            extent_m: median range of the scan.

        Returns:
            The motions.
        """
        R, step = T_last_scan[:3, :3], T_last_scan[:3, 3]
        turns = [R @ Rotation.from_euler("z", turn, degrees=True).as_matrix() for turn in TURNS_DEG]
        spins = [R @ Rotation.from_euler("z", turn, degrees=True).as_matrix() for turn in SPINS_DEG]
        tilts = [Rotation.from_euler(*tilt, degrees=True).as_matrix() for tilt in itertools.product("xy", TILTS_DEG)]
        motions = [(R, factor * step) for factor in STEP_FACTORS]
        motions += [(R, np.array([share * extent_m, 0.0, 0.0])) for share in AHEAD_SHARES]
        motions += [(turned, translation) for turned in turns for translation in (np.zeros(3), step)]
        motions += [(turned, np.zeros(3)) for turned in spins]
        # A rocking vehicle tilts back, so its last rotation does not continue.
        motions.append((np.eye(3), step))
        motions += [(rotation, step) for tilt in tilts for rotation in (R @ tilt, tilt)]
        rotations, translations = (np.array(parts) for parts in zip(*motions, strict=True))
        return homogeneous(rotations, translations)


def _aligned(local_map: LocalMap, scan: Scan, starts: Poses) -> list[Alignment]:
    """Aligns from first guesses that are nearly right, and compares the scan with the map there."""
    T = align_on_host(scan.surface, local_map.surface, orthonormal(starts), NARROW).T_target_source
    planes = _planes(local_map, scan, T, ALL if scan.weak_axis is not None else NUM_SAMPLES)
    matched, contradicted = matched_shares(scan.surface, planes), contradicted_shares(local_map.surface, scan, T)
    scores = matched - CONTRADICTION_WEIGHT * contradicted
    columns = (column.tolist() for column in (matched, contradicted, scores))
    information = (_information(scan, planes.take(row), pose) for row, pose in enumerate(T))
    return list(map(Alignment, T, *columns, information))


def _planes(local_map: LocalMap, scan: Scan, T_map_scan: Poses, num_samples: int) -> Pairs:
    # Largest distance between an element and the element of the map whose plane it meets.
    return nearest_planes(scan.surface, local_map.surface, T_map_scan, 1.5, num_samples)


def _distinct(poses: Poses) -> Poses:
    """Returns the first poses that are apart from one another: starts of one valley end coarsely at one pose."""

    def is_near(one: int) -> Bool[np.ndarray, " s"]:
        apart_m = np.linalg.norm(poses[:, :3, 3] - poses[one, :3, 3], axis=1)
        # The Frobenius norm of the difference of two rotations is the root of 2 times a small angle between them.
        apart_rad = np.linalg.norm(poses[:, :3, :3] - poses[one, :3, :3], axis=(1, 2)) / np.sqrt(2)
        return (apart_m <= SAME_M) & (apart_rad <= SAME_RAD)

    return poses[apart(np.arange(len(poses), 0.0, -1.0), is_near, NUM_FINE)]


def _information(scan: Scan, planes: Pairs, T_map_scan: Pose) -> Information:
    """Returns the information of a pose by the planes that elements meet; along a corridor, firm ones alone count."""
    pairs = planes.take(planes.is_paired)
    if scan.weak_axis is not None:
        pairs = without_noise_along(planes, scan.surface, T_map_scan, scan.weak_axis)
    return with_least_covariance(plane_information(pairs, T_map_scan), FLOOR_M, FLOOR_RAD)
