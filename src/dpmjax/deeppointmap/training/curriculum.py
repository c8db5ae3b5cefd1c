"""Settings of training: the stages of the curriculum, and the sizes of the maps in their samples.

Each step draws one size for all of its groups, and how it is split into two maps (DeepPointMap's published program).
The arrays of a step have the capacity of the next powers of two, so that all sizes of a training need few compiled
steps: up to 15 for maps of up to 16 scans.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from dpmjax.checks import require_count, require_fields, require_one_of, require_positive_fields, require_value
from dpmjax.deeppointmap.model import Initialization
from dpmjax.deeppointmap.model_config import ModelConfig, Preset, Stage, model_preset
from dpmjax.deeppointmap.training.objective import ObjectiveConfig
from dpmjax.scan.lidar.augment import AugmentConfig

# Probability that all groups of a step are pairs of scans, whatever the stage; other steps may draw pairs, too.
PAIR_PROBABILITY = 0.34

# Smallest distance of a scan from its anchor, metres; nearer ones are too similar (published configuration).
MIN_DISTANCE_M = 0.25

# Capacity of the pairs within 2 m of a descriptor, of which the published loss takes all. More need more memory. In a
# simulated street a descriptor had up to 9 in a map of 8 scans, and 2 in a scan; 4 would leave out a seventh of them.
MAX_CLOSE = 32

LAYOUT_STREAM = 3105


class Layout(NamedTuple):
    """Sizes of the groups of one sample, or their capacities.

    Attributes:
        num_source: number of scans in the first map of each group, at most that of the second.
        num_target: number of scans in the second map of each group.
        num_groups: number of groups.
        num_scans: number of scans of all groups.
    """

    num_source: int
    num_target: int
    num_groups: int
    num_scans: int


@dataclass(frozen=True)
class CurriculumStage:
    """A part of training with one largest size of groups.

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
        max_side: largest number of scans of one map. Half of the groups of at most this size are split into one scan
            against all others.
    """

    num_scans: int = 32
    max_distance_m: float = 20.0
    max_side: int = 16

    def __post_init__(self) -> None:
        require_fields(self, "max_side", low=1)
        require_fields(self, "num_scans", low=2)
        require_value(
            self.max_distance_m > MIN_DISTANCE_M, "max_distance_m", f"above {MIN_DISTANCE_M}", self.max_distance_m
        )


@dataclass(frozen=True)
class OverlapConfig:
    """Settings of the second stage, which trains the overlap head alone (defaults: DeepPointMap's published program).

    Attributes:
        num_epochs: number of times that each scan is the first of a pair; of a pool, that each pair is seen.
        batch_pairs: number of pairs of a step.
        pool_pairs: number of pairs whose features are computed once and kept in memory; 0 draws and encodes new pairs
            for each step. A quarter of a pool is of streets that were seen twice, or of places that look alike.
        rate_share: learning rate and weight decay, as shares of those of the first stage.
    """

    num_epochs: int = 10
    batch_pairs: int = 32
    pool_pairs: int = 0
    rate_share: float = 0.1

    def __post_init__(self) -> None:
        require_fields(self, "num_epochs", "batch_pairs", low=1)
        require_fields(self, "pool_pairs", low=0)
        require_positive_fields(self, "rate_share")

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
        num_variants: number of times that a scan is thinned, occluded and jittered. Steps choose among these variants.
            0 prepares the scan anew at each use. This needs no disk and more processors.
        thins_as_in_use: True: the points of a scan are thinned as for `encode`, in their order, and outliers are
            removed. False: they are shuffled before the voxel filter, and outliers stay.
        thins_maps: True: maps are thinned as in SLAM, to at most 1,024 descriptors. False: they keep all descriptors.
        refines_labels: True: the scans of a group are aligned by ICP from their given poses (ours, as the published
            program aligns pairs beforehand).
        num_epochs: number of times that each scan is the first of a group; `train` computes the steps. None: the steps
            are those of the curriculum.
        initialization: random parameters before the first step, as for `init_model`.
        objective: losses.
        learning_rate: first value of the learning rate, which falls by a cosine over the whole training.
        final_learning_rate: learning rate at the end.
        warmup_steps: number of steps in which a factor of the learning rate rises from 0 to 1.
        max_gradient_norm: longer gradients are scaled down to this norm; infinity for none.
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
    num_variants: int = 0
    thins_as_in_use: bool = False
    thins_maps: bool = False
    refines_labels: bool = False
    num_epochs: float | None = None
    initialization: Initialization = "uniform"
    # The published loss takes all pairs within its radius.
    objective: ObjectiveConfig = field(default_factory=lambda: ObjectiveConfig(max_close=MAX_CLOSE))
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    warmup_steps: int = 0
    max_gradient_norm: float = math.inf
    scans_at_once: int = 8
    stages: tuple[Stage, ...] = ("registration", "overlap")
    overlap: OverlapConfig = field(default_factory=OverlapConfig)

    def __post_init__(self) -> None:
        require_positive_fields(self, "learning_rate", "final_learning_rate")
        require_fields(self, "warmup_steps", "num_variants", low=0)
        require_fields(self, "scans_at_once", low=1)
        require_one_of("initialization", self.initialization, get_args(Initialization))
        for name, value in (("max_gradient_norm", self.max_gradient_norm), ("num_epochs", self.num_epochs)):
            require_value(value is None or value > 0, name, "more than 0", value)
        require_count("len(curriculum)", len(self.curriculum))
        for stage in self.stages:
            require_one_of("stages", stage, get_args(Stage))
        require_count("len(stages)", len(self.stages))
        largest = max(stage.max_group for stage in self.curriculum)
        num_scans, max_side = self.sampling.num_scans, self.sampling.max_side
        require_value(largest <= num_scans, "sampling.num_scans", f"at least the largest group, {largest}", num_scans)
        require_value(
            largest <= 2 * max_side, "sampling.max_side", f"at least half the largest group, {largest}", max_side
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

    def layout_at(self, step: int, *, seed: int) -> Layout:
        """Draws the sizes of the groups of a step, which all samples of its batch share.

        Args:
            step: number of the step, from 0.
            seed: seed of the training.

        Returns:
            The layout, the same one every time.
        """
        rng = np.random.default_rng([LAYOUT_STREAM, seed, step])
        return draw_layout(self.stage_at(step).max_group, self.sampling, rng)

    def with_steps(self, num_steps: int) -> TrainingConfig:
        """Shortens or stretches all stages in proportion, none to less than one step.

        Args:
            num_steps: about this many steps in all.

        Returns:
            A new configuration, whose steps no longer depend on the number of scans.
        """
        ratio = num_steps / self.num_steps
        stages = tuple(replace(stage, num_steps=max(1, round(stage.num_steps * ratio))) for stage in self.curriculum)
        warmup = min(round(self.warmup_steps * min(ratio, 1)), sum(stage.num_steps for stage in stages) - 1)
        return replace(self, curriculum=stages, warmup_steps=warmup, num_epochs=None)

    def for_scans(self, num_scans: int, *, num_samples: int = 1) -> TrainingConfig:
        """Computes the steps of `num_epochs` for a data set.

        Args:
            num_scans: number of scans of all drives.
            num_samples: number of samples of a step, one for each device.

        Returns:
            A configuration with fixed steps; the same one where `num_epochs` is None.
        """
        if self.num_epochs is None:
            return self
        return self.with_steps(math.ceil(self.num_epochs * num_scans / num_samples))


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
# normals of walls are not horizontal. Sectors and boxes occlude at equal odds.
NEAR_THE_LIDAR = AugmentConfig(
    sector_probability=0.05, box_probability=0.05, max_tilt_rad=0.05, translation_sigma_m=0.3
)

PRESETS = {
    "tiny": TrainingConfig(
        model=model_preset("tiny"),
        curriculum=(CurriculumStage(2, 300),),
        sampling=SamplingConfig(num_scans=16),
        # Few steps need weaker augmentation, more positives, and a direct loss on the encoder.
        augment=replace(NEAR_THE_LIDAR, max_drop_ratio=0.3),
        objective=ObjectiveConfig(coarse_weight=1.0, positive_radius_m=1.5, max_close=4),
        num_variants=2,
        thins_as_in_use=True,
        thins_maps=True,
        initialization="normal",
        learning_rate=2e-3,
        warmup_steps=20,
        max_gradient_norm=5.0,
        overlap=OverlapConfig(num_epochs=30, pool_pairs=1024),
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
        thins_as_in_use=True,
        thins_maps=True,
        initialization="normal",
        scans_at_once=4,
        overlap=OverlapConfig(num_epochs=40, pool_pairs=2048),
    ),
    # Steps of the curriculum: twelve epochs of 10,000 scans on one device.
    "paper": TrainingConfig(num_epochs=12.0),
}


def draw_layout(max_group: int, config: SamplingConfig, rng: np.random.Generator) -> Layout:
    """Draws the size of all groups of a step, and its split (DeepPointMap's published program).

    The size is 2 with `PAIR_PROBABILITY`, else 2 to `max_group`, each number equally likely. The losses are symmetric,
    so the smaller map of a group is always the first.

    Args:
        max_group: largest number of scans in both maps of a group together.
        config: capacity of a sample, and of a map.
        rng: source of the draws.

    Returns:
        As many groups as a sample has room for.
    """
    size = 2 if rng.random() < PAIR_PROBABILITY else int(rng.integers(2, max_group + 1))
    is_scan_to_map = size <= config.max_side and rng.random() < 0.5
    least, most = max(1, size - config.max_side), min(size - 1, config.max_side)
    first = 1 if is_scan_to_map else int(rng.integers(least, most + 1))
    num_groups = config.num_scans // size
    return Layout(min(first, size - first), max(first, size - first), num_groups, num_groups * size)


@functools.cache
def layout_capacity(layout: Layout, config: SamplingConfig) -> Layout:
    """Finds the capacity of the arrays for a layout; each capacity compiles one step.

    Args:
        layout: sizes from `draw_layout`.
        config: capacity of a sample, and of a map.

    Returns:
        The next power of two of each map, and room for the groups and scans of all layouts with these.
    """
    sides = [1 << (num - 1).bit_length() for num in (layout.num_source, layout.num_target)]
    ranges = [range(side // 2 + 1, min(side, config.max_side) + 1) for side in sides]
    sizes = {source + target for source in ranges[0] for target in ranges[1] if source + target <= config.num_scans}
    num_groups = {size: config.num_scans // size for size in sizes}
    num_scans = max(size * num for size, num in num_groups.items())
    return Layout(ranges[0][-1], ranges[1][-1], max(num_groups.values()), num_scans)
