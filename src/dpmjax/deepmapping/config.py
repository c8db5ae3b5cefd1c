"""Settings of DeepMapping: the phases of a fit, the networks and presets of planar scans, what all presets share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

from dpmjax.nets.localization import LocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig

ConfigT = TypeVar("ConfigT", bound="DeepMappingConfig")

Motion = Literal["planar", "full"]
"""Motion of a depth camera: x, z and the angle about y, as in the paper; or a twist in SE(3)."""


@dataclass(frozen=True)
class PhaseConfig:
    """One phase of the fit. Lengths are in typical ranges: the range that nine beams in ten stay below.

    Attributes:
        name: shown in logs and pictures.
        poses: "network": L-Net gives the poses; "free": the poses themselves are optimised.
        num_steps: steps of Adam.
        occupancy_weight: gamma in gamma BCE + (1 - gamma) Chamfer; 0 leaves M-Net out.
        learning_rate: of L-Net or of the poses.
        final_learning_rate: share of it that is left at the end (cosine).
        map_learning_rate: of M-Net.
        adam_decay: Adam's decay rates of both moments, for poses or L-Net.
        scans_per_step: scans in a step, in blocks of neighbours in time.
        beams_per_step: beams, or pixels of a depth image, of each scan in a step.
        num_offsets: number of later scans that each scan is compared to.
        max_offset: the largest distance in time to a scan that it is compared to; the next one is always compared.
        num_free: free samples a beam, drawn between sensor and hit.
        is_free_factor_shared: one factor a sample for all beams and scans (the published program), else one each.
        surface_distance: distance of one more free sample from the hit, at the start and at the end of the phase;
            None: no such sample.
        anneal_until: share of the phase after which all levels of the map are on.
        map_decay: weight of the mean square of a grid's nodes.
        chamfer_limit: larger distances count as this one in the Chamfer term, at the start and at the end of the phase,
            so that what only one scan has seen does not pull; None: no limit.
        projection_tolerance: for depth images. Images are compared by projection instead of by the Chamfer distance:
            share of the depth by which matching points may differ, at the start and at the end of the phase. The
            images after the last are then the first ones, so that any two can meet. None: Chamfer distance.
        plane_width: for clouds. Scans are compared by the distance of points to planes instead of by the Chamfer
            distance: width of the robust kernel, at the start and at the end of the phase. None: Chamfer distance.
        num_revisits: for clouds compared by planes: scans near in space but not in time that each scan is compared to.
        scans_per_window: for planar scans. The set is cut into windows of so many neighbours in time, each with its
            own L-Net (or free poses), and joined at the scans that windows share. A step holds all windows.
            None: one L-Net for the whole set.
    """

    name: str
    poses: Literal["network", "free"]
    num_steps: int
    occupancy_weight: float
    learning_rate: float
    final_learning_rate: float = 1.0
    map_learning_rate: float = 1e-3
    adam_decay: tuple[float, float] = (0.9, 0.999)
    scans_per_step: int = 256
    beams_per_step: int = 64
    num_offsets: int = 3
    max_offset: int = 3
    num_free: int = 1
    is_free_factor_shared: bool = False
    surface_distance: tuple[float, float] | None = None
    anneal_until: float = 0.0
    map_decay: float = 0.0
    chamfer_limit: tuple[float, float] | None = None
    projection_tolerance: tuple[float, float] | None = None
    plane_width: tuple[float, float] | None = None
    num_revisits: int = 0
    scans_per_window: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.occupancy_weight <= 1.0:
            raise ValueError(f"occupancy_weight: expected 0 to 1, got {self.occupancy_weight}")
        if not 1 <= self.num_offsets <= self.max_offset:
            raise ValueError(f"num_offsets: expected 1 to max_offset = {self.max_offset}, got {self.num_offsets}")
        if self.num_steps < 1:
            raise ValueError(f"num_steps: expected at least 1, got {self.num_steps}")
        if self.scans_per_window is not None and self.scans_per_window < 2:
            raise ValueError(f"scans_per_window: expected at least 2, got {self.scans_per_window}")


LOCALIZE = PhaseConfig(
    name="L-Net",
    poses="network",
    num_steps=400,
    occupancy_weight=0.0,
    learning_rate=3e-3,
    final_learning_rate=0.05,
    adam_decay=(0.9, 0.99),
    beams_per_step=128,
    num_offsets=3,
    max_offset=8,
    scans_per_window=17,
)
"""Cold start: an L-Net a window moves its poses together; the map comes later, it would freeze the first bad guess."""

REFINE = PhaseConfig(
    name="free poses",
    poses="free",
    num_steps=800,
    occupancy_weight=0.5,
    learning_rate=2.5e-3,
    final_learning_rate=0.02,
    map_learning_rate=0.1,
    adam_decay=(0.9, 0.99),
    num_free=1,
    surface_distance=(0.1, 0.004),
    anneal_until=0.7,
    map_decay=1e-3,
)
"""Free poses and a map that sharpens from coarse to fine."""

JOINT = PhaseConfig(
    name="L-Net and M-Net",
    poses="network",
    num_steps=6000,
    occupancy_weight=0.1,
    learning_rate=1e-3,
    map_learning_rate=1e-3,
    scans_per_step=128,
    beams_per_step=1 << 30,
    num_free=19,
    is_free_factor_shared=True,
)
"""The paper: 3000 epochs of two batches for 256 scans, all beams, 19 free samples, gamma 0.1, windows of 4 scans."""


@dataclass(frozen=True)
class DeepMappingConfig:
    """Settings of the fit of planar scans.

    Attributes:
        cold_phases: phases from zero poses.
        warm_phases: phases from given poses.
        localization: shape of L-Net.
        occupancy: shape of M-Net.
        steps_per_call: the largest number of steps that are compiled into one call.
        map_margin: side of the map over the extent of the scans at the start of a phase.
    """

    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE, REFINE)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE,)
    localization: LocalizationConfig = field(
        default_factory=lambda: LocalizationConfig(
            features=(32, 64, 128), strides=(1, 2, 2), is_circular=True, hidden=(128, 64), output_scale=0.1
        )
    )
    occupancy: OccupancyConfig = field(default_factory=lambda: OccupancyConfig(kind="grid"))
    steps_per_call: int = 25
    map_margin: float = 1.15

    def __post_init__(self) -> None:
        for phases in (self.cold_phases, self.warm_phases):
            lengths = {phase.scans_per_window for phase in phases if phase.poses == "network"}
            if len(lengths) > 1:
                raise ValueError(f"scans_per_window: phases with L-Net share its weights, got windows of {lengths}")


@dataclass(frozen=True)
class SpatialMappingConfig(DeepMappingConfig):
    """Settings of a fit in space, of depth images or clouds; attributes as in DeepMappingConfig.

    Attributes:
        motion: degrees of freedom of the sensor.
    """

    motion: Motion = "full"
    occupancy: OccupancyConfig = field(
        default_factory=lambda: OccupancyConfig(kind="grid", resolutions=(8, 16, 32, 64))
    )


def preset(name: Literal["fast", "paper"], *, is_organised: bool = True) -> DeepMappingConfig:
    """The settings of a preset.

    Args:
        name: "fast" (a minute on two cores) or "paper" (its architecture, losses and sampling).
        is_organised: the beams are in order; else L-Net is a PointNet.

    Returns:
        The settings.

    Raises:
        ValueError: the name is unknown.
    """
    check_preset(name)
    config = DeepMappingConfig()
    if name == "paper":
        config = as_published(config, JOINT, LocalizationConfig())
    if not is_organised:
        config = replace(config, localization=replace(config.localization, kind="point"))
    return config


def as_published(config: ConfigT, phase: PhaseConfig, localization: LocalizationConfig) -> ConfigT:
    """The settings with the paper's networks.

    Args:
        config: settings of a fit.
        phase: its only phase.
        localization: shape of L-Net.

    Returns:
        The settings.
    """
    config = replace(config, localization=localization, occupancy=OccupancyConfig(), steps_per_call=1)
    return replace(config, cold_phases=(phase,), warm_phases=(phase,))


def check_preset(name: str) -> None:
    """Raises a ValueError where the name of a preset is unknown."""
    if name not in ("fast", "paper"):
        raise ValueError(f"preset: expected 'fast' or 'paper', got {name!r}")


def as_direct(config: ConfigT) -> ConfigT:
    """The paper's baseline: the same losses and steps, but the poses themselves are optimised, never L-Net.

    Args:
        config: settings of a fit.

    Returns:
        The settings with free poses in every phase.
    """
    cold, warm = ([replace(phase, poses="free") for phase in p] for p in (config.cold_phases, config.warm_phases))
    return replace(config, cold_phases=tuple(cold), warm_phases=tuple(warm))


def with_steps(config: ConfigT, num_steps: int) -> ConfigT:
    """The same settings with another number of steps, divided among the phases as before.

    Args:
        config: settings of a fit.
        num_steps: steps of all phases together.

    Returns:
        The settings.

    Raises:
        ValueError: there are fewer steps than phases.
    """

    def shorten(phases: tuple[PhaseConfig, ...]) -> tuple[PhaseConfig, ...]:
        if num_steps < len(phases):
            raise ValueError(f"steps: expected at least one for each of {len(phases)} phases, got {num_steps}")
        total = sum(phase.num_steps for phase in phases)
        counts = [max(1, round(phase.num_steps * num_steps / total)) for phase in phases[:-1]]
        counts.append(max(1, num_steps - sum(counts)))
        return tuple(replace(phase, num_steps=count) for phase, count in zip(phases, counts, strict=True))

    cold, warm = shorten(config.cold_phases), shorten(config.warm_phases)
    return replace(config, cold_phases=cold, warm_phases=warm, steps_per_call=min(config.steps_per_call, num_steps))
