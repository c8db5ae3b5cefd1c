"""Settings of `run_slam`, one record for each stage; localization has its own.

Lengths that depend on the place are shares of the scans' extent. The extent of a scan is the median range of its
surface points: about 12 m in a street, 4 m in a room.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from dpmjax.checks import require_fields, require_one_of, require_positive_fields
from dpmjax.scans.surface_alignment import AlignmentConfig, AlignmentLevel

Proposer = Literal["prediction", "network"]

NARROW = AlignmentConfig(levels=(AlignmentLevel(1.0, 1000, 10), AlignmentLevel(1.0, 4000, 12, kernel_m=0.1)))
WIDE = AlignmentConfig(levels=(AlignmentLevel(3.0, 300, 10),))


@dataclass(frozen=True)
class OdometryConfig:
    """Registration of a scan against the local map, point to plane.

    Attributes:
        proposer: source of the first guess. With "prediction" it is the last motion; if that fails, further motions and
            those of the decoder are tried. With "network" the decoder registers each scan to the nearest keyframe
            (DeepPointMap section 4).
        num_keyframes: number of the nearest keyframes in the local map.
        narrow: alignment from a first guess that is nearly right.
        wide: alignment from other starts.
        plane_radius_m: largest distance between an element and the element of the map whose plane it meets.
    """

    proposer: Proposer = "prediction"
    num_keyframes: int = 12
    narrow: AlignmentConfig = NARROW
    wide: AlignmentConfig = WIDE
    plane_radius_m: float = 1.5

    def __post_init__(self) -> None:
        require_one_of("proposer", self.proposer, get_args(Proposer))
        require_positive_fields(self, "plane_radius_m")
        require_fields(self, "num_keyframes", low=1)


@dataclass(frozen=True)
class FrontEndConfig:
    """Acceptance of the pose of a scan, and choice of keyframes.

    Attributes:
        min_probability: smallest P(correct) of a decoder's motion that confirms a pose of too low a score.
        num_submap: largest number of keyframes that are merged for a registration.
        num_lost: number of scans without an accepted pose after which a new segment begins, which loops may join.
        keyframe_share: distance of keyframes, as a share of the extent.
        max_keyframe_m: upper bound of the distance of keyframes (DeepPointMap: 3 to 10 m).
        min_keyframe_m: lower bound of the distance of keyframes.
    """

    min_probability: float = 0.5
    num_submap: int = 4
    num_lost: int = 6
    keyframe_share: float = 0.3
    max_keyframe_m: float = 5.0
    min_keyframe_m: float = 0.5

    def __post_init__(self) -> None:
        require_fields(self, "min_probability", low=0, high=1)
        require_fields(self, "num_submap", "num_lost", low=1)
        require_positive_fields(self, "keyframe_share")
        require_fields(self, "min_keyframe_m", low=1e-3, high=self.max_keyframe_m)


@dataclass(frozen=True)
class LoopClosureConfig:
    """Candidates of loops, and acceptance of their registrations.

    Attributes:
        is_on: False leaves the map as odometry makes it.
        num_near: largest number of candidates by distance.
        num_similar: largest number of candidates by retrieval.
        min_overlap: smallest overlap probability of a candidate that is registered.
        num_asked: number of candidates whose overlap is predicted at a time, alternately by distance and by retrieval.
        num_registered: largest number of candidates that are registered.
        min_probability: smallest P(correct) of an accepted registration.
        min_support: smallest number of consistent registrations, its own included, with which a loop becomes an edge.
    """

    is_on: bool = True
    num_near: int = 6
    num_similar: int = 6
    min_overlap: float = 0.3
    num_asked: int = 4
    num_registered: int = 2
    min_probability: float = 0.5
    min_support: int = 2

    def __post_init__(self) -> None:
        require_fields(self, "min_overlap", "min_probability", low=0, high=1)
        require_fields(self, "min_support", "num_registered", "num_asked", low=1)
        require_fields(self, "num_near", "num_similar", low=0)


@dataclass(frozen=True)
class SlamConfig:
    """Settings of `run_slam`.

    Attributes:
        odometry: registration against the local map.
        front_end: acceptance of poses, and keyframes.
        loops: loop closure and optimisation.
    """

    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    loops: LoopClosureConfig = field(default_factory=LoopClosureConfig)


SlamPreset = Literal["default", "paper"]


def slam_preset(name: SlamPreset) -> SlamConfig:
    """Returns named settings of SLAM.

    Args:
        name: "default", or "paper" for the thresholds of DeepPointMap's published configuration. There the decoder
            registers every scan, and keyframes are up to 10 m apart. One loop candidate by distance is registered from
            an overlap probability of 0.7 on and accepted alone.

    Returns:
        The settings.

    Raises:
        ValueError: if the name is unknown.
    """
    require_one_of("name", name, get_args(SlamPreset))
    if name == "default":
        return SlamConfig()
    return SlamConfig(
        odometry=OdometryConfig(proposer="network", num_keyframes=16),
        front_end=FrontEndConfig(
            min_probability=0.6, num_submap=16, num_lost=5, keyframe_share=1.0, max_keyframe_m=10.0, min_keyframe_m=1.0
        ),
        loops=LoopClosureConfig(
            num_near=16,
            num_similar=0,
            min_overlap=0.7,
            num_asked=16,
            num_registered=1,
            min_probability=0.6,
            min_support=1,
        ),
    )
