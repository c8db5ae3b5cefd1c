"""From pairs of scans to pairs of maps: how training is divided into stages, and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from dpmjax.checks import require_count, require_positive
from dpmjax.deeppointmap.model import ModelConfig
from dpmjax.deeppointmap.objective import ObjectiveConfig
from dpmjax.deeppointmap.presets import Preset, model_preset
from dpmjax.deeppointmap.sampling import SamplingConfig
from dpmjax.scans.augment import AugmentConfig


@dataclass(frozen=True)
class CurriculumStage:
    """A part of training in which groups have up to so many scans. Each compiles one step.

    Attributes:
        max_group: scans in both maps of a group together; the published curriculum doubles it from 2 to 32.
        num_steps: how long.
    """

    max_group: int
    num_steps: int

    def __post_init__(self) -> None:
        if self.max_group < 2:
            raise ValueError(f"max_group: expected at least 2, got {self.max_group}")
        require_count("num_steps", self.num_steps)


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that training depends on but the scans (DeepPointMap section 3.3 and its published configuration).

    Attributes:
        model: what is trained.
        curriculum: the stages of the registration part.
        overlap_steps: steps of the part after it, in which only the overlap head learns; may be 0.
        sampling: which scans make a sample.
        augment: what is done to each scan.
        objective: the losses of the registration part.
        learning_rate: at the start of the cosine.
        final_learning_rate: at its end.
        weight_decay: of AdamW.
        warmup_steps: the learning rate rises from 0 for so long.
        max_gradient_norm: longer gradients are shortened to this.
        overlap_ratio: learning rates and weight decay of the overlap part, relative to those above.
        scans_at_once: about so many scans of a sample are worked on at a time, for the rest waits: more need more
            memory and keep a large device busy. It changes nothing but rounding.
    """

    model: ModelConfig = field(default_factory=ModelConfig)
    curriculum: tuple[CurriculumStage, ...] = tuple(
        CurriculumStage(max_group, num_steps)
        for max_group, num_steps in ((2, 20000), (4, 20000), (8, 30000), (16, 30000), (32, 20000))
    )
    overlap_steps: int = 20000
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    weight_decay: float = 1e-4
    warmup_steps: int = 0
    max_gradient_norm: float = 35.0
    overlap_ratio: float = 0.1
    scans_at_once: int = 8

    def __post_init__(self) -> None:
        for name in ("learning_rate", "final_learning_rate", "max_gradient_norm", "overlap_ratio"):
            require_positive(name, getattr(self, name))
        for name in ("overlap_steps", "weight_decay", "warmup_steps"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        require_count("len(curriculum)", len(self.curriculum))
        require_count("scans_at_once", self.scans_at_once)
        largest = max(stage.max_group for stage in self.curriculum)
        if largest > self.sampling.num_scans:
            raise ValueError(
                f"sampling.num_scans: expected at least the largest group, {largest}, got {self.sampling.num_scans}"
            )

    @property
    def registration_steps(self) -> int:
        """Steps of all stages of the curriculum."""
        return sum(stage.num_steps for stage in self.curriculum)

    @property
    def num_steps(self) -> int:
        """Steps of both parts."""
        return self.registration_steps + self.overlap_steps

    def stage_at(self, step: int) -> CurriculumStage | None:
        """The stage of a step, counted from 0; None in the overlap part.

        Raises:
            ValueError: training does not last so long.
        """
        if not 0 <= step < self.num_steps:
            raise ValueError(f"step: expected from 0 to {self.num_steps - 1}, got {step}")
        for stage in self.curriculum:
            if step < stage.num_steps:
                return stage
            step -= stage.num_steps
        return None

    def with_steps(self, num_steps: int) -> TrainingConfig:
        """The same in about so many steps, each part shortened or stretched alike, none to less than one."""
        ratio = num_steps / self.num_steps
        stages = tuple(replace(stage, num_steps=max(1, round(stage.num_steps * ratio))) for stage in self.curriculum)
        overlap = max(1, round(self.overlap_steps * ratio)) if self.overlap_steps > 0 else 0
        warmup = min(round(self.warmup_steps * min(ratio, 1)), sum(stage.num_steps for stage in stages) - 1)
        return replace(self, curriculum=stages, overlap_steps=overlap, warmup_steps=warmup)


def training_preset(name: Preset) -> TrainingConfig:
    """How each model preset is trained: minutes on two cores, hours on one GPU, days on several.

    Raises:
        ValueError: no preset has this name.
    """
    model = model_preset(name)
    if name == "tiny":
        return TrainingConfig(
            model=model,
            curriculum=(CurriculumStage(2, 700), CurriculumStage(4, 40)),
            overlap_steps=60,
            sampling=SamplingConfig(num_scans=16, max_side=2, num_overlap_pairs=8),
            # In so few steps: less disturbance, more positives, and the encoder is told directly.
            augment=AugmentConfig(max_drop_ratio=0.3, max_tilt_rad=0.05, translation_sigma_m=0.3),
            objective=ObjectiveConfig(coarse_weight=1.0, positive_radius_m=1.5, max_close=4),
            learning_rate=2e-3,
            warmup_steps=20,
            max_gradient_norm=5.0,
        )
    if name == "small":
        return TrainingConfig(
            model=model,
            curriculum=(
                CurriculumStage(2, 12000),
                CurriculumStage(4, 6000),
                CurriculumStage(8, 6000),
                CurriculumStage(16, 6000),
            ),
            overlap_steps=3000,
            objective=ObjectiveConfig(max_close=8),
            warmup_steps=500,
        )
    return TrainingConfig(model=model)
