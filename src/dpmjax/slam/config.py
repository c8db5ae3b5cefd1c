"""Settings of `run_slam`, one record for each stage; localization has its own.

Lengths that depend on the place are shares of the scans' extent. The extent of a scan is the median range of its
surface points: about 12 m in a street, 4 m in a room.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from dpmjax.checks import require_fields, require_one_of, require_positive_fields

Proposer = Literal["prediction", "network"]
SlamMethod = Literal["surfaces", "descriptors"]


@dataclass(frozen=True)
class OdometryConfig:
    """Registration of a scan against the local map, point to plane.

    Attributes:
        proposer: source of the first guess. "prediction" takes the last motion. If it fails, further motions and those
            of the decoder are tried. With "network" the decoder registers each scan to the nearest keyframe
            (DeepPointMap section 4).
        num_keyframes: number of the nearest keyframes in the local map.
    """

    proposer: Proposer = "prediction"
    num_keyframes: int = 12

    def __post_init__(self) -> None:
        require_one_of("proposer", self.proposer, get_args(Proposer))
        require_fields(self, "num_keyframes", low=1)


@dataclass(frozen=True)
class FrontEndConfig:
    """Acceptance of the pose of a scan, and choice of keyframes.

    Attributes:
        min_probability: smallest P(correct) of a decoder's motion that confirms a pose of too low a score.
        keyframe_share: distance of keyframes, as a share of the extent.
        max_keyframe_m: upper bound of the distance of keyframes (DeepPointMap: 3 to 10 m).
        min_keyframe_m: lower bound of the distance of keyframes.
    """

    min_probability: float = 0.5
    keyframe_share: float = 0.3
    max_keyframe_m: float = 5.0
    min_keyframe_m: float = 0.5

    def __post_init__(self) -> None:
        require_fields(self, "min_probability", low=0, high=1)
        require_positive_fields(self, "keyframe_share")
        require_fields(self, "min_keyframe_m", low=1e-3, high=self.max_keyframe_m)


@dataclass(frozen=True)
class LoopClosureConfig:
    """Candidates of loops, and acceptance of their registrations.

    Attributes:
        is_on: False searches no loops: the map is that of odometry.
        min_probability: smallest P(correct) of an accepted registration.
    """

    is_on: bool = True
    min_probability: float = 0.5

    def __post_init__(self) -> None:
        require_fields(self, "min_probability", low=0, high=1)


@dataclass(frozen=True)
class DescriptorConfig:
    """SLAM by descriptors alone (DeepPointMap section 4; defaults: published configuration).

    Attributes:
        keyframe_m: distance of keyframes at the start of a drive (published: 10 for KITTI, 7 for KITTI-360, 3 for
            MulRan). Small errors of registrations enlarge the distance, and large errors reduce it.
        min_confidence: smallest mean score of the best pairs of an accepted registration.
        max_rmse_m: largest root mean square error of the pairs of an accepted registration. It is also the unit of
            errors in the rule of keyframes. A decoder with inexact offsets needs more: 2.5 for `dpm_small`.
        min_overlap: overlap probability above which the best candidate of a loop is registered.
    """

    keyframe_m: float = 10.0
    min_confidence: float = 0.6
    max_rmse_m: float = 0.5
    min_overlap: float = 0.7

    def __post_init__(self) -> None:
        require_positive_fields(self, "keyframe_m", "max_rmse_m")
        require_fields(self, "min_confidence", "min_overlap", low=0, high=1)


@dataclass(frozen=True)
class SlamConfig:
    """Settings of `run_slam`.

    Attributes:
        method: "surfaces" aligns surface elements, and the decoder proposes motions. With "descriptors" the decoder
            alone registers scans and maps (DeepPointMap section 4).
        odometry: registration against the local map, for "surfaces".
        front_end: acceptance of poses, and keyframes, for "surfaces".
        loops: loop closure and optimisation, for "surfaces"; `is_on` counts for both.
        descriptors: settings of "descriptors".
    """

    method: SlamMethod = "surfaces"
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    loops: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    descriptors: DescriptorConfig = field(default_factory=DescriptorConfig)

    def __post_init__(self) -> None:
        require_one_of("method", self.method, get_args(SlamMethod))

    @property
    def encodes_each_scan(self) -> bool:
        """True if every scan is encoded, instead of keyframes alone."""
        return self.method == "descriptors" or self.odometry.proposer == "network"


SlamPreset = Literal["default", "paper"]


def slam_preset(name: SlamPreset) -> SlamConfig:
    """Returns named settings of SLAM.

    Args:
        name: "default", or "paper" for section 4 of DeepPointMap by its own method, with the published thresholds. With
            "paper" the decoder's motion is the pose, and no surfaces are aligned. Our weights need a larger
            `max_rmse_m`.

    Returns:
        The settings.

    Raises:
        ValueError: if the name is unknown.
    """
    require_one_of("name", name, get_args(SlamPreset))
    return SlamConfig() if name == "default" else SlamConfig(method="descriptors")
