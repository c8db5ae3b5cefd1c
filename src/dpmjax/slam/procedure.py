"""The two methods of SLAM as records of functions: the only place that chooses between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Bool
from numpy import ndarray

from dpmjax.slam import descriptor_loops, descriptor_odometry, front_end, loop_closure
from dpmjax.slam.config import SlamConfig
from dpmjax.slam.front_end import FrontEndState, ScanReport
from dpmjax.slam.interfaces import PreparedInput, SlamMethods
from dpmjax.slam.keyframe_map import KeyframeMap
from dpmjax.slam.loops import Loop, LoopState


class SlamProcedure(NamedTuple):
    """The steps of a method.

    Attributes:
        place_scan: estimates the pose of a scan, and makes some scans keyframes.
        close_loops: looks for loops of the newest keyframe of a drive.
        join_keyframe: looks for loops of a keyframe to allowed keyframes of other maps in the same record.
    """

    place_scan: Callable[
        [SlamMethods, FrontEndState, KeyframeMap, PreparedInput], tuple[FrontEndState, KeyframeMap, ScanReport]
    ]
    close_loops: Callable[[SlamMethods, KeyframeMap, LoopState], tuple[KeyframeMap, LoopState]]
    join_keyframe: Callable[
        [SlamMethods, KeyframeMap, tuple[Loop, ...], int, Bool[ndarray, " k"]], tuple[KeyframeMap, tuple[Loop, ...]]
    ]


_PROCEDURES = {
    "surfaces": SlamProcedure(front_end.place_scan, loop_closure.close_loops, loop_closure.join_keyframe),
    "descriptors": SlamProcedure(
        descriptor_odometry.place_by_descriptors,
        descriptor_loops.close_loops_by_descriptors,
        descriptor_loops.join_keyframe_by_descriptors,
    ),
}


def procedure_of(config: SlamConfig) -> SlamProcedure:
    """Returns the steps of the configured method."""
    return _PROCEDURES[config.method]
