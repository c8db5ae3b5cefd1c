"""Records of odometry, and the interface of the geometry that aligns scans with the local map (`odometry`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from dpmjax.deeppointmap.verification import MeasuredScan
from dpmjax.slam.keyframes import Pose
from dpmjax.slam.local_map import LocalMap
from dpmjax.types import PointCloud


class ThinnedScan(NamedTuple):
    """A scan after its one thinning.

    Attributes:
        cloud: thinned points, metres, in the frame of the lidar; input of the encoder.
        measured: their surface and free space.
        extent_m: median range of the thinned points.
    """

    cloud: PointCloud
    measured: MeasuredScan
    extent_m: float


class Alignment(NamedTuple):
    """A scan in the frame of the local map.

    Attributes:
        T_map_scan: float64.
        matched_share: share of the elements of the scan that meet planes of the map.
        contradicted_share: share of the visible elements of the map that lie in the free space of the scan.
        score: `matched_share` less the weighted `contradicted_share`.
        information: (6, 6) inverse covariance in the tangent of the scan, translation first: weak along a corridor.
    """

    T_map_scan: Pose
    matched_share: float
    contradicted_share: float
    score: float
    information: Float[np.ndarray, "6 6"]


class Geometry(Protocol):
    """Thins scans and aligns them with the local map."""

    def thin(self, points: Float[np.ndarray, "n 3"]) -> ThinnedScan | None:
        """Prepares a scan.

        Args:
            points: finite, metres, in the frame of the lidar.

        Returns:
            The thinned scan; None for a scan without enough flat points.
        """
        ...

    def align(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: Pose) -> Alignment:
        """Aligns a scan from a first guess that is nearly right.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guess.

        Returns:
            The pose.
        """
        ...

    def search(self, local_map: LocalMap, scan: ThinnedScan, T_map_scan: Float[np.ndarray, "s 4 4"]) -> Alignment:
        """Aligns a scan from several first guesses, coarse to fine.

        Args:
            local_map: the local map.
            scan: the scan.
            T_map_scan: first guesses; at least one.

        Returns:
            The pose of the highest score.
        """
        ...

    def other_motions(self, T_last_scan: Pose, extent_m: float) -> Float[np.ndarray, "s 4 4"]:
        """Returns motions that a vehicle may make instead of the predicted one.

        Args:
            T_last_scan: the predicted motion.
            extent_m: median range of the scan.

        Returns:
            The motions.
        """
        ...


def best_of(alignments: Sequence[Alignment]) -> Alignment:
    """Returns the alignment of the highest score.

    Args:
        alignments: at least one.

    Returns:
        The first of the best.
    """
    return max(alignments, key=lambda found: found.score)
