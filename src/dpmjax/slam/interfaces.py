"""The parts of SLAM that are arguments: a matcher, the geometry of odometry, and settings.

The module `model_methods` makes these parts of a trained model. `SurfaceGeometry` aligns scans with the local map, and
`NetworkMatcher` recognises places.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.compact_scans import CompactScan
from dpmjax.scan.lidar.record import Scan
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.keyframe_map import MapOrigin, Submap
from dpmjax.slam.local_map import LocalMap
from dpmjax.types import AnyArray, Information, Pose, Poses, Verification


class Alignment(NamedTuple):
    """A scan in the frame of the local map.

    Attributes:
        T_map_scan: float64 pose of the scan.
        matched_share: share of the elements of the scan that meet planes of the map.
        contradicted_share: share of the visible elements of the map that lie in the free space of the scan.
        score: `matched_share` less the weighted `contradicted_share`.
        information: (6, 6) inverse covariance in the tangent of the scan, translation first: weak along a corridor.
    """

    T_map_scan: Pose
    matched_share: float
    contradicted_share: float
    score: float
    information: Information


class Geometry(Protocol):
    """Thins scans and aligns them with the local map. `thin` runs in a thread of its own, one scan ahead."""

    def thin(self, points: Float[np.ndarray, "n 3"]) -> Scan | None:
        """Prepares a scan.

        Args:
            points: finite, metres, in the frame of the lidar.

        Returns:
            The thinned scan; None for a scan without enough flat points.
        """

    def align(self, local_map: LocalMap, scan: Scan, T_map_scan: Pose) -> Alignment:
        """Aligns a scan from a first guess that is nearly right.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guess.

        Returns:
            The alignment.
        """

    def search(self, local_map: LocalMap, scan: Scan, T_map_scan: Poses) -> Alignment:
        """Aligns a scan from several first guesses, coarse to fine.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guesses; at least one.

        Returns:
            The alignment of the highest score.
        """

    def other_motions(self, T_last_scan: Pose, extent_m: float) -> Poses:
        """Returns possible motions of a vehicle besides the predicted one.

        Args:
            T_last_scan: the predicted motion.
            extent_m: median range of the scan.

        Returns:
            The motions.
        """


class Match(NamedTuple):
    """A registration without a first guess.

    Attributes:
        T_target_source: float64 motion.
        probability: P(right within 2 m and 5 degrees), if the matcher is calibrated; else a score in [0, 1].
        rmse: root mean square error of the inlier pairs, metres.
        verification: agreement of the scans under the motion; None where the matcher has no scans.
        information: (6, 6) inverse covariance by the planes of the scans, in the tangent of the source, translation
            first; None if it is unknown. `Matcher.match` computes it from the pairs of points.
    """

    T_target_source: Pose
    probability: float
    rmse: float
    verification: Verification | None = None
    information: Information | None = None


class Proposal(NamedTuple):
    """Motions of a scan that descriptors alone propose.

    Attributes:
        T_target_source: (h, 4, 4) float64, the most likely first.
        probability: P(correct) of the first motion, or a score for a model without calibration.
        is_calibrated: True for a probability.
    """

    T_target_source: Poses
    probability: float
    is_calibrated: bool = True


class Matcher(Protocol):
    """Recognises places and registers scans and maps without a first guess.

    Attributes:
        fingerprint: text that is equal for equal matchers; keyframes of different fingerprints are not compared.
    """

    @property
    def fingerprint(self) -> str:
        """Returns a text that is equal for equal matchers."""

    def encode(self, scan: Scan) -> CompactScan:
        """Prepares a scan for any number of registrations.

        If every scan is encoded, this runs one scan ahead, in the thread of `Geometry.thin`.

        Args:
            scan: the scan.

        Returns:
            Descriptors, surface elements and free space.
        """

    def vector(self, scan: CompactScan) -> Float[np.ndarray, " c"]:
        """Returns the vector of a scan for retrieval; its size is the same for all scans.

        Args:
            scan: from `encode`.

        Returns:
            The vector.
        """

    def propose(self, source: CompactScan, target: CompactScan, num_motions: int) -> Proposal:
        """Registers a scan by descriptors alone.

        Args:
            source: a scan.
            target: a second scan.
            num_motions: largest number of motions.

        Returns:
            Distinct motions; at least one.
        """

    def register(self, pairs: Sequence[tuple[Submap, Submap]]) -> list[Match]:
        """Registers pairs of source and target, and verifies them by their surfaces.

        Args:
            pairs: submaps; a single scan is a submap of one.

        Returns:
            One match a pair, between the frames of the two submaps.
        """

    def match(self, source: Submap, target: Submap) -> Match:
        """Registers two submaps by descriptors alone (DeepPointMap section 3.2).

        Args:
            source: submap; a single scan is a submap of one.
            target: the second submap.

        Returns:
            The motion between the frames of the two; `probability` is the mean score of the best pairs.
        """

    def overlaps(self, source: CompactScan, targets: Sequence[CompactScan]) -> Float[np.ndarray, " n"]:
        """Estimates the probability that scans see the same place, for many scans at once.

        Args:
            source: a scan.
            targets: the scans that it is compared with; at least one.

        Returns:
            The probabilities.
        """


class SlamMethods(NamedTuple):
    """The parts of SLAM that are arguments.

    Attributes:
        matcher: recognises places and registers scans without a first guess.
        geometry: aligns a scan with recent ones.
        config: settings of all stages.
        weights: name of the weights, noted in the map; may be empty.
    """

    matcher: Matcher
    geometry: Geometry
    config: SlamConfig
    weights: str = ""

    @property
    def origin(self) -> MapOrigin:
        """The origin that maps of these methods note."""
        return MapOrigin(self.matcher.fingerprint, self.config, self.weights)


class TimedScan(NamedTuple):
    """A raw scan with the time of each point, to be deskewed by the predicted motion.

    Attributes:
        points: (n, 3) metres, each in the frame of the lidar at its own moment.
        offsets: (n,) times since the scan's pose, as shares of the time between scans; see `scans.deskew`.
    """

    points: Float[AnyArray, "n 3"]
    offsets: Float[AnyArray, " n"]


# A raw scan or its file, or a scan with times.
AnyScan = Float[AnyArray, "_n 3"] | str | Path | TimedScan


class PreparedInput(NamedTuple):
    """A scan after the work that needs no map.

    Attributes:
        num_points: number of points of the raw scan.
        thinned: the thinned scan; None if it is empty.
        T_turn: predicted motion that a scan with times was deskewed by; None for a scan without times.
        compact: the encoded scan; None if it was not encoded.
    """

    num_points: int
    thinned: Scan | None
    T_turn: Pose | None = None
    compact: CompactScan | None = None
