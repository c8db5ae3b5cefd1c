"""Settings of DeepMapping of lidar clouds: the phases, the networks, the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.deepmapping.config import (
    JOINT,
    LOCALIZE,
    REFINE,
    PhaseConfig,
    SpatialMappingConfig,
    as_published,
    check_preset,
)
from dpmjax.deepmapping.depth_config import UNROLL_DEPTH
from dpmjax.nets.localization import LocalizationConfig

LOCALIZE_CLOUDS = replace(
    LOCALIZE, num_steps=300, learning_rate=1e-3, beams_per_step=256, num_offsets=2, max_offset=3, scans_per_window=None
)
"""Cold start of clouds."""

UNROLL_CLOUDS = replace(UNROLL_DEPTH, num_steps=200, beams_per_step=256, scans_per_step=64)
"""As of depth images."""

REFINE_CLOUDS = replace(
    REFINE,
    name="free poses, planes and map",
    num_steps=300,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    final_learning_rate=0.01,
    scans_per_step=64,
    beams_per_step=128,
    num_offsets=3,
    max_offset=8,
    surface_distance=(0.05, 0.01),
    plane_width=(0.04, 0.002),
    num_revisits=1,
)
"""Free poses, planes and a map that sharpens. The Chamfer distance pulls the sparse rings of two scans onto each other;
the distance to the plane between the rings does not."""

JOINT_CLOUDS = replace(JOINT, num_steps=3000, scans_per_step=64, beams_per_step=2048)
"""The paper's losses and sampling, in 3-D."""


@dataclass(frozen=True)
class CloudMappingConfig(SpatialMappingConfig):
    """Settings of the fit of lidar clouds; attributes as in SpatialMappingConfig.

    Attributes:
        num_points: points that are kept of each scan, evenly thinned.
    """

    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE_CLOUDS, UNROLL_CLOUDS, REFINE_CLOUDS)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE_CLOUDS,)
    localization: LocalizationConfig = field(
        default_factory=lambda: LocalizationConfig(kind="point", features=(32, 64, 128), hidden=(128, 64))
    )
    steps_per_call: int = 25
    map_margin: float = 1.05
    num_points: int = 2048

    def __post_init__(self) -> None:
        if self.motion != "full":
            raise ValueError(f"motion: expected 'full' of clouds, got {self.motion!r}")
        if self.num_points < 1:
            raise ValueError(f"num_points: expected at least 1, got {self.num_points}")


def cloud_preset(name: Literal["fast", "paper"]) -> CloudMappingConfig:
    """The settings of a preset for lidar clouds.

    Args:
        name: "fast" (a minute on two cores for some dozens of scans) or "paper" (its networks, losses and sampling).

    Returns:
        The settings.

    Raises:
        ValueError: the name is unknown.
    """
    check_preset(name)
    config = CloudMappingConfig()
    return config if name == "fast" else as_published(config, JOINT_CLOUDS, LocalizationConfig(kind="point"))
