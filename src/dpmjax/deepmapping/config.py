"""Settings of DeepMapping: what a phase of the fit optimises, with which losses, and the two presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from dpmjax.nets.localization import LocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig


@dataclass(frozen=True)
class PhaseConfig:
    """One phase of the fit. Lengths are in reaches: the range that nine beams in ten stay below.

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
        beams_per_step: beams of each scan in a step.
        num_offsets: each scan is compared to so many later ones.
        max_offset: which are drawn among the next so many; the next one is always among them.
        num_free: free samples a beam, drawn between sensor and hit.
        is_free_factor_shared: one factor a sample for all beams and scans (the published program), else one each.
        surface_distance: a further free sample in front of the hit, at about this distance at the start and at the
            end of the phase; None: none.
        anneal_until: share of the phase after which all levels of the map are on.
        map_decay: weight of the mean square of a grid's nodes.
        chamfer_limit: larger distances count as this one in the Chamfer term, at the start and at the end of the phase,
            so that what only one scan has seen does not pull; None: no limit.
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

    def __post_init__(self) -> None:
        if not 0.0 <= self.occupancy_weight <= 1.0:
            raise ValueError(f"occupancy_weight: expected 0 to 1, got {self.occupancy_weight}")
        if not 1 <= self.num_offsets <= self.max_offset:
            raise ValueError(f"num_offsets: expected 1 to max_offset = {self.max_offset}, got {self.num_offsets}")
        if self.num_steps < 1:
            raise ValueError(f"num_steps: expected at least 1, got {self.num_steps}")


LOCALIZE = PhaseConfig(
    name="L-Net",
    poses="network",
    num_steps=600,
    occupancy_weight=0.0,
    learning_rate=3e-3,
    final_learning_rate=0.05,
    adam_decay=(0.9, 0.99),
    num_offsets=3,
    max_offset=8,
)
"""Cold start: L-Net moves all poses together; the map comes later, it would freeze the first bad guess."""

REFINE = PhaseConfig(
    name="free poses",
    poses="free",
    num_steps=2000,
    occupancy_weight=0.5,
    learning_rate=2.5e-3,
    final_learning_rate=0.02,
    map_learning_rate=0.1,
    adam_decay=(0.9, 0.99),
    num_free=1,
    surface_distance=(0.1, 0.008),
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
    """Settings of the whole fit.

    Attributes:
        cold_phases: phases from zero poses.
        warm_phases: phases from given poses.
        localization: shape of L-Net.
        occupancy: shape of M-Net.
        steps_per_call: at most so many steps are compiled into one call.
        map_margin: the map's square is so many times larger than what the scans cover at the start of a phase.
    """

    cold_phases: tuple[PhaseConfig, ...] = (LOCALIZE, REFINE)
    warm_phases: tuple[PhaseConfig, ...] = (REFINE,)
    localization: LocalizationConfig = field(
        default_factory=lambda: LocalizationConfig(
            features=(32, 64, 128), strides=(1, 2, 2), is_circular=True, hidden=(128, 64)
        )
    )
    occupancy: OccupancyConfig = field(default_factory=lambda: OccupancyConfig(kind="grid"))
    steps_per_call: int = 25
    map_margin: float = 1.15

    def phases(self, *, is_warm: bool) -> tuple[PhaseConfig, ...]:
        """The phases of a start."""
        return self.warm_phases if is_warm else self.cold_phases


def preset(name: Literal["fast", "paper"], *, is_organised: bool = True) -> DeepMappingConfig:
    """The settings of a preset.

    Args:
        name: "fast" (minutes on two cores) or "paper" (its architecture, losses and sampling).
        is_organised: the beams are in order; else L-Net is a PointNet.

    Returns:
        The settings.

    Raises:
        ValueError: the name is unknown.
    """
    if name == "fast":
        config = DeepMappingConfig()
    elif name == "paper":
        config = DeepMappingConfig(
            cold_phases=(JOINT,),
            warm_phases=(JOINT,),
            localization=LocalizationConfig(),
            occupancy=OccupancyConfig(),
            steps_per_call=1,
        )
    else:
        raise ValueError(f"preset: expected 'fast' or 'paper', got {name!r}")
    if not is_organised:
        config = replace(config, localization=replace(config.localization, kind="point"))
    return config


def with_steps(config: DeepMappingConfig, num_steps: int) -> DeepMappingConfig:
    """The same settings with so many steps in all, divided among the phases as before.

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

    per_call = min(config.steps_per_call, num_steps)
    return replace(
        config,
        cold_phases=shorten(config.cold_phases),
        warm_phases=shorten(config.warm_phases),
        steps_per_call=per_call,
    )
