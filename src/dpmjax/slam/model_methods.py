"""The methods of a trained model: its networks recognise places, and point-to-plane geometry is the odometry.

Encoding, proposals, registration and overlap are those of DeepPointMap (section 4).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from dpmjax.checks import require_type
from dpmjax.deeppointmap.compact_scans import CompactScan, compact_scan, expand_elements, expand_scan
from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.encoding import descriptors_of, pooled_vector, pyramid_of_cloud
from dpmjax.deeppointmap.matching import MatchConfig, merge_clouds, thin_merged
from dpmjax.deeppointmap.model import Model, encode_pyramid, model_fingerprint
from dpmjax.deeppointmap.overlap_prediction import overlap_pairs, require_overlap
from dpmjax.deeppointmap.registration import distinct_motions, match_clouds, register_each
from dpmjax.geometry.se3 import orthonormal
from dpmjax.scan.lidar.align import align_on_host
from dpmjax.scan.lidar.choose import ELEMENT_RADIUS_M, REFINEMENT
from dpmjax.scan.lidar.pairs import nearest_planes
from dpmjax.scan.lidar.preprocess import cloud_without_outliers
from dpmjax.scan.lidar.record import Scan
from dpmjax.scan.lidar.slide import diagonal_information, plane_information
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.interfaces import Match, Proposal, SlamMethods
from dpmjax.slam.keyframe_map import KeyframeMap, Submap
from dpmjax.slam.local_map import joined_surface, placed_keyframes
from dpmjax.slam.surface_geometry import SurfaceGeometry
from dpmjax.types import DescriptorCloud, Information, Pose, Registration

log = logging.getLogger(__name__)

# Matching as published: the best pairs of both softmaxes, without a consensus.
PUBLISHED = MatchConfig()

# Information of a motion without any pair.
UNKNOWN = diagonal_information(1000.0, np.pi)


class NetworkMatcher:
    """The matcher of a trained model. A model that cannot predict overlap raises a `ValueError`.

    Args:
        model: encoder, decoder and, at best, a calibration of its confidence.
        by_head: True predicts overlap by the decoder's head if it is trained, as published; else a regression does.
    """

    def __init__(self, model: Model, *, by_head: bool = False) -> None:
        require_overlap(model)
        # Other keyframes and the map confirm a motion, so no other place needs to be tried for it.
        verification = replace(model.config.verification, plane_radius_m=ELEMENT_RADIUS_M, num_lookalikes=0)
        self._model = replace(model, config=replace(model.config, verification=verification))
        self._overlap_model = without_regression(self._model) if by_head else self._model
        self.fingerprint = model_fingerprint(model)

    def encode(self, scan: Scan) -> CompactScan:
        """Encodes a scan in the compact form of a map; see `Matcher`.

        Args:
            scan: the scan.

        Returns:
            The compact scan.

        Raises:
            ValueError: if the scan has no thinned points.
        """
        config = self._model.config
        if scan.thinned is None:
            raise ValueError("scan: expected the thinned points of lidar_scan, got none")
        pyramid = pyramid_of_cloud(cloud_without_outliers(scan.thinned, config.preprocess), config)
        cloud = encode_pyramid(self._model, pyramid, num_elements=config.pyramid.stages[0].num_points)
        return compact_scan(jax.device_get(cloud), scan.image)

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

    def match(self, source: Submap, target: Submap) -> Match:
        """Registers merged descriptors as published, without consensus and verification; see `Matcher`.

        Args:
            source: submap.
            target: the second submap.

        Returns:
            The match.
        """
        found = match_clouds(self._model, union_of(source), union_of(target), config=PUBLISHED)
        T = orthonormal(np.asarray(found.T_target_source[0]))
        ends = [expand_elements(submap.scans[0].elements) for submap in (source, target)]
        a, b = (np.asarray(elements.positions)[np.asarray(elements.mask)] for elements in ends)
        return Match(T, float(found.mean_score[0]), float(found.rmse[0]), None, point_information(a, b, T))

    def overlaps(self, source: CompactScan, targets: Sequence[CompactScan]) -> Float[np.ndarray, " n"]:
        """Predicts the probabilities of overlap; see `Matcher`.

        Args:
            source: a scan.
            targets: the scans that it is compared with.

        Returns:
            The probabilities.
        """
        clouds = [target.cloud.described for target in targets]
        return np.asarray(overlap_pairs(self._overlap_model, [source.cloud.described] * len(targets), clouds))

    def _match(self, source: Submap, target: Submap, found: Registration) -> Match:
        config = self._model.config.verification
        scan, union = joined_surface(placed_keyframes(source)[:1]), joined_surface(placed_keyframes(target))
        T = align_on_host(scan, union, np.asarray(found.T_target_source)[None], REFINEMENT).T_target_source
        pairs = nearest_planes(scan, union, T, config.plane_radius_m, config.num_samples)
        information = plane_information(pairs.take(pairs.is_paired), T[0])
        return Match(T[0], float(found.confidence), float(found.rmse), found.verification, information)


def without_regression(model: Model) -> Model:
    """Removes the regression of overlap from a model with a trained overlap head, so that the head predicts.

    Args:
        model: encoder and decoder.

    Returns:
        The model. If the head is untrained, it is unchanged, with a warning.
    """
    if "overlap" in model.config.trained:
        return replace(model, config=replace(model.config, overlap=None))
    log.warning("the overlap head of these weights is untrained: a regression on the matches detects loops instead")
    return model


def _merged(submap: Submap) -> Scan:
    """Merges descriptors, without copies of one place, for the verification by the central scan."""
    first = expand_scan(submap.scans[0])
    merged = thin_merged(union_of(submap), len(descriptors_of(first).described.mask))
    return first._replace(descriptors=merged)


def union_of(submap: Submap) -> DescriptorCloud:
    """Merges descriptors. Padding makes the number of scans a power of two, so that few programs are compiled.

    Args:
        submap: keyframes and poses.

    Returns:
        Descriptors in the frame of the submap.
    """
    clouds = [scan.cloud.described for scan in submap.scans]
    num_missing = (1 << (len(clouds) - 1).bit_length()) - len(clouds)
    clouds += [replace(clouds[0], mask=jnp.zeros_like(clouds[0].mask))] * num_missing
    T_submap_scan = np.concatenate([submap.T_submap_keyframe, np.tile(np.eye(4), (num_missing, 1, 1))])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *clouds)
    return merge_clouds(stacked, jnp.asarray(T_submap_scan, jnp.float32))


def point_information(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], T_target_source: Pose
) -> Information:
    """Estimates the information of a motion by the target's points that meet points of the source.

    It is the sum of G^T G over the points q, with G = [I, -[q]x]. So each point counts one (square metre)^-1 (published
    configuration).

    Args:
        source: points in the frame of the source, metres.
        target: points in the frame of the target.
        T_target_source: the motion.

    Returns:
        (6, 6) in the tangent of the source, translation first; nearly zero where no points meet.
    """
    moved = (target - T_target_source[:3, 3]) @ T_target_source[:3, :3]
    # Points nearer than this under a motion are pairs of its information (published configuration).
    # Points beyond the radius have the number of points as their row.
    rows = np.asarray(cKDTree(moved).query(source, distance_upper_bound=1.0)[1])
    q = moved[rows[rows < len(moved)]]
    jacobian = np.zeros((len(q), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    # Columns of -[q]x.
    for column, axis in enumerate(np.eye(3)):
        jacobian[:, :, 3 + column] = np.cross(axis, q)
    return np.einsum("nki,nkj->ij", jacobian, jacobian) + UNKNOWN


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
    matcher = NetworkMatcher(model, by_head=config.method == "descriptors")
    return SlamMethods(matcher, SurfaceGeometry(model.config), config, weights)


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
