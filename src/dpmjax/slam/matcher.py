"""What SLAM asks of a matcher, and the one that asks DeepPointMap's networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.batches import overlap_pairs
from dpmjax.deeppointmap.compact_scans import CompactScan, compact_scan, expand_scan
from dpmjax.deeppointmap.encoding import encode
from dpmjax.deeppointmap.matching import merge_clouds
from dpmjax.deeppointmap.model import Model, model_fingerprint
from dpmjax.deeppointmap.scan_registration import PreparedScan, register_each
from dpmjax.deeppointmap.verification import MeasuredScan, verify_motion
from dpmjax.scans.compact import CompactImage, CompactSurface
from dpmjax.scans.plane_information import plane_information
from dpmjax.scans.surface_alignment import AlignmentLevel, align_surfaces, pair_with_planes
from dpmjax.slam.alignment import Alignment
from dpmjax.slam.columns import Arrays, from_columns, to_columns
from dpmjax.slam.keyframes import Pose, Submap
from dpmjax.slam.retrieval import pooled_vector
from dpmjax.types import DescriptorCloud, Registration, Verification

MIN_ALIGNED_POINTS = 4000
"""Scans with fewer surface points share too few planes: against the local map of many scans they are placed better."""


class Match(NamedTuple):
    """A registration without a first guess.

    Attributes:
        T_target_source: float64.
        probability: that it is right within 2 m and 5 degrees, if the matcher is calibrated; else a score in [0, 1].
        rmse: of the pairs that it rests on, metres.
        verification: how well the scans agree under it; None where the matcher has no scans.
        information: (6, 6) inverse covariance by the planes of the scans, in the tangent of the source, translation
            first; None where it is not known.
    """

    T_target_source: Pose
    probability: float
    rmse: float
    verification: Verification | None = None
    information: Float[np.ndarray, "6 6"] | None = None


class Matcher(Protocol):
    """Recognises places and registers scans and maps without a first guess.

    Attributes:
        fingerprint: descriptions are compared only with those of a matcher of the same fingerprint.
    """

    @property
    def fingerprint(self) -> str: ...  # noqa: D102

    def describe(self, points: Float[np.ndarray, "n 3"], measured: Any) -> Any:
        """Prepares a scan for any number of registrations.

        Args:
            points: metres, in the frame of the lidar.
            measured: what the geometry has measured of it.

        Returns:
            A record that only the matcher reads.
        """
        ...

    def pack(self, description: Any) -> Arrays:
        """Turns a description into arrays for a file.

        Args:
            description: from `describe`.

        Returns:
            Arrays by name.
        """
        ...

    def unpack(self, arrays: Arrays) -> Any:
        """Makes a description again, bit for bit.

        Args:
            arrays: from `pack`.

        Returns:
            The description.
        """
        ...

    def vector(self, description: Any) -> Float[np.ndarray, " c"]:
        """Returns one vector for retrieval, of a length that is the same for all scans.

        Args:
            description: from `describe`.

        Returns:
            The vector.
        """
        ...

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers pairs of source and target.

        Args:
            pairs: submaps; a single scan is a submap of one.

        Returns:
            One match a pair, between the frames of the two submaps.
        """
        ...

    def align_scans(self, source: Any, target: Any, T_target_source: Pose) -> Alignment | None:
        """Aligns two scans from a motion that is nearly right.

        Args:
            source: description of a scan.
            target: of the other.
            T_target_source: first guess.

        Returns:
            The scan in the frame of the other; None where the descriptions hold too few points for that.
        """
        ...

    def overlaps(self, source: Any, targets: Sequence[Any]) -> Float[np.ndarray, " n"]:
        """Estimates the probability that scans see the same place, for many scans at once.

        Args:
            source: description of a scan.
            targets: of the others; at least one.

        Returns:
            The probabilities.
        """
        ...


class NetworkMatcher:
    """The matcher of a trained model.

    Args:
        model: encoder, decoder and, at best, a calibration of its confidence.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.fingerprint = model_fingerprint(model)

    def describe(self, points: Float[np.ndarray, "n 3"], measured: MeasuredScan) -> CompactScan:
        """Encodes a scan, and keeps of it what a map needs; see `Matcher`.

        Args:
            points: metres, in the frame of the lidar.
            measured: surface and free space of the scan.

        Returns:
            The compact scan.
        """
        return compact_scan(jax.device_get(encode(self._model, points)), measured)

    def pack(self, description: CompactScan) -> Arrays:
        """Keeps all arrays of a scan; see `Matcher`.

        Args:
            description: from `describe`.

        Returns:
            Arrays by name.
        """
        cloud = to_columns([description], "scan", without=("surface", "image"))
        return cloud | to_columns([description.surface], "surface") | to_columns([description.image], "image")

    def unpack(self, arrays: Arrays) -> CompactScan:
        """Makes the scan again; see `Matcher`.

        Args:
            arrays: from `pack`.

        Returns:
            The compact scan.
        """
        (scan,) = from_columns(CompactScan, arrays, "scan")
        (surface,) = from_columns(CompactSurface, arrays, "surface")
        (image,) = from_columns(CompactImage, arrays, "image")
        return scan._replace(surface=surface, image=image)

    def vector(self, description: CompactScan) -> Float[np.ndarray, " c"]:
        """Pools the descriptors; see `Matcher`.

        Args:
            description: from `describe`.

        Returns:
            The vector.
        """
        return pooled_vector(description.descriptors)

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers merged descriptors and verifies by the central scans; see `Matcher`.

        Args:
            pairs: submaps.

        Returns:
            One match a pair.
        """
        prepared = [(_merged(source), _merged(target)) for source, target in pairs]
        found = register_each(self._model, prepared, refine=True)
        return [self._match(*scans, match) for scans, match in zip(prepared, found, strict=True)]

    def align_scans(self, source: CompactScan, target: CompactScan, T_target_source: Pose) -> Alignment | None:
        """Aligns the surfaces of two scans point to plane; see `Matcher`.

        Args:
            source: a scan.
            target: the other.
            T_target_source: first guess.

        Returns:
            The motion, and how well the scans agree under it; None for sparse scans.
        """
        if min(len(source.surface.points), len(target.surface.points)) < MIN_ALIGNED_POINTS:
            return None
        config = self._model.config.verification
        scan, other = expand_scan(source).measured, expand_scan(target).measured
        T = align_surfaces(scan.surface, other.surface, T_target_source, config.refinement).T_target_source
        shares, information = verify_motion(scan, other, T, config), self._information(scan, other, T)
        return Alignment(T, shares.matched_share, shares.contradicted_share, shares.score, information)

    def overlaps(self, source: CompactScan, targets: Sequence[CompactScan]) -> Float[np.ndarray, " n"]:
        """Asks the overlap head; see `Matcher`.

        Args:
            source: a scan.
            targets: the others.

        Returns:
            The probabilities.
        """
        clouds = [target.descriptors for target in targets]
        return np.asarray(overlap_pairs(self._model, [source.descriptors] * len(targets), clouds))

    def _match(self, source: PreparedScan, target: PreparedScan, found: Registration) -> Match:
        T = np.asarray(found.T_target_source, np.float64)
        information = self._information(source.measured, target.measured, T)
        return Match(T, float(found.confidence), float(found.rmse), found.verification, information)

    def _information(self, source: MeasuredScan, target: MeasuredScan, T: Pose) -> Float[np.ndarray, "6 6"]:
        config = self._model.config.verification
        level = AlignmentLevel(config.plane_radius_m, config.num_samples, 1)
        pairs = pair_with_planes(source.surface, target.surface, T, level)
        return plane_information(pairs, T, max_residual_m=config.plane_distance_m)


def _merged(submap: Submap) -> PreparedScan:
    """Merges descriptors; the number of scans is filled up to a power of two, so that few programs are compiled."""
    first = expand_scan(submap.descriptions[0])
    num = len(submap.descriptions)
    if num == 1:
        return first
    capacity = 1 << (num - 1).bit_length()
    clouds = [description.descriptors for description in submap.descriptions]
    clouds += [_without_points(clouds[0])] * (capacity - num)
    T_submap_scan = np.concatenate([submap.T_submap_keyframe, np.tile(np.eye(4), (capacity - num, 1, 1))])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *clouds)
    return PreparedScan(merge_clouds(stacked, jnp.asarray(T_submap_scan, jnp.float32)), first.measured)


def _without_points(cloud: DescriptorCloud) -> DescriptorCloud:
    return replace(cloud, mask=jnp.zeros_like(cloud.mask))
