"""Groups and pairs of scans: who may be in one, and how often."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.deeppointmap import CurriculumStage, SamplingConfig, TrainingConfig, training_preset
from dpmjax.deeppointmap.training.curriculum import PAIR_PROBABILITY, stage_layouts
from dpmjax.deeppointmap.training.sampling import Group, PlacedScans, ScanTable, arrange_groups, draw_groups


def table(num: int = 60, step_m: float = 2.0) -> ScanTable:
    """Two drives in two worlds that happen to have the same coordinates."""
    poses = np.tile(np.eye(4), (2 * num, 1, 1))
    poses[:, 0, 3] = step_m * np.tile(np.arange(num), 2)
    return ScanTable(poses, np.repeat([0, 1], num))


def placed(T_world_scan: np.ndarray) -> PlacedScans:
    """Scans of four descriptors each, 1 m apart on a line across the way."""
    positions = np.stack([np.zeros(4), np.arange(4.0), np.zeros(4)], axis=1)
    positions_world = positions @ T_world_scan[:, :3, :3].swapaxes(1, 2) + T_world_scan[:, None, :3, 3]
    return PlacedScans(T_world_scan, positions_world, np.ones((len(T_world_scan), 4), bool))


@pytest.mark.parametrize(("num_scans", "max_num"), [(32, 4), (96, 1), (512, 1)])
@pytest.mark.parametrize("max_group", [2, 4, 8, 16, 32])
def test_layouts_hold_the_sizes_of_the_published_draw_and_leave_no_room(
    max_group: int, num_scans: int, max_num: int
) -> None:
    config = SamplingConfig(num_scans)
    layouts = stage_layouts(max_group, config)
    assert 1 <= len(layouts) <= max_num
    shapes = [shape for layout in layouts for shape in layout]
    assert all(config.num_scans - 2 <= sum(map(sum, layout)) <= config.num_scans for layout in layouts)
    assert all(1 <= a <= b <= config.max_side and a + b <= max_group for a, b in shapes)
    sizes = np.array([sum(shape) for shape in shapes])
    # Of the mean size of the published draw, within what fits into so few samples.
    mean = 2 * PAIR_PROBABILITY + (1 - PAIR_PROBABILITY) * (2 + max_group) / 2
    assert 0.7 < sizes.mean() / mean < 1.4
    assert max_group == 2 or sizes.max() > max_group / 2


@pytest.mark.parametrize("max_group", [2, 8])
def test_groups_hold_scans_of_one_place(max_group: int) -> None:
    scans, config = table(), SamplingConfig()
    layout = stage_layouts(max_group, config)[0]
    for seed in range(20):
        groups = draw_groups(scans, 5, layout, config, np.random.default_rng(seed))
        assert any(5 in group.rows for group in groups)
        for group, shape in zip(groups, layout, strict=True):
            assert (len(group.source), len(group.target)) == shape
            assert len(set(group.rows)) == len(group.rows)
            assert len(set(scans.scene[group.rows])) == 1
            assert np.ptp(scans.positions[group.rows, 0]) <= 2 * config.max_distance_m


def test_groups_are_smaller_where_scans_are_rare() -> None:
    (group,) = draw_groups(table(step_m=15.0), 4, ((3, 5),), SamplingConfig(), np.random.default_rng(0))
    assert 4 in group.rows
    assert len(group.rows) <= 3
    assert len(group.target) >= 1
    (batch,) = arrange_groups([group], ((3, 5),), placed(table(step_m=15.0).T_world_lidar[group.rows]))
    assert batch.source.rows.shape == (1, 3)
    assert batch.target.mask.any(-1).sum() + batch.source.mask.any(-1).sum() == len(group.rows)


def test_groups_of_one_shape_stand_together_with_their_true_motions() -> None:
    layout, scans = ((1, 1), (1, 2), (1, 1)), table()
    groups = [Group(np.array([3]), np.array([5])), None, Group(np.array([8]), np.array([4]))]
    rows = np.concatenate([group.rows for group in groups if group is not None])
    pairs, others = arrange_groups(groups, layout, placed(scans.T_world_lidar[rows]))
    np.testing.assert_array_equal(pairs.mask, [True, True])
    np.testing.assert_array_equal(others.mask, [False])
    np.testing.assert_array_equal(rows[pairs.source.rows[:, 0]], [3, 8])
    np.testing.assert_array_equal(pairs.T_target_source[:, 0, 3], [-4, 8])


def test_the_scan_nearest_to_the_other_map_stands_first() -> None:
    scans = table()
    for seed in range(10):
        (group,) = draw_groups(scans, 20, ((2, 6),), SamplingConfig(), np.random.default_rng(seed))
        x = scans.positions[:, 0]
        assert np.all(np.diff(np.abs(x[group.source] - x[group.target[0]])) >= 0)
        assert np.ptp(x[group.rows]) > np.abs(x[group.source[0]] - x[group.target[0]])


def test_a_map_describes_no_place_twice() -> None:
    """As the map that a scan is matched against in use: a copy of a place of a nearer scan is left out."""
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 0, 3] = [0.0, 0.1, 0.2, 5.0]
    (batch,) = arrange_groups([Group(np.array([0]), np.array([1, 2, 3]))], ((1, 3),), placed(T))
    np.testing.assert_array_equal(batch.target.mask[0].sum(1), [4, 0, 4])
    np.testing.assert_array_equal(batch.source.mask[0].sum(1), [4])


def test_a_lonely_scan_has_no_group() -> None:
    with pytest.raises(ValueError, match="none in"):
        draw_groups(table(step_m=100.0), 0, ((1, 1),), SamplingConfig(), np.random.default_rng(0))


def test_draws_depend_on_the_generator_alone() -> None:
    layout = ((1, 1), (2, 4))
    first, second = (draw_groups(table(), 3, layout, SamplingConfig(), np.random.default_rng(4)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.rows, b.rows)


def test_stages_follow_each_other() -> None:
    config = TrainingConfig(curriculum=(CurriculumStage(2, 3), CurriculumStage(4, 2)))
    assert [config.stage_at(step).max_group for step in range(7)] == [2, 2, 2, 4, 4, 4, 4]
    assert config.with_steps(60).num_steps == 60
    assert config.with_steps(1).num_steps == 2


@pytest.mark.parametrize("name", ["tiny", "small", "paper"])
def test_presets_double_the_groups(name) -> None:
    stages = training_preset(name).curriculum
    assert [stage.max_group for stage in stages] == [2 ** (i + 1) for i in range(len(stages))]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CurriculumStage(1, 3), "max_group"),
        (lambda: SamplingConfig(max_distance_m=0.2), "max_distance_m"),
        (lambda: TrainingConfig(sampling=SamplingConfig(num_scans=16)), "num_scans"),
        (lambda: TrainingConfig(sampling=SamplingConfig(max_side=8)), "max_side"),
        (lambda: TrainingConfig(learning_rate=0.0), "learning_rate"),
        (lambda: ScanTable(np.zeros((3, 4, 4)), np.zeros(2, int)), "T_world_lidar"),
    ],
)
def test_what_makes_no_sense_is_refused(as_user, make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_layouts_of_a_stage_take_turns() -> None:
    config = TrainingConfig(curriculum=(CurriculumStage(2, 3), CurriculumStage(8, 9)))
    layouts = stage_layouts(8, config.sampling)
    assert len(layouts) > 1
    assert [config.layout_at(step) for step in range(3, 12)] == [layouts[step % len(layouts)] for step in range(3, 12)]
    assert config.layout_at(0) == stage_layouts(2, config.sampling)[0]
