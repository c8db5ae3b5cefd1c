"""Point-to-plane geometry on the host: thins scans, and aligns them with the local map."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap.encoding import thin_scan
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.geometry.se3 import orthonormal
from dpmjax.scans.preprocess import first_of_each_voxel
from dpmjax.scans.surface_alignment import NearestPlanes, align_surfaces, nearest_planes
from dpmjax.scans.surfaces import Surface, SurfaceConfig, range_image, surface_at, view_points
from dpmjax.scans.weak_directions import (
    plane_information,
    surface_in_corridor,
    with_least_covariance,
    without_noise_along,
)
from dpmjax.sequences import homogeneous
from dpmjax.slam.config import OdometryConfig
from dpmjax.slam.interfaces import Alignment, ThinnedScan
from dpmjax.slam.local_map import LocalMap
from dpmjax.types import Pose, Poses

# Turns about the x and y axes among the further starts.
TILTS_DEG = (-8.0, 8.0)

# Turns about the vertical among the further starts.
TURNS_DEG = (-10.0, 10.0, -20.0, 20.0, -35.0, 35.0, -50.0, 50.0)

# Turns on the spot, of a robot between two scans.
SPINS_DEG = (-80.0, 80.0, -110.0, 110.0, -145.0, 145.0, 180.0)

# A scan with fewer flat surface elements counts as empty.
MIN_NUM_POINTS = 100

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

# Number of elements of the local map that are compared with the free space of a scan.
MAX_VIEWED = 4000

# Largest number of surface elements of a scan: denser scans would align ring with ring.
MAX_ELEMENTS = 3000

# In scans of 1,000 points neighbours are farther away.
NEIGHBOURHOODS = SurfaceConfig(sparse_radius_share=1.5)

# One element of each voxel of this size is chosen first, because ground near the lidar is dense.
SPREAD_M = 1.5

# Number of starts of a search that are aligned finely.
NUM_FINE = 3


class SurfaceGeometry:
    """Point-to-plane alignment of surface elements.

    Args:
        model_config: preprocessing and pyramid of the encoder.
        config: settings; None takes the defaults.
    """

    def __init__(self, model_config: ModelConfig, config: OdometryConfig | None = None) -> None:
        self._model_config = model_config
        self.config = config or OdometryConfig()

    def thin(self, points: Float[np.ndarray, "n 3"]) -> ThinnedScan | None:
        """Thins a scan as the encoder does, and estimates its surface; see `Geometry`.

        Args:
            points: finite, metres, in the frame of the lidar.

        Returns:
            The thinned scan; None if it is empty.
        """
        if len(points) < MIN_NUM_POINTS:
            return None
        cloud = thin_scan(points, self._model_config)
        thinned = np.asarray(cloud.points)[np.asarray(cloud.mask)].astype(np.float64)
        surface = surface_at(thinned, _spread_rows(thinned), NEIGHBOURHOODS)
        if np.count_nonzero(surface.flatness) < MIN_NUM_POINTS:
            return None
        surface, weak_axis = surface_in_corridor(surface)
        extent_m = float(np.median(np.linalg.norm(thinned, axis=1)))
        return ThinnedScan(cloud, MeasuredScan(surface, range_image(thinned)), extent_m, weak_axis)

    def align(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: Pose) -> Alignment:
        """Aligns from a first guess that is nearly right; see `Geometry`.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guess.

        Returns:
            The pose.
        """
        return self._aligned(local_map, scan, T_map_scan[None])[0]

    def search(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: Poses) -> Alignment:
        """Aligns all first guesses coarsely and the best of them finely; see `Geometry`.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guesses.

        Returns:
            The pose under which most elements meet planes and fewest lie in free space.
        """
        surface = scan.measured.surface
        coarse = list(align_surfaces(surface, local_map.surface, T_map_scan, self.config.wide))
        coarse.sort(key=lambda T: -_matched_share(surface, self._planes(local_map, surface, T, NUM_SAMPLES // 3)))
        return max(self._aligned(local_map, scan, np.array(coarse[:NUM_FINE])), key=lambda found: found.score)

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

    def _aligned(self, local_map: LocalMap, scan: ThinnedScan, starts: Poses) -> list[Alignment]:
        found = align_surfaces(scan.measured.surface, local_map.surface, orthonormal(starts), self.config.narrow)
        return [self._scored(local_map, scan, T) for T in found]

    def _scored(self, local_map: LocalMap, scan: ThinnedScan, T: Pose) -> Alignment:
        surface = scan.measured.surface
        planes = self._planes(local_map, surface, T, NUM_SAMPLES)
        matched, contradicted = _matched_share(surface, planes), _contradicted_share(local_map, scan.measured, T)
        pairs = planes.pairs
        if scan.weak_axis is not None:
            is_firm = planes.meets & (surface.flatness[surface.samples[: planes.meets.shape[1]]] > 0)
            pairs = without_noise_along(pairs, T[:3, :3] @ scan.weak_axis, is_firm[planes.is_paired])
        information = with_least_covariance(plane_information(pairs, T), FLOOR_M, FLOOR_RAD)
        return Alignment(T, matched, contradicted, matched - CONTRADICTION_WEIGHT * contradicted, information)

    def _planes(self, local_map: LocalMap, surface: Surface, T_map_scan: Pose, num_samples: int) -> NearestPlanes:
        return nearest_planes(surface, local_map.surface, T_map_scan[None], self.config.plane_radius_m, num_samples)


def _spread_rows(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " e"]:
    """Chooses points in random order: first one of each coarse voxel, then others."""
    rng, is_first = np.random.default_rng(0), np.zeros(len(points), bool)
    is_first[first_of_each_voxel(points, SPREAD_M)] = True
    return np.concatenate([rng.permutation(np.flatnonzero(part)) for part in (is_first, ~is_first)])[:MAX_ELEMENTS]


def _matched_share(surface: Surface, planes: NearestPlanes) -> float:
    """Returns the mean share of elements that meet planes, over the main directions of their normals.

    Ground meets ground under any motion: without the mean it would outweigh the walls.
    """
    meets = planes.meets[0]
    direction = np.argmax(np.abs(surface.normals[surface.samples[: len(meets)]]), axis=1)
    counts = np.bincount(direction, minlength=3)
    shares = np.bincount(direction, weights=meets, minlength=3) / np.maximum(counts, 1)
    # A direction of few elements counts less, because its share is uncertain.
    return float(np.average(shares, weights=np.minimum(counts, counts.max() / 3) + 1e-9))


def _contradicted_share(local_map: LocalMap, measured: MeasuredScan, T_map_scan: Pose) -> float:
    """Returns the share of visible elements of the map that lie in the free space of the scan."""
    points = local_map.surface.points[local_map.surface.samples[:MAX_VIEWED]]
    views = view_points(measured.image, (points - T_map_scan[:3, 3]) @ T_map_scan[:3, :3])
    return float(views.is_contradicted.sum()) / max(int(views.is_visible.sum()), 1)
