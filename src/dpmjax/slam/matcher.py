"""The matcher of DeepPointMap's networks: encoding, proposals, registration, overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.confidence import gather_evidence, with_confidence
from dpmjax.deeppointmap.encoding import pyramid_of_cloud
from dpmjax.deeppointmap.matching import merge_clouds, thin_merged
from dpmjax.deeppointmap.model import Model, encode_pyramid, model_fingerprint
from dpmjax.deeppointmap.motion_choice import REFINEMENT
from dpmjax.deeppointmap.overlap_prediction import overlap_pairs
from dpmjax.deeppointmap.prepared_scans import CompactScan, PreparedScan, compact_scan, expand_scan
from dpmjax.deeppointmap.scan_registration import distinct_motions, match_clouds, register_each
from dpmjax.scans.surface_alignment import AlignmentLevel, align_surfaces, nearest_planes
from dpmjax.scans.surfaces import Surface
from dpmjax.scans.weak_directions import plane_information
from dpmjax.slam.interfaces import Match, Proposal, ThinnedScan
from dpmjax.slam.keyframe_map import Submap
from dpmjax.slam.local_map import joined_surface, placed_keyframe
from dpmjax.slam.loop_candidates import pooled_vector
from dpmjax.types import Registration

# Radius of `VerificationConfig.plane_radius_m` for surface elements, which are metres apart.
ELEMENT_RADIUS_M = 2.0


class NetworkMatcher:
    """The matcher of a trained model.

    Args:
        model: encoder, decoder and, at best, a calibration of its confidence.
    """

    def __init__(self, model: Model) -> None:
        verification = replace(model.config.verification, plane_radius_m=ELEMENT_RADIUS_M)
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
        scan, union = _surface(source._replace(scans=source.scans[:1])), _surface(target)
        T = align_surfaces(scan, union, np.asarray(found.T_target_source)[None], REFINEMENT)
        level = AlignmentLevel(config.plane_radius_m, config.num_samples, 1)
        information = plane_information(nearest_planes(scan, union, T, level).pairs, T[0])
        return Match(T[0], float(found.confidence), float(found.rmse), found.verification, information)


def _surface(submap: Submap) -> Surface:
    placed = zip(submap.scans, submap.T_submap_keyframe, strict=False)
    return joined_surface([placed_keyframe(scan, T) for scan, T in placed])


def _merged(submap: Submap) -> PreparedScan:
    """Merges descriptors; the number of scans is filled up to a power of two, so that few programs are compiled."""
    first, clouds = expand_scan(submap.scans[0]), [scan.cloud.described for scan in submap.scans]
    num_missing = (1 << (len(clouds) - 1).bit_length()) - len(clouds)
    clouds += [replace(clouds[0], mask=jnp.zeros_like(clouds[0].mask))] * num_missing
    T_submap_scan = np.concatenate([submap.T_submap_keyframe, np.tile(np.eye(4), (num_missing, 1, 1))])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *clouds)
    merged = merge_clouds(stacked, jnp.asarray(T_submap_scan, jnp.float32))
    return PreparedScan(thin_merged(merged, len(clouds[0].mask)), first.measured)
