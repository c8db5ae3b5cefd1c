"""Groups and pairs of scans: who may be in one, and how often."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.deeppointmap import CurriculumStage, SamplingConfig, TrainingConfig, training_preset
from dpmjax.deeppointmap.sampling import ScanTable, draw_groups, draw_overlap_pairs


def table(num: int = 60, step_m: float = 2.0) -> ScanTable:
    """Two drives in two worlds that happen to have the same coordinates."""
    poses = np.tile(np.eye(4), (2 * num, 1, 1))
    poses[:, 0, 3] = step_m * np.tile(np.arange(num), 2)
    return ScanTable(poses, np.repeat([0, 1], num))


@pytest.mark.parametrize("max_group", [2, 4, 32])
def test_groups_hold_scans_of_one_place(max_group: int) -> None:
    scans, config = table(), SamplingConfig()
    sizes = []
    for seed in range(20):
        groups = draw_groups(scans, 5, max_group, config, np.random.default_rng(seed))
        assert 5 in np.concatenate(groups[0])
        assert sum(len(side) for group in groups for side in group) <= config.num_scans
        assert len(groups) <= config.num_groups(max_group)
        for group in groups:
            members = np.concatenate(group)
            assert len(set(members)) == len(members)
            assert len(set(scans.scene[members])) == 1
            assert max(map(len, group)) <= config.side_capacity(max_group)
            assert min(map(len, group)) >= 1
            places = scans.positions[members, 0]
            assert np.ptp(places) <= 2 * config.max_distance_m
            sizes.append(len(members))
    assert max(sizes) <= max_group
    assert np.mean(np.array(sizes) == 2) >= config.pair_probability / 2
    assert max_group == 2 or max(sizes) > 2


def test_a_lonely_scan_has_no_group() -> None:
    with pytest.raises(ValueError, match="none in"):
        draw_groups(table(step_m=100.0), 0, 2, SamplingConfig(), np.random.default_rng(0))


def test_overlap_pairs_are_half_near_a_quarter_apart_a_quarter_far() -> None:
    scans, config = table(), SamplingConfig(num_overlap_pairs=800)
    pairs = draw_overlap_pairs(scans, config, np.random.default_rng(0))
    distances = np.abs(scans.positions[pairs.first, 0] - scans.positions[pairs.second, 0])
    np.testing.assert_array_equal(pairs.is_overlap, distances <= 20.0)
    np.testing.assert_array_equal(scans.scene[pairs.first], scans.scene[pairs.second])
    assert abs(np.mean(distances <= 20) - 0.5) < 0.06
    assert abs(np.mean(distances > 40) - 0.25) < 0.06


def test_draws_depend_on_the_generator_alone() -> None:
    first, second = (draw_groups(table(), 3, 8, SamplingConfig(), np.random.default_rng(4)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(np.concatenate(a), np.concatenate(b))


def test_stages_follow_each_other() -> None:
    config = TrainingConfig(curriculum=(CurriculumStage(2, 3), CurriculumStage(4, 2)), overlap_steps=1)
    found = [config.stage_at(step) for step in range(config.num_steps)]
    assert [stage.max_group if stage else None for stage in found] == [2, 2, 2, 4, 4, None]
    with pytest.raises(ValueError, match="step"):
        config.stage_at(6)
    assert config.with_steps(60).num_steps == 60
    assert config.with_steps(1).num_steps == 3


@pytest.mark.parametrize("name", ["tiny", "small", "paper"])
def test_presets_double_the_groups(name) -> None:
    stages = training_preset(name).curriculum
    assert [stage.max_group for stage in stages] == [2 ** (i + 1) for i in range(len(stages))]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CurriculumStage(1, 3), "max_group"),
        (lambda: SamplingConfig(min_distance_m=30.0), "min_distance_m"),
        (lambda: SamplingConfig(far_distance_m=10.0), "far_distance_m"),
        (lambda: TrainingConfig(sampling=SamplingConfig(num_scans=16)), "num_scans"),
        (lambda: TrainingConfig(learning_rate=0.0), "learning_rate"),
        (lambda: ScanTable(np.zeros((3, 4, 4)), np.zeros(2, int)), "T_world_lidar"),
    ],
)
def test_what_makes_no_sense_is_refused(as_user, make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
