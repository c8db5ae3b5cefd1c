"""Settings of DeepMapping of depth images: the search for first poses, the phases, the networks, the presets."""

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


@dataclass(frozen=True)
class DepthInitializationConfig:
    """Settings of the search. Lengths are in the unit of the points, metres by default.

    Attributes:
        max_translation: between neighbouring images, along each axis.
        max_turn_deg: between neighbouring images, about the vertical axis of the camera.
        max_tilt_deg: about the other axes; full motion only.
        num_tries: searches for an image where few trajectories are left, each with other points; where more are left,
            one for each, and so many more for the best ones.
        num_trajectories: trajectories that go on from image to image, at most.
        margin: a trajectory that explains less of the points than the best one by more than this share is dropped.
        num_candidates: motions of the first round, spread evenly.
        num_kept: best motions that go on to the next round, before the slides.
        num_varied: new motions around each kept one in a round.
        num_rounds: of motions, each varied half as widely as in the round before.
        num_slid: best motions of the last round that differ; they are slid.
        num_slides: places of each along each direction of the surfaces.
        num_adjusted: best motions after the slides that differ; they are adjusted.
        num_distinct: best motions after it that differ, by which a trajectory is continued. Where an image leaves open
            how far the camera moved along a wall, they lie side by side along it.
        num_references: number of earlier images that an image is compared to before the slides.
        num_checked: number of earlier images that an image is compared to from the slides on.
        num_points: of each image, in a search.
        num_compared: points of each image by which trajectories are compared and adjusted.
        num_window: trajectories are compared and adjusted by so many last images; in the end by all.
        adjusted_every: poses are adjusted whenever so many images have been added.
        num_iterations: of an adjustment.
        tolerance: share of the depth by which matching points may differ, in the first and in the last round; the last
            one also while trajectories grow.
        final_tolerance: the same, in the last adjustment and where the best trajectory is chosen.
        translation_weight: cost of the largest translation, in matching points. Along a bare wall nothing
            else tells how far the camera has moved, and then the shortest move is taken.
        turn_weight: cost of the largest turn, likewise.
    """

    max_translation: float = 0.7
    max_turn_deg: float = 75.0
    max_tilt_deg: float = 30.0
    num_tries: int = 4
    num_trajectories: int = 16
    margin: float = 0.25
    num_candidates: int = 1024
    num_kept: int = 32
    num_varied: int = 20
    num_rounds: int = 4
    num_slid: int = 8
    num_slides: int = 51
    num_adjusted: int = 32
    num_distinct: int = 16
    num_references: int = 4
    num_checked: int = 8
    num_points: int = 100
    num_compared: int = 300
    num_window: int = 24
    adjusted_every: int = 1
    num_iterations: int = 6
    tolerance: tuple[float, float] = (0.12, 0.02)
    final_tolerance: float = 0.006
    translation_weight: float = 0.05
    turn_weight: float = 0.0

    def __post_init__(self) -> None:
        counts = (self.num_tries, self.num_candidates, self.num_kept, self.num_varied, self.num_rounds)
        more = (self.num_slid, self.num_slides, self.num_adjusted, self.num_distinct)
        compared = (self.num_references, self.num_checked, self.num_points)
        growth = (self.num_trajectories, self.num_compared, self.num_window, self.adjusted_every, self.num_iterations)
        if min(*counts, *more, *compared, *growth) < 1:
            raise ValueError(f"all counts must be at least 1, got {self}")


PLANAR_SEARCH = DepthInitializationConfig()
"""A level camera on wheels."""

FULL_SEARCH = DepthInitializationConfig(
    num_trajectories=8,
    num_candidates=16384,
    num_varied=48,
    tolerance=(0.12, 0.03),
    final_tolerance=0.015,
    translation_weight=0.2,
    turn_weight=0.3,
)
"""A hand-held camera: six numbers to search instead of three, small moves between images, a real sensor's noise."""
