"""Settings of DeepMapping, and presets of planar scans and of depth images.

Settings are the phases of a fit and the networks.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.checks import require_fields, require_one_of, require_value
from dpmjax.geometry.se3 import Motion
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig


@dataclass(frozen=True)
class PhaseConfig:
    """One phase of the fit. Lengths are in units of the fit (`DeepMappingConfig.unit`), by default typical ranges; nine
    beams in ten are shorter than the typical range.

    Attributes:
        name: name in logs and pictures.
        poses: "network": L-Net gives the poses; "free": the poses themselves are optimised.
        num_steps: number of steps of Adam; 0: `num_epochs` counts.
        occupancy_weight: gamma in gamma BCE + (1 - gamma) comparison; 0 leaves M-Net out.
        learning_rate: learning rate of L-Net or of the poses.
        final_learning_rate: learning rate at the end as a share of the first one, with a cosine schedule.
        adam_decay: Adam's decay rates of both moments, for the poses or L-Net.
        scans_per_step: number of scans in a step, in blocks of neighbours in time.
        beams_per_step: number of beams, or pixels of a depth image, of each scan in a step.
        num_offsets: number of later scans that each scan is compared to.
        max_offset: the largest distance in time of two scans that are compared; neighbours are always compared.
        num_free: number of free samples on each beam, drawn between sensor and hit.
        num_epochs: number of times that all scans are used, from which the number of scans gives the number of steps;
            0: `num_steps` counts.
        is_as_published: True: batches follow each other in time, and the last one is shorter. Free samples lie at the
            same share of every beam. Means are taken of each scan (eq. 4), then over scans. False: the batches and the
            samples of each beam are random, and all points have the same weight.
        surface_distance: distance of one more free sample from the hit, at the start and at the end of the phase;
            None: no such sample.
        chamfer_limit: largest Chamfer distance of a point, at the start and at the end of the phase. Larger ones are
            clipped, so that points outside the overlap have no gradient. None: no limit.
        projective_tolerance: tolerance of matching points as a share of the depth, at the start and at the end of the
            phase. Pairs of depth images are then compared by projection instead of the Chamfer distance, and offsets in
            time wrap around at the end of the sequence. None for other scans.
        scans_per_window: for planar scans, number of neighbours in time in a window. Each window has its own L-Net (or
            free poses), and windows are joined at the scans that they share. A step has all windows. None: one L-Net
            for the whole set.
    """

    name: str
    poses: Literal["network", "free"]
    occupancy_weight: float
    learning_rate: float
    num_steps: int = 0
    num_epochs: int = 0
    final_learning_rate: float = 1.0
    adam_decay: tuple[float, float] = (0.9, 0.999)
    scans_per_step: int = 256
    beams_per_step: int = 64
    num_offsets: int = 3
    max_offset: int = 3
    num_free: int = 1
    is_as_published: bool = False
    surface_distance: tuple[float, float] | None = None
    chamfer_limit: tuple[float, float] | None = None
    projective_tolerance: tuple[float, float] | None = None
    scans_per_window: int | None = None

    def __post_init__(self) -> None:
        require_fields(self, "occupancy_weight", low=0, high=1)
        require_fields(self, "num_offsets", low=1, high=self.max_offset)
        require_fields(self, "num_steps", low=0 if self.num_epochs else 1)
        require_fields(self, "num_epochs", low=0)
        if self.num_epochs and self.num_steps:
            raise ValueError(f"num_epochs: expected 0 beside num_steps, got {self.num_epochs}")
        require_fields(self, "scans_per_step", "beams_per_step", low=2)
        if self.scans_per_window is not None:
            require_fields(self, "scans_per_window", low=2)


# Cold start: one L-Net for each window, without M-Net, because a map of wrong poses would be a local minimum.
LOCALIZE = PhaseConfig(
    name="L-Net",
    poses="network",
    num_steps=400,
    occupancy_weight=0.0,
    learning_rate=3e-3,
    final_learning_rate=0.05,
    adam_decay=(0.9, 0.99),
    beams_per_step=128,
    max_offset=8,
    scans_per_window=17,
)

# Free poses and a map that sharpens from coarse to fine.
REFINE = PhaseConfig(
    name="free poses",
    poses="free",
    num_steps=800,
    occupancy_weight=0.5,
    learning_rate=2.5e-3,
    final_learning_rate=0.02,
    adam_decay=(0.9, 0.99),
    surface_distance=(0.1, 0.004),
)


@dataclass(frozen=True)
class DeepMappingConfig:
    """Settings of a fit, by default of planar scans; `preset` has those of depth images.

    Attributes:
        cold_phases: phases of a fit from zero poses.
        warm_phases: phases of a fit from given poses.
        localization: shape of L-Net.
        occupancy: shape of M-Net.
        unit: unit of length of networks and losses, in the unit of the points; None: the typical range of the scans.
        steps_per_call: the largest number of steps that are compiled into one call.
        motion: degrees of freedom of a depth camera.
    """

    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE, REFINE)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE,)
    localization: LocalizationNetConfig = field(
        default_factory=lambda: LocalizationNetConfig(
            features=(32, 64, 128), strides=(1, 2, 2), dilation=3, is_circular=True, hidden=(128, 64), output_scale=0.1
        )
    )
    occupancy: OccupancyConfig = field(default_factory=lambda: OccupancyConfig(kind="grid"))
    unit: float | None = None
    steps_per_call: int = 25
    motion: Motion = "planar"

    def __post_init__(self) -> None:
        for phases in (self.cold_phases, self.warm_phases):
            lengths = {phase.scans_per_window for phase in phases if phase.poses == "network"}
            if len(lengths) > 1:
                raise ValueError(f"scans_per_window: phases with L-Net share its weights, got windows of {lengths}")


def as_direct(config: DeepMappingConfig) -> DeepMappingConfig:
    """Returns settings of the paper's baseline: the same losses and steps, but free poses instead of L-Net.

    From zero the poses start at the output of the untrained L-Net (supplement B).

    Args:
        config: settings of a fit.

    Returns:
        The settings with free poses in every phase.
    """
    cold, warm = ([replace(phase, poses="free") for phase in p] for p in (config.cold_phases, config.warm_phases))
    return replace(config, cold_phases=tuple(cold), warm_phases=tuple(warm))


def with_steps(config: DeepMappingConfig, num_steps: int) -> DeepMappingConfig:
    """Returns settings with another number of steps, divided among the phases as before.

    Args:
        config: settings of a fit.
        num_steps: number of steps of all phases together.

    Returns:
        The settings.

    Raises:
        ValueError: there are fewer steps than phases.
    """

    def shorten(phases: tuple[PhaseConfig, ...]) -> tuple[PhaseConfig, ...]:
        require_value(num_steps >= len(phases), "steps", f"at least one for each of {len(phases)} phases", num_steps)
        total = max(1, sum(phase.num_steps for phase in phases))
        counts = [max(1, round(phase.num_steps * num_steps / total)) for phase in phases[:-1]]
        counts.append(max(1, num_steps - sum(counts)))
        return tuple(replace(p, num_steps=count, num_epochs=0) for p, count in zip(phases, counts, strict=True))

    cold, warm = shorten(config.cold_phases), shorten(config.warm_phases)
    return replace(config, cold_phases=cold, warm_phases=warm, steps_per_call=min(config.steps_per_call, num_steps))


# Phase of the paper (section 4.1). With gamma = 1 / (1 + lambda), both losses have the ratio of eq. 6 with lambda = 10,
# and Adam's steps do not depend on the common factor. The paper does not give the number of neighbours of eq. 7; the
# published program has 3.
JOINT = PhaseConfig(
    name="L-Net and M-Net",
    poses="network",
    num_epochs=3000,
    occupancy_weight=1.0 / 11.0,
    learning_rate=1e-3,
    scans_per_step=128,
    beams_per_step=1 << 30,
    num_free=19,
    is_as_published=True,
)

# Cold start of depth images.
LOCALIZE_DEPTH = replace(
    LOCALIZE, learning_rate=1e-3, beams_per_step=400, num_offsets=2, max_offset=3, scans_per_window=None
)

# Free poses of depth images; the decreasing limit of the Chamfer distance removes its bias at low overlap.
UNROLL_DEPTH = replace(
    LOCALIZE_DEPTH,
    name="free poses, Chamfer",
    poses="free",
    num_steps=300,
    learning_rate=1e-2,
    final_learning_rate=0.02,
    chamfer_limit=(0.5, 0.05),
)

# Free poses and a map that sharpens from coarse to fine. The Chamfer distance is biased by the spacing of the pixels
# and by points that only one image has observed; the comparison by projection is not.
REFINE_DEPTH = replace(
    REFINE,
    name="free poses and map",
    num_steps=150,
    occupancy_weight=0.1,
    learning_rate=2e-3,
    beams_per_step=200,
    max_offset=1 << 30,
    surface_distance=(0.05, 0.01),
    projective_tolerance=(0.05, 0.005),
)

# Phase of the paper for depth images (section 4.2): lambda = 0.1, 35 free samples on each ray, batches of 8 images. As
# in the published program, each image is compared to the next one.
JOINT_DEPTH = replace(JOINT, occupancy_weight=1.0 / 1.1, scans_per_step=8, num_offsets=1, max_offset=1, num_free=35)

_FAST: dict[str, DeepMappingConfig] = {
    "planar": DeepMappingConfig(),
    "depth": DeepMappingConfig(
        cold_phases=(LOCALIZE_DEPTH, UNROLL_DEPTH, REFINE_DEPTH),
        warm_phases=(REFINE_DEPTH,),
        localization=LocalizationNetConfig(features=(32, 64, 128), strides=(2, 2, 1), dilation=3, hidden=(128, 64)),
        occupancy=OccupancyConfig(kind="grid", resolutions=(8, 16, 32, 64)),
        steps_per_call=50,
    ),
}
# Phase, L-Net and unit of the paper for each sensor. Its worlds have a side of 1024 px, two units of the published
# program; the unit of its depth images is 2 m.
_PAPER = {
    "planar": (JOINT, LocalizationNetConfig(), 512.0),
    "depth": (JOINT_DEPTH, LocalizationNetConfig(features=(64, 128, 256, 1024), strides=(1,) * 4), 2.0),
}


def preset(
    name: Literal["fast", "paper"],
    sensor: Literal["planar", "depth"] = "planar",
    *,
    motion: Motion = "planar",
    is_organised: bool = True,
) -> DeepMappingConfig:
    """Returns the settings of a preset.

    Args:
        name: "fast" (seconds to a minute on two cores) or "paper" (its networks, losses, sampling, epochs and unit).
            The unit of planar scans is that of the paper's worlds, 512 px; for scans in metres use
            `dataclasses.replace(preset("paper"), unit=None)`, or half of the side of the area.
        sensor: "planar" scans or "depth" images.
        motion: degrees of freedom of a depth camera.
        is_organised: False for planar scans whose beams have no order; L-Net is a PointNet then.

    Returns:
        The settings.

    Raises:
        ValueError: the name or the sensor is unknown.
    """
    require_one_of("preset", name, ("fast", "paper"))
    require_one_of("sensor", sensor, _FAST)
    config = _FAST[sensor]
    if sensor == "depth":
        config = replace(config, motion=motion)
    if name == "paper":
        phase, net, unit = _PAPER[sensor]
        config = replace(config, cold_phases=(phase,), warm_phases=(phase,), unit=unit, steps_per_call=1)
        config = replace(config, localization=net, occupancy=OccupancyConfig())
    elif sensor == "depth" and motion == "full":
        # Real depth images in SE(3) do not agree to half a percent of the depth, and initial poses are less accurate.
        refine = replace(REFINE_DEPTH, projective_tolerance=(0.1, 0.02))
        config = replace(config, cold_phases=(*config.cold_phases[:-1], refine), warm_phases=(refine,))
    if not is_organised:
        config = replace(config, localization=replace(config.localization, kind="point"))
    return config
