"""Settings of DeepMapping for depth images (section 4.2): phases, networks, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.nets.depth_localization import DepthLocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig

Motion = Literal["planar", "full"]
"""What L-Net tells: x, z and the angle about y, as in the paper; or a twist in SE(3)."""

LOCALIZE_DEPTH = PhaseConfig(
    name="L-Net",
    poses="network",
    num_steps=400,
    occupancy_weight=0.0,
    learning_rate=1e-3,
    final_learning_rate=0.05,
    adam_decay=(0.9, 0.99),
    beams_per_step=400,
    num_offsets=2,
    max_offset=3,
)
"""Cold start: L-Net moves all poses together."""

UNROLL_DEPTH = PhaseConfig(
    name="free poses, Chamfer",
    poses="free",
    num_steps=300,
    occupancy_weight=0.0,
    learning_rate=1e-2,
    final_learning_rate=0.02,
    adam_decay=(0.9, 0.99),
    beams_per_step=400,
    num_offsets=2,
    max_offset=3,
    chamfer_limit=(0.5, 0.05),
)
"""The Chamfer distance pulls views of low overlap onto each other; with its limit falling, that pull goes."""

REFINE_DEPTH = PhaseConfig(
    name="free poses and map",
    poses="free",
    num_steps=300,
    occupancy_weight=0.3,
    learning_rate=2e-3,
    final_learning_rate=0.02,
    map_learning_rate=0.1,
    adam_decay=(0.9, 0.99),
    beams_per_step=400,
    num_offsets=2,
    max_offset=3,
    num_free=2,
    surface_distance=(0.05, 0.01),
    anneal_until=0.7,
    map_decay=1e-3,
    chamfer_limit=(0.1, 0.03),
)
"""Free poses and a map that sharpens from coarse to fine."""

JOINT_DEPTH = PhaseConfig(
    name="L-Net and M-Net",
    poses="network",
    num_steps=3000,
    occupancy_weight=0.9,
    learning_rate=1e-3,
    beams_per_step=1 << 30,
    num_offsets=1,
    max_offset=1,
    num_free=35,
    is_free_factor_shared=True,
)
"""The paper: all pixels, 35 free samples a ray, gamma 0.9, windows of 2."""


@dataclass(frozen=True)
class DepthMappingConfig:
    """Settings of the whole fit.

    Attributes:
        motion: what L-Net tells.
        cold_phases: phases from poses at one place.
        warm_phases: phases from given poses.
        localization: shape of L-Net.
        occupancy: shape of M-Net.
        steps_per_call: at most so many steps are compiled into one call.
        map_margin: the map's cube is so many times larger than what the scans cover at the start of a phase.
    """

    motion: Motion = "planar"
    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE_DEPTH, UNROLL_DEPTH, REFINE_DEPTH)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE_DEPTH,)
    localization: DepthLocalizationConfig = field(
        default_factory=lambda: DepthLocalizationConfig(features=(32, 64, 128), strides=(2, 2, 1), hidden=(128, 64))
    )
    occupancy: OccupancyConfig = field(
        default_factory=lambda: OccupancyConfig(kind="grid", resolutions=(8, 16, 32, 64))
    )
    steps_per_call: int = 50
    map_margin: float = 1.2

    @property
    def num_outputs(self) -> int:
        """Numbers that describe a motion."""
        return 3 if self.motion == "planar" else 6

    def phases(self, *, is_warm: bool) -> tuple[PhaseConfig, ...]:
        """The phases of a start."""
        return self.warm_phases if is_warm else self.cold_phases


def depth_preset(name: Literal["fast", "paper"], *, motion: Motion = "planar") -> DepthMappingConfig:
    """The settings of a preset: "fast" (seconds to a minute on two cores) or "paper" (its networks and sampling).

    Raises:
        ValueError: the name is unknown.
    """
    if name == "fast":
        return DepthMappingConfig(motion=motion)
    if name == "paper":
        return DepthMappingConfig(
            motion,
            cold_phases=(JOINT_DEPTH,),
            warm_phases=(JOINT_DEPTH,),
            localization=DepthLocalizationConfig(),
            occupancy=OccupancyConfig(),
            steps_per_call=1,
        )
    raise ValueError(f"preset: expected 'fast' or 'paper', got {name!r}")


def as_direct(config: DepthMappingConfig) -> DepthMappingConfig:
    """The paper's baseline: the same losses and steps, but the poses themselves are optimised, never L-Net."""

    def free(phases: tuple[PhaseConfig, ...]) -> tuple[PhaseConfig, ...]:
        return tuple(replace(phase, poses="free") for phase in phases)

    return replace(config, cold_phases=free(config.cold_phases), warm_phases=free(config.warm_phases))
