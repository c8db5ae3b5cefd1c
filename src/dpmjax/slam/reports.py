"""Reports of SLAM: a record for each scan and for each loop candidate, with the reason of its decision; all loops."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from dpmjax.slam.keyframes import KeyframeMap, Pose

ScanStatus = Literal["first", "tracked", "network", "predicted", "empty", "restarted"]
"""How the pose of a scan was found.

"first": the scan starts the map, or a new part of a loaded one. "tracked": geometry, from the predicted pose.
"network": geometry failed there, and agreed from the network's pose, or both agree on a pose of a low score.
"predicted": nothing agreed, the pose is a guess: what geometry prefers, or the motion of before. "empty": the scan has
too few points. "restarted": nothing agreed for a while, a new part of the map begins here, and loops may join it.
"""

LoopStatus = Literal[
    "not asked",
    "no overlap",
    "not registered",
    "improbable",
    "scans disagree",
    "against odometry",
    "waits for support",
    "accepted",
    "taken back",
]
"""What became of a loop candidate; all but "accepted" are reasons why it is no edge."""


class ScanReport(NamedTuple):
    """The pose of a scan and how it was found.

    Attributes:
        scan: its number.
        status: how the pose was found.
        reason: the numbers that decided.
        keyframe: row of the keyframe that it hangs on; its own row if it is one.
        T_keyframe_scan: relative pose; loops move the keyframe only.
        is_keyframe: whether it became one.
        score: agreement of the scan with the local map.
        probability: P(correct) of the network; None where it did not run.
        num_accepted: number of loops that were accepted at this scan.
        num_points: number of points of the scan.
        T_turn: predicted motion that a scan with times was deskewed by; None for a scan without times.
    """

    scan: int
    status: ScanStatus
    reason: str
    keyframe: int
    T_keyframe_scan: Pose
    is_keyframe: bool
    score: float = 0.0
    probability: float | None = None
    num_accepted: int = 0
    num_points: int = 0
    T_turn: Pose | None = None


class Loop(NamedTuple):
    """A candidate of a loop.

    Attributes:
        source: row of the new keyframe.
        target: row of an older one.
        found_by: how it became a candidate; "map" is a loop of the map that was extended.
        status: what became of it.
        overlap: probability of overlap; 1 where no network predicts it, None where another candidate surely overlaps.
        probability: P(correct) of the registration; None without one.
        rmse: of the registration, metres; None without one.
        T_target_source: the registration; None without one.
        information: (6, 6) inverse covariance by the planes of the scans, as in `MapEdge`; None where it is not known.
    """

    source: int
    target: int
    found_by: Literal["distance", "retrieval", "map"]
    status: LoopStatus
    overlap: float | None
    probability: float | None = None
    rmse: float | None = None
    T_target_source: Pose | None = None
    information: Float[np.ndarray, "6 6"] | None = None


class LoopState(NamedTuple):
    """All candidates so far.

    Attributes:
        loops: every candidate, in the order in which they were found.
        num_optimized: number of keyframes at the last optimisation.
        is_stale: whether edges were added since that do not only lengthen the chain of odometry.
    """

    loops: tuple[Loop, ...] = ()
    num_optimized: int = 0
    is_stale: bool = False


def loops_of_map(slam_map: KeyframeMap) -> LoopState:
    """Lists the loops that an earlier run has accepted; the optimisation may remove them later.

    Args:
        slam_map: of the earlier run.

    Returns:
        The loops.
    """
    edges = [edge for edge in slam_map.edges if edge.kind == "loop"]
    known = Loop(0, 0, "map", "accepted", 1.0)
    loops = [
        known._replace(source=e.source, target=e.target, T_target_source=e.T_target_source, information=e.information)
        for e in edges
    ]
    return LoopState(tuple(loops), len(slam_map), False)
