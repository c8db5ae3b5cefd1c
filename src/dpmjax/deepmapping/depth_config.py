"""Settings of DeepMapping for depth images (section 4.2): phases, networks, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.deepmapping.config import PhaseConfig
from dpmjax.nets.depth_localization import DepthLocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig

Motion = Literal["planar", "full"]
"""What L-Net tells: x, z and the angle about y, as in the paper; or a twist in SE(3)."""


@dataclass(frozen=True)
class DepthPhaseConfig(PhaseConfig):
    """One phase of the fit of depth images.

    Attributes:
        projection_tolerance: images are compared by projection instead of by the Chamfer distance: share of the depth
            by which agreeing points may differ, at the start and at the end of the phase; None: Chamfer. Offsets then
            go around: the images after the last are the first ones, so that any two can meet.
    """

    projection_tolerance: tuple[float, float] | None = None


LOCALIZE_DEPTH = DepthPhaseConfig(
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

UNROLL_DEPTH = DepthPhaseConfig(
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

REFINE_DEPTH = DepthPhaseConfig(
    name="free poses and map",
    poses="free",
    num_steps=150,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    final_learning_rate=0.02,
    map_learning_rate=0.1,
    adam_decay=(0.9, 0.99),
    beams_per_step=200,
    num_offsets=3,
    max_offset=1 << 30,
    num_free=1,
    surface_distance=(0.05, 0.01),
    anneal_until=0.7,
    map_decay=1e-3,
    projection_tolerance=(0.05, 0.005),
)
"""Free poses and a map that sharpens from coarse to fine. The nearest point that another image has is some centimetres
beside the surface between its pixels, and pulls where only one image has seen; a projection does neither."""

JOINT_DEPTH = DepthPhaseConfig(
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
    cold_phases: tuple[DepthPhaseConfig, ...] = (LOCALIZE_DEPTH, UNROLL_DEPTH, REFINE_DEPTH)
    warm_phases: tuple[DepthPhaseConfig, ...] = (REFINE_DEPTH,)
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

    def phases(self, *, is_warm: bool) -> tuple[DepthPhaseConfig, ...]:
        """The phases of a start."""
        return self.warm_phases if is_warm else self.cold_phases


def depth_preset(name: Literal["fast", "paper"], *, motion: Motion = "planar") -> DepthMappingConfig:
    """The settings of a preset: "fast" (seconds to a minute on two cores) or "paper" (its networks and sampling).

    Raises:
        ValueError: the name is unknown.
    """
    if name == "fast":
        config = DepthMappingConfig(motion=motion)
        return config if motion == "planar" else _for_hand_held(config)
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


def _for_hand_held(config: DepthMappingConfig) -> DepthMappingConfig:
    """Real depth images in SE(3) do not agree to half a percent of the depth, and their first poses are rougher."""
    refine = replace(REFINE_DEPTH, projection_tolerance=(0.1, 0.02))
    return replace(config, cold_phases=(*config.cold_phases[:-1], refine), warm_phases=(refine,))


def as_direct(config: DepthMappingConfig) -> DepthMappingConfig:
    """The paper's baseline: the same losses and steps, but the poses themselves are optimised, never L-Net."""

    def free(phases: tuple[DepthPhaseConfig, ...]) -> tuple[DepthPhaseConfig, ...]:
        return tuple(replace(phase, poses="free") for phase in phases)

    return replace(config, cold_phases=free(config.cold_phases), warm_phases=free(config.warm_phases))
