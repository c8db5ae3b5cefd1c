"""What the front end asks of a geometry, which aligns scans with recent ones: `odometry` has the one that is used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from dpmjax.slam.columns import Arrays
from dpmjax.slam.keyframes import Pose


class Alignment(NamedTuple):
    """A scan in the frame of the local map.

    Attributes:
        T_map_scan: float64.
        matched_share: share of the scan's points that meet planes of the map.
        contradicted_share: share of the map's visible points that lie in the scan's free space.
        score: against a map, `matched_share` less the weighted `contradicted_share`; of two scans as in `Verification`.
        information: (6, 6) inverse covariance in the tangent of the scan, translation first: weak along a corridor.
        num_starts: number of starts that were tried.
    """

    T_map_scan: Pose
    matched_share: float
    contradicted_share: float
    score: float
    information: Float[np.ndarray, "6 6"]
    num_starts: int = 1


class PosePrior(NamedTuple):
    """Where the search for a pose begins.

    Attributes:
        T_map_last: pose of the last scan.
        T_last_scan: predicted motion since.
        usual_score: of recent alignments; 1 where there is none yet.
        is_sure: whether only small errors of the prediction are searched.
    """

    T_map_last: Pose
    T_last_scan: Pose
    usual_score: float = 1.0
    is_sure: bool = False


class Geometry(Protocol):
    """Measures scans and aligns them with the recent ones."""

    def measure(self, points: Float[np.ndarray, "n 3"]) -> Any | None:
        """Prepares a scan.

        Args:
            points: metres, in the frame of the lidar; may hold NaN.

        Returns:
            A record that the geometry and the matcher read; None for a scan without enough points.
        """
        ...

    def extent_m(self, measured: Any) -> float:
        """Returns the median range of a scan.

        Args:
            measured: from `measure`.

        Returns:
            Metres.
        """
        ...

    def insert(self, local_map: Any | None, measured: Any, T_map_scan: Pose, scan: int) -> Any:
        """Adds a scan to the local map, where it tells something new.

        Args:
            local_map: None for an empty one.
            measured: the scan.
            T_map_scan: its pose.
            scan: its number.

        Returns:
            The local map after.
        """
        ...

    def move(self, local_map: Any, T_new_map: Pose) -> Any:
        """Changes the frame of the local map.

        Args:
            local_map: the map.
            T_new_map: the old frame in the new one.

        Returns:
            The map in its new frame.
        """
        ...

    def align(self, local_map: Any, measured: Any, starts: PosePrior) -> Alignment:
        """Aligns a scan with the local map.

        Args:
            local_map: the map.
            measured: the scan.
            starts: the predicted pose and what is usual.

        Returns:
            The best pose.
        """
        ...

    def pack(self, local_map: Any) -> Arrays:
        """Turns the local map into arrays for a file; numbers of scans stand for the scans.

        Args:
            local_map: the map.

        Returns:
            Arrays by name.
        """
        ...

    def unpack(self, arrays: Arrays, measure_again: Callable[[int], Any]) -> Any:
        """Makes the local map again, bit for bit.

        Args:
            arrays: from `pack`.
            measure_again: gives the measured scan of a number.

        Returns:
            The local map.
        """
        ...
