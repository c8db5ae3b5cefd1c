"""Settings of training: the stages of the curriculum, and the sizes of the maps in their samples.

The sizes are a few fixed layouts for each stage, so that no step computes on empty rows. With groups
of up to 4 scans, attention over padded maps costs 5 times as much as over the valid scans alone, and 13 times with up
to 16. So the sizes of the groups are not drawn for each step. All layouts of a stage together have the proportions of
the published draw, and the steps take the layouts in turn. Each layout compiles one step.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from dpmjax.checks import require_count, require_fields, require_one_of, require_positive_fields
from dpmjax.deeppointmap.model_config import ModelConfig, Preset, Stage, model_preset
from dpmjax.deeppointmap.training.objective import ObjectiveConfig
from dpmjax.scans.augment import AugmentConfig

# Probability that a group is one pair of scans, in every stage.
PAIR_PROBABILITY = 0.34

# Smallest distance of a scan from its anchor, metres; nearer ones are too similar (published configuration).
MIN_DISTANCE_M = 0.25

# Share of the steps in which the learning rate falls, at the end (DeepPointMap's published configuration).
DECAY_RATIO = 0.2

# Number of scans in the first and in the second map of a group.
GroupShape = tuple[int, int]

# The groups of one sample, small ones first.
Layout = tuple[GroupShape, ...]

# Largest number of layouts of a stage, and of their scans together: a large sample has room for all sizes of groups.
NUM_LAYOUTS, LAYOUT_SCANS = 4, 128
# Golden ratio: any number of its multiples modulo 1 are spread evenly.
GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class CurriculumStage:
    """A part of training with one size of groups. Each stage compiles one step for each of its layouts.

    Attributes:
        max_group: largest number of scans in both maps of a group together; the published curriculum doubles it from 2
            to 32.
        num_steps: number of steps.
    """

    max_group: int
    num_steps: int

    def __post_init__(self) -> None:
        require_fields(self, "max_group", low=2)
        require_fields(self, "num_steps", low=1)


@dataclass(frozen=True)
class SamplingConfig:
    """Sizes and distances of samples (defaults: DeepPointMap's published configuration).

    Attributes:
        num_scans: capacity of one sample, all groups together.
        max_distance_m: largest distance of a scan of a group from its anchor, above `MIN_DISTANCE_M`.
        max_side: largest number of scans of one map. Half of the groups in which one scan can stand against all others
            are split so.
    """

    num_scans: int = 32
    max_distance_m: float = 20.0
    max_side: int = 16

    def __post_init__(self) -> None:
        require_fields(self, "max_side", low=1)
        require_fields(self, "num_scans", low=2)
        if not self.max_distance_m > MIN_DISTANCE_M:
            raise ValueError(f"max_distance_m: expected above {MIN_DISTANCE_M}, got {self.max_distance_m}")


@dataclass(frozen=True)
class OverlapConfig:
    """Settings of the second stage, which trains the overlap head alone (defaults: DeepPointMap's published program).

    Attributes:
        num_epochs: number of times that each scan is the first of a pair; of a pool, that each pair is seen.
        batch_pairs: number of pairs of a step.
        pool_pairs: number of pairs whose features are computed once and kept in memory; 0 draws and encodes new pairs
            for each step.
        hard_share: share of the pairs of a pool that are hard. Half of these are of one street that was seen twice; the
            others look alike, at least 20 m apart. Without such pairs, they are drawn as all others.
        rate_share: learning rate and weight decay, as shares of those of the first stage.
    """

    num_epochs: int = 10
    batch_pairs: int = 32
    pool_pairs: int = 0
    hard_share: float = 0.0
    rate_share: float = 0.1

    def __post_init__(self) -> None:
        require_fields(self, "num_epochs", "batch_pairs", low=1)
        require_fields(self, "pool_pairs", low=0)
        require_positive_fields(self, "rate_share")
        if not 0 <= self.hard_share <= (1 if self.pool_pairs else 0):
            expected = "expected 0 to 1, and 0 without a pool of pairs"
            raise ValueError(f"hard_share: {expected}, got {self.hard_share}")

    def num_steps(self, num_scans: int) -> int:
        """Computes the number of steps.

        Args:
            num_scans: number of scans that are trained on.

        Returns:
            At least 1.
        """
        return max(1, self.num_epochs * (self.pool_pairs or num_scans) // self.batch_pairs)


@dataclass(frozen=True)
class TrainingConfig:
    """All settings of training except the scans (DeepPointMap section 3.3 and its published configuration).

    Attributes:
        model: configuration of the model.
        curriculum: stages, in their order.
        sampling: choice of the scans of a sample.
        augment: augmentation of each scan. Each step draws a new motion for each scan.
        num_variants: number of times that a scan is thinned, occluded and jittered; steps choose among these variants.
        objective: losses.
        learning_rate: learning rate after the warm-up and before the decay.
        final_learning_rate: learning rate at the end of the decay.
        warmup_steps: number of steps in which the learning rate rises from 0.
        max_gradient_norm: longer gradients are scaled down to this norm.
        scans_at_once: about this many scans of a sample are encoded at the same time. More scans need more memory and
            keep a large device busy; the results change by rounding only.
        stages: stages that `train` does, in this order; "overlap" alone trains the head of a given model.
        overlap: settings of the second stage.
    """

    model: ModelConfig = field(default_factory=ModelConfig)
    curriculum: tuple[CurriculumStage, ...] = tuple(
        map(CurriculumStage, (2, 4, 8, 16, 32), (20000, 20000, 30000, 30000, 20000))
    )
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    num_variants: int = 4
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    warmup_steps: int = 0
    max_gradient_norm: float = 35.0
    scans_at_once: int = 8
    stages: tuple[Stage, ...] = ("registration", "overlap")
    overlap: OverlapConfig = field(default_factory=OverlapConfig)

    def __post_init__(self) -> None:
        require_positive_fields(self, "learning_rate", "final_learning_rate", "max_gradient_norm")
        require_fields(self, "warmup_steps", low=0)
        require_fields(self, "scans_at_once", "num_variants", low=1)
        require_count("len(curriculum)", len(self.curriculum))
        for stage in self.stages:
            require_one_of("stages", stage, get_args(Stage))
        require_count("len(stages)", len(self.stages))
        largest = max(stage.max_group for stage in self.curriculum)
        if largest > self.sampling.num_scans:
            raise ValueError(
                f"sampling.num_scans: expected at least the largest group, {largest}, got {self.sampling.num_scans}"
            )
        if largest > 2 * self.sampling.max_side:
            raise ValueError(
                f"sampling.max_side: expected at least half the largest group, {largest}, got {self.sampling.max_side}"
            )

    @property
    def num_steps(self) -> int:
        """Number of steps of all stages of the curriculum."""
        return sum(stage.num_steps for stage in self.curriculum)

    def stage_at(self, step: int) -> CurriculumStage:
        """Finds the stage of a step.

        Args:
            step: number of the step, from 0.

        Returns:
            The stage; the last one for later steps.
        """
        for stage in self.curriculum:
            if step < stage.num_steps:
                return stage
            step -= stage.num_steps
        return self.curriculum[-1]

    def layout_at(self, step: int) -> Layout:
        """Finds the layout of a step; those of its stage take turns.

        Args:
            step: number of the step, from 0.

        Returns:
            The layout.
        """
        layouts = stage_layouts(self.stage_at(step).max_group, self.sampling)
        return layouts[step % len(layouts)]

    def with_steps(self, num_steps: int) -> TrainingConfig:
        """Shortens or stretches all stages in proportion, none to less than one step.

        Args:
            num_steps: about this many steps in all.

        Returns:
            A new configuration.
        """
        ratio = num_steps / self.num_steps
        stages = tuple(replace(stage, num_steps=max(1, round(stage.num_steps * ratio))) for stage in self.curriculum)
        warmup = min(round(self.warmup_steps * min(ratio, 1)), sum(stage.num_steps for stage in stages) - 1)
        return replace(self, curriculum=stages, warmup_steps=warmup)


# Parts that DeepPointMap's Table 2 leaves out.
TrainingPart = Literal["offset-head", "coarse-loss", "curriculum", "occlusion"]


def without(config: TrainingConfig, part: TrainingPart) -> TrainingConfig:
    """Leaves a part of the training out (DeepPointMap Table 2).

    Args:
        config: settings of training.
        part: "curriculum" trains with the largest groups from the first step on.

    Returns:
        A new configuration with the same number of steps.

    Raises:
        ValueError: an unknown part.
    """
    require_one_of("part", part, get_args(TrainingPart))
    if part == "offset-head":
        decoder = replace(config.model.decoder, predicts_offsets=False)
        objective = replace(config.objective, offset_weight=0.0)
        return replace(config, model=replace(config.model, decoder=decoder), objective=objective)
    if part == "coarse-loss":
        return replace(config, objective=replace(config.objective, coarse_weight=0.0))
    if part == "curriculum":
        largest = max(stage.max_group for stage in config.curriculum)
        return replace(config, curriculum=(CurriculumStage(largest, config.num_steps),))
    return replace(config, augment=replace(config.augment, sector_probability=0.0, box_probability=0.0))


def training_preset(name: Preset) -> TrainingConfig:
    """Returns the training configuration of a preset.

    Args:
        name: "tiny" (minutes on two cores), "small" (hours on two cores) or "paper" (a GPU).

    Returns:
        The configuration.

    An unknown name raises a `ValueError`.
    """
    require_one_of("name", name, PRESETS)
    return PRESETS[name]


# For frames that turn with the scan: after a large motion rays do not start at the lidar, and after a large tilt
# normals of walls are not horizontal.
NEAR_THE_LIDAR = AugmentConfig(max_tilt_rad=0.05, translation_sigma_m=0.3)

PRESETS = {
    "tiny": TrainingConfig(
        model=model_preset("tiny"),
        curriculum=(CurriculumStage(2, 300),),
        sampling=SamplingConfig(num_scans=16),
        # Few steps need weaker augmentation, more positives, and a direct loss on the encoder.
        augment=replace(NEAR_THE_LIDAR, max_drop_ratio=0.3),
        objective=ObjectiveConfig(coarse_weight=1.0, positive_radius_m=1.5, max_close=4),
        learning_rate=2e-3,
        warmup_steps=20,
        max_gradient_norm=5.0,
        overlap=OverlapConfig(num_epochs=30, pool_pairs=1024, hard_share=0.25),
    ),
    "small": TrainingConfig(
        model=model_preset("small"),
        curriculum=tuple(map(CurriculumStage, (2, 4, 8, 16), (6000, 3000, 3000, 3000))),
        # Farther than published: pairs within 20 m are nearly all right after some thousand steps.
        sampling=SamplingConfig(num_scans=16, max_distance_m=25.0),
        augment=replace(
            NEAR_THE_LIDAR, max_drop_ratio=0.5, sparse_probability=0.4, max_tilt_rad=math.radians(15), tilt_power=3.0
        ),
        # Thousands of steps, not the published hundred thousand: more positives, a stronger direct loss on the encoder.
        objective=ObjectiveConfig(coarse_weight=0.5, positive_radius_m=1.5, max_close=4),
        warmup_steps=200,
        max_gradient_norm=10.0,
        num_variants=2,
        scans_at_once=4,
        overlap=OverlapConfig(num_epochs=40, pool_pairs=2048, hard_share=0.25),
    ),
    "paper": TrainingConfig(),
}


@functools.cache
def stage_layouts(max_group: int, config: SamplingConfig) -> tuple[Layout, ...]:
    """Makes the layouts of a stage.

    The published draw of a group: two scans with `PAIR_PROBABILITY`, else 2 to `max_group`, each number equally likely.
    One half of the groups is split into one scan against all others; the second half is split anywhere. The losses
    are symmetric, so the smaller map of a group is always the first.

    Args:
        max_group: largest number of scans in both maps of a group together.
        config: capacity of a sample, and proportions.

    Returns:
        From 1 to `NUM_LAYOUTS` different layouts of at most `config.num_scans` scans each.
    """
    num_layouts = max(1, min(NUM_LAYOUTS, LAYOUT_SCANS // config.num_scans))
    sizes = np.arange(2, max_group + 1)
    shares = np.full(len(sizes), (1 - PAIR_PROBABILITY) / len(sizes))
    shares[0] += PAIR_PROBABILITY
    num_groups = max(1, round(num_layouts * config.num_scans / float(sizes @ shares)))
    drawn = np.searchsorted(np.cumsum(shares) / shares.sum(), (np.arange(num_groups) + 0.5) / num_groups)
    layouts: list[list[GroupShape]] = [[] for _ in range(num_layouts)]
    room = [config.num_scans] * num_layouts
    for number, size in enumerate(sorted(sizes[drawn].tolist(), reverse=True)):
        emptiest = int(np.argmax(room))
        # Where the last large group does not fit, a smaller one takes its place.
        size = min(size, room[emptiest])
        if size >= 2:
            layouts[emptiest].append(_split(size, (number * GOLDEN) % 1, config))
            room[emptiest] -= size
    for layout, left in zip(layouts, room, strict=True):
        layout.extend([(1, 1)] * (left // 2))
    return tuple(dict.fromkeys(tuple(sorted(layout)) for layout in layouts))


def _split(size: int, draw: float, config: SamplingConfig) -> GroupShape:
    least, most = max(1, size - config.max_side), min(size - 1, config.max_side)
    if least == 1 and draw < 0.5:
        return 1, size - 1
    first = least + int((2 * draw % 1) * (most - least + 1))
    return min(first, size - first), max(first, size - first)
