"""The loops of a map, and what became of each candidate."""

from __future__ import annotations

from typing import NamedTuple

from dpmjax.slam.keyframes import KeyframeMap
from dpmjax.slam.reports import Loop


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
    """Lists the loops that an earlier run has accepted, so that they can still be taken back.

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
