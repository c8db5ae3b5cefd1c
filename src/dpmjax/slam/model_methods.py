"""The methods of a trained model: its networks recognise places, and point-to-plane geometry is the odometry.

On the host, a scan is aligned with the local map; encoding, proposals, registration and overlap are those of
DeepPointMap (section 4).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from dpmjax.checks import require_type
from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.encoding import pooled_vector, pyramid_of_cloud, thin_scan
from dpmjax.deeppointmap.matching import merge_clouds, thin_merged
from dpmjax.deeppointmap.model import Model, encode_pyramid, model_fingerprint
from dpmjax.deeppointmap.model_config import ModelConfig
from dpmjax.deeppointmap.motion_choice import ELEMENT_RADIUS_M, REFINEMENT
from dpmjax.deeppointmap.overlap_prediction import overlap_pairs, require_overlap
from dpmjax.deeppointmap.prepared_scans import CompactScan, PreparedScan, compact_scan, expand_scan
from dpmjax.deeppointmap.scan_registration import distinct_motions, match_clouds, register_each
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
from dpmjax.slam.config import OdometryConfig, SlamConfig
from dpmjax.slam.interfaces import Alignment, Match, Proposal, SlamMethods, ThinnedScan
from dpmjax.slam.keyframe_map import KeyframeMap, Submap
from dpmjax.slam.local_map import LocalMap, joined_surface, placed_keyframes
from dpmjax.types import Pose, Poses, Registration

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


class NetworkMatcher:
    """The matcher of a trained model; a `ValueError` refuses one that cannot predict overlap.

    Args:
        model: encoder, decoder and, at best, a calibration of its confidence.
    """

    def __init__(self, model: Model) -> None:
        require_overlap(model)
        # Other keyframes and the map confirm a motion, so no other place needs to be tried for it.
        verification = replace(model.config.verification, plane_radius_m=ELEMENT_RADIUS_M, num_lookalikes=0)
        self._model = replace(model, config=replace(model.config, verification=verification))
        self.fingerprint = model_fingerprint(model)

    def encode(self, scan: ThinnedScan) -> CompactScan:
        """Encodes a scan in the compact form of a map; see `Matcher`.

        Args:
            scan: the scan.

        Returns:
            The compact scan.
        """
        config = self._model.config
        pyramid = pyramid_of_cloud(scan.cloud, config)
        cloud = encode_pyramid(self._model, pyramid, num_elements=config.pyramid.stages[0].num_points)
        return compact_scan(jax.device_get(cloud), scan.measured.image)

    def vector(self, scan: CompactScan) -> Float[np.ndarray, " c"]:
        """Pools the descriptors; see `Matcher`.

        Args:
            scan: from `encode`.

        Returns:
            The vector.
        """
        return pooled_vector(scan.cloud.described)

    def propose(self, source: CompactScan, target: CompactScan, num_motions: int) -> Proposal:
        """Registers two descriptor clouds by the decoder; see `Matcher`.

        Args:
            source: a scan.
            target: a second scan.
            num_motions: largest number of motions.

        Returns:
            Distinct motions, best first.
        """
        matching = self._model.config.matching
        if matching.consensus is not None:
            matching = replace(matching, consensus=replace(matching.consensus, num_motions=num_motions))
        hypotheses = match_clouds(self._model, source.cloud, target.cloud, config=matching)
        best = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), hypotheses)
        calibration = self._model.config.calibration
        confident = with_confidence(best, gather_evidence(hypotheses, 0, None), calibration)
        return Proposal(distinct_motions(hypotheses), float(confident.confidence), calibration is not None)

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers merged descriptors, verifies by the central scans, aligns with the whole target; see `Matcher`.

        Args:
            pairs: submaps.

        Returns:
            One match a pair.
        """
        prepared = [(_merged(source), _merged(target)) for source, target in pairs]
        found = register_each(self._model, prepared, refine=True)
        return [self._match(*pair, match) for pair, match in zip(pairs, found, strict=True)]

    def overlaps(self, source: CompactScan, targets: Sequence[CompactScan]) -> Float[np.ndarray, " n"]:
        """Predicts the probabilities of overlap; see `Matcher`.

        Args:
            source: a scan.
            targets: the scans that it is compared with.

        Returns:
            The probabilities.
        """
        clouds = [target.cloud.described for target in targets]
        return np.asarray(overlap_pairs(self._model, [source.cloud.described] * len(targets), clouds))

    def _match(self, source: Submap, target: Submap, found: Registration) -> Match:
        config = self._model.config.verification
        scan, union = joined_surface(placed_keyframes(source)[:1]), joined_surface(placed_keyframes(target))
        T = align_surfaces(scan, union, np.asarray(found.T_target_source)[None], REFINEMENT)
        pairs = nearest_planes(scan, union, T, config.plane_radius_m, config.num_samples).pairs
        information = plane_information(pairs, T[0])
        return Match(T[0], float(found.confidence), float(found.rmse), found.verification, information)


def _merged(submap: Submap) -> PreparedScan:
    """Merges descriptors; the number of scans is filled up to a power of two, so that few programs are compiled."""
    first, clouds = expand_scan(submap.scans[0]), [scan.cloud.described for scan in submap.scans]
    num_missing = (1 << (len(clouds) - 1).bit_length()) - len(clouds)
    clouds += [replace(clouds[0], mask=jnp.zeros_like(clouds[0].mask))] * num_missing
    T_submap_scan = np.concatenate([submap.T_submap_keyframe, np.tile(np.eye(4), (num_missing, 1, 1))])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *clouds)
    merged = merge_clouds(stacked, jnp.asarray(T_submap_scan, jnp.float32))
    return PreparedScan(thin_merged(merged, len(clouds[0].mask)), first.measured)


def make_methods(model: Model, config: SlamConfig | None = None, *, weights: str = "") -> SlamMethods:
    """Makes the methods of a trained model: its networks, and point-to-plane geometry.

    Args:
        model: encoder and decoder.
        config: settings of all stages.
        weights: name of the weights, noted in the map.

    Returns:
        The methods.

    Raises:
        ValueError: if the model is none, or the settings are no `SlamConfig`.
    """
    config = config or SlamConfig()
    require_type("model", model, Model, "load_model")
    require_type("config", config, SlamConfig, "SlamConfig or slam_preset")
    return SlamMethods(NetworkMatcher(model), SurfaceGeometry(model.config, config.odometry), config, weights)


def methods_for(model: Model | SlamMethods, slam_map: KeyframeMap) -> SlamMethods:
    """Returns given methods unchanged, and makes the methods of a model with the settings of a map."""
    require_type("slam_map", slam_map, KeyframeMap, "load_map")
    if isinstance(model, SlamMethods):
        return model
    return make_methods(model, None if slam_map.origin is None else slam_map.origin.config)


def as_methods(model: Model | SlamMethods, config: SlamConfig | None) -> SlamMethods:
    """Returns given methods unchanged, and makes the methods of a model.

    Args:
        model: a trained model, or methods.
        config: settings for a model; methods carry their own.

    Returns:
        The methods.

    Raises:
        ValueError: if methods come with a configuration.
    """
    if isinstance(model, SlamMethods):
        if config is not None:
            raise ValueError("config: expected None with methods, which carry their own")
        return model
    return make_methods(model, config)
