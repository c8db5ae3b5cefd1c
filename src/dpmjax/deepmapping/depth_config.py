"""Settings of DeepMapping of depth images: the phases, the networks, the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.deepmapping.config import (
    JOINT,
    LOCALIZE,
    REFINE,
    Motion,
    PhaseConfig,
    SpatialMappingConfig,
    as_published,
    check_preset,
)
from dpmjax.nets.localization import LocalizationConfig

LOCALIZE_DEPTH = replace(
    LOCALIZE, num_steps=400, learning_rate=1e-3, beams_per_step=400, num_offsets=2, max_offset=3, scans_per_window=None
)
"""Cold start of depth images."""

UNROLL_DEPTH = replace(
    LOCALIZE_DEPTH,
    name="free poses, Chamfer",
    poses="free",
    num_steps=300,
    learning_rate=1e-2,
    final_learning_rate=0.02,
    chamfer_limit=(0.5, 0.05),
)
"""The Chamfer distance pulls views of low overlap onto each other; with its falling limit, that pull vanishes."""

REFINE_DEPTH = replace(
    REFINE,
    name="free poses and map",
    num_steps=150,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    beams_per_step=200,
    num_offsets=3,
    max_offset=1 << 30,
    surface_distance=(0.05, 0.01),
    projection_tolerance=(0.05, 0.005),
)
"""Free poses and a map that sharpens from coarse to fine. The nearest point of another image is some centimetres beside
the surface between its pixels, and it pulls where only one image has seen; a projection does neither."""

JOINT_DEPTH = replace(
    JOINT, num_steps=3000, occupancy_weight=0.9, scans_per_step=256, num_offsets=1, max_offset=1, num_free=35
)
"""The paper: all pixels, 35 free samples a ray, gamma 0.9, windows of 2."""


@dataclass(frozen=True)
class DepthMappingConfig(SpatialMappingConfig):
    """Settings of the fit of depth images; attributes as in SpatialMappingConfig."""

    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE_DEPTH, UNROLL_DEPTH, REFINE_DEPTH)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE_DEPTH,)
    localization: LocalizationConfig = field(
        default_factory=lambda: LocalizationConfig(features=(32, 64, 128), strides=(2, 2, 1), hidden=(128, 64))
    )
    steps_per_call: int = 50
    map_margin: float = 1.2
    motion: Motion = "planar"


def depth_preset(name: Literal["fast", "paper"], *, motion: Motion = "planar") -> DepthMappingConfig:
    """The settings of a preset for depth images.

    Args:
        name: "fast" (seconds to a minute on two cores) or "paper" (its networks and sampling).
        motion: degrees of freedom of the camera.

    Returns:
        The settings.

    Raises:
        ValueError: the name is unknown.
    """
    check_preset(name)
    config = DepthMappingConfig(motion=motion)
    if name == "paper":
        return as_published(config, JOINT_DEPTH, LocalizationConfig(features=(64, 128, 256, 1024), strides=(1,) * 4))
    if motion == "planar":
        return config
    # Real depth images in SE(3) do not agree to half a percent of the depth, and their first poses are rougher.
    refine = replace(REFINE_DEPTH, projection_tolerance=(0.1, 0.02))
    return replace(config, cold_phases=(*config.cold_phases[:-1], refine), warm_phases=(refine,))
