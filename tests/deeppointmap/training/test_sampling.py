"""Groups and pairs of scans: who may be in one, and how often."""

from dataclasses import replace

import numpy as np
import pytest

from dpmjax import deeppointmap as dpm
from dpmjax.deeppointmap.training.curriculum import Layout, layout_capacity
from dpmjax.deeppointmap.training.sampling import Group, PlacedScans, ScanTable, arrange_groups, draw_groups
from dpmjax.scan import VerificationConfig


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


def drawn_layouts(config: dpm.TrainingConfig, max_group: int, num: int = 4_000) -> list[Layout]:
    stage = replace(config, curriculum=(dpm.CurriculumStage(max_group, num),))
    return [stage.layout_at(step, seed=7) for step in range(num)]


@pytest.mark.parametrize(
    ("preset", "max_group"), [*(("small", size) for size in (2, 4, 16)), *(("paper", size) for size in (2, 8, 32))]
)
def test_the_share_of_scan_pairs_and_the_mean_size_are_those_of_the_published_draw(preset: str, max_group: int) -> None:
    """Published: a pair with the probability 0.34, else a size from 2 to K. All groups of a step have one size."""
    layouts = drawn_layouts(dpm.training_preset(preset), max_group)
    is_pair = [(layout.num_source, layout.num_target) == (1, 1) for layout in layouts]
    assert abs(np.mean(is_pair) - (0.34 + 0.66 / (max_group - 1))) < 0.03
    sizes = np.array([layout.num_source + layout.num_target for layout in layouts])
    expected = 0.34 * 2 + 0.66 * (2 + max_group) / 2
    assert abs(sizes.mean() - expected) <= 4 * sizes.std() / np.sqrt(len(sizes))
    assert max_group == 2 or sizes.max() == max_group


@pytest.mark.parametrize("max_group", [8, 32])
def test_half_of_the_groups_that_fit_in_one_map_are_split_into_a_scan_and_a_map(max_group: int) -> None:
    config = dpm.training_preset("paper")
    layouts = [layout for layout in drawn_layouts(config, max_group) if 3 < sum(layout[:2]) <= config.sampling.max_side]
    # Half against all others; else uniform, of whose splits the first and the last are such groups, too.
    expected = np.mean([0.5 + 0.5 * 2 / (sum(layout[:2]) - 1) for layout in layouts])
    found = np.mean([layout.num_source == 1 for layout in layouts])
    assert abs(found - expected) < 4 * np.sqrt(0.25 / len(layouts))


@pytest.mark.parametrize("num_scans", [16, 32, 96])
@pytest.mark.parametrize("max_group", [2, 4, 16])
def test_a_step_is_full_and_its_capacity_holds_it(max_group: int, num_scans: int) -> None:
    config = replace(dpm.training_preset("small"), sampling=dpm.SamplingConfig(num_scans))
    capacities = set()
    for layout in drawn_layouts(config, max_group, 300):
        source, target, num_groups, total = layout
        assert 1 <= source <= target <= config.sampling.max_side
        assert 2 <= source + target <= max_group
        assert num_groups == num_scans // (source + target)
        assert total == num_groups * (source + target)
        capacity = layout_capacity(layout, config.sampling)
        assert all(size <= room for size, room in zip(layout, capacity, strict=True))
        assert capacity.num_source < 2 * source
        assert capacity.num_target < 2 * target
        assert capacity.num_scans <= num_scans
        capacities.add(capacity)
    # Each compiles one step: those of two maps with up to 1, 2, 4, 8 or 16 scans.
    assert len(capacities) <= {2: 1, 4: 4, 16: 14}[max_group]


@pytest.mark.parametrize("layout", [Layout(1, 1, 16, 32), Layout(3, 5, 4, 32)])
def test_groups_hold_scans_of_one_place(layout: Layout) -> None:
    scans, config = table(), dpm.SamplingConfig()
    for seed in range(20):
        groups = draw_groups(scans, 5, layout, config, np.random.default_rng(seed))
        assert len(groups) == layout.num_groups
        assert any(5 in group.rows for group in groups)
        for group in groups:
            assert (len(group.source), len(group.target)) == layout[:2]
            assert len(set(group.rows)) == len(group.rows)
            assert len(set(scans.scene[group.rows])) == 1
            assert np.ptp(scans.positions[group.rows, 0]) <= 2 * config.max_distance_m


def test_groups_are_smaller_where_scans_are_rare() -> None:
    layout = Layout(3, 5, 1, 8)
    (group,) = draw_groups(table(step_m=15.0), 4, layout, dpm.SamplingConfig(), np.random.default_rng(0))
    assert 4 in group.rows
    assert len(group.rows) <= 3
    assert len(group.target) >= 1
    batch = arrange_groups([group], layout, placed(table(step_m=15.0).T_world_lidar[group.rows]))
    assert batch.source.rows.shape == (1, 3)
    assert batch.target.mask.any(-1).sum() + batch.source.mask.any(-1).sum() == len(group.rows)


def test_groups_keep_their_true_motions_and_missing_ones_are_masked() -> None:
    scans = table()
    groups = [Group(np.array([3]), np.array([5])), Group(np.array([8]), np.array([4]))]
    rows = np.concatenate([group.rows for group in groups])
    batch = arrange_groups(groups, Layout(1, 2, 4, 12), placed(scans.T_world_lidar[rows]))
    np.testing.assert_array_equal(batch.mask, [True, True, False, False])
    np.testing.assert_array_equal(rows[batch.source.rows[:, 0][batch.mask]], [3, 8])
    np.testing.assert_array_equal(batch.T_target_source[:, 0, 3], [-4, 8, 0, 0])
    np.testing.assert_array_equal(batch.target.mask.any(-1), [[True, False]] * 2 + [[False, False]] * 2)


def test_the_scan_nearest_to_the_other_map_stands_first() -> None:
    scans = table()
    for seed in range(10):
        (group,) = draw_groups(scans, 20, Layout(2, 6, 1, 8), dpm.SamplingConfig(), np.random.default_rng(seed))
        x = scans.positions[:, 0]
        assert np.all(np.diff(np.abs(x[group.source] - x[group.target[0]])) >= 0)
        assert np.ptp(x[group.rows]) > np.abs(x[group.source[0]] - x[group.target[0]])


@pytest.mark.parametrize(("thins", "expected"), [(True, [4, 0, 4, 0]), (False, [4, 4, 4, 0])], ids=["default", "paper"])
def test_a_map_describes_no_place_twice_but_for_the_paper(thins: bool, expected: list[int]) -> None:
    """As the map that a scan is matched against in use: a copy of a place of a nearer scan is left out."""
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 0, 3] = [0.0, 0.1, 0.2, 5.0]
    batch = arrange_groups([Group(np.array([0]), np.array([1, 2, 3]))], Layout(1, 4, 1, 4), placed(T), thins=thins)
    np.testing.assert_array_equal(batch.target.mask[0].sum(1), expected)
    np.testing.assert_array_equal(batch.source.mask[0].sum(1), [4])


def test_a_lonely_scan_has_no_group() -> None:
    with pytest.raises(ValueError, match="none in"):
        draw_groups(table(step_m=100.0), 0, Layout(1, 1, 16, 32), dpm.SamplingConfig(), np.random.default_rng(0))


def test_stages_follow_each_other() -> None:
    config = dpm.TrainingConfig(curriculum=(dpm.CurriculumStage(2, 3), dpm.CurriculumStage(4, 2)))
    assert [config.stage_at(step).max_group for step in range(7)] == [2, 2, 2, 4, 4, 4, 4]
    assert config.with_steps(60).num_steps == 60
    assert config.with_steps(1).num_steps == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dpm.CurriculumStage(1, 3), "max_group"),
        (lambda: dpm.SamplingConfig(max_distance_m=0.2), "max_distance_m"),
        (lambda: dpm.TrainingConfig(sampling=dpm.SamplingConfig(num_scans=16)), "num_scans"),
        (lambda: dpm.TrainingConfig(sampling=dpm.SamplingConfig(max_side=8)), "max_side"),
        (lambda: dpm.TrainingConfig(learning_rate=0.0), "learning_rate"),
        (lambda: dpm.TrainingConfig(max_gradient_norm=0.0), "max_gradient_norm"),
        (lambda: dpm.TrainingConfig(num_epochs=0.0), "num_epochs"),
        (lambda: dpm.TrainingConfig(initialization="zero"), "initialization"),
        (lambda: ScanTable(np.zeros((3, 4, 4)), np.zeros(2, int)), "T_world_lidar"),
        (lambda: dpm.ObjectiveConfig(offset_weight=-1), "offset_weight"),
        (lambda: dpm.OverlapConfig(num_epochs=0), "num_epochs"),
        (lambda: dpm.OverlapConfig(rate_share=0.0), "rate_share"),
        (lambda: dpm.MatchConfig(pair_ratio=5.0), "pair_ratio"),
        (lambda: VerificationConfig(num_samples=0), "num_samples"),
    ],
)
def test_what_makes_no_sense_is_refused(as_user, make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_the_layout_of_a_step_depends_on_the_seed_and_its_stage_alone() -> None:
    config = dpm.TrainingConfig(curriculum=(dpm.CurriculumStage(2, 3), dpm.CurriculumStage(8, 40)))
    first, again, other = ([config.layout_at(step, seed=seed) for step in range(43)] for seed in (0, 0, 1))
    assert first == again != other
    assert first[:3] == [Layout(1, 1, 16, 32)] * 3


def test_an_epoch_is_every_scan_once_as_anchor_by_all_devices_together() -> None:
    paper = dpm.training_preset("paper")
    assert paper.num_epochs == 12
    steps = paper.for_scans(14_169)
    assert abs(steps.num_steps - 12 * 14_169) <= 5
    # K doubles at epochs 2, 4, 7 and 10.
    ends = np.cumsum([stage.num_steps for stage in steps.curriculum])
    np.testing.assert_allclose(ends / 14_169, [2, 4, 7, 10, 12], atol=1e-3)
    assert abs(paper.for_scans(14_169, num_samples=6).num_steps - 2 * 14_169) <= 5
    assert steps.num_epochs is None
    assert steps.for_scans(7) is steps
    assert paper.with_steps(60).for_scans(1000).num_steps == 60


def test_the_paper_preset_is_as_published() -> None:
    """The points of section 3.3 and of the published configuration that presets may differ in."""
    paper = dpm.training_preset("paper")
    assert (paper.learning_rate, paper.final_learning_rate, paper.warmup_steps) == (1e-3, 1e-5, 0)
    assert [stage.max_group for stage in paper.curriculum] == [2, 4, 8, 16, 32]
    assert (paper.num_variants, paper.thins_as_in_use, paper.thins_maps) == (0, False, False)
    assert paper.max_gradient_norm == np.inf
    assert paper.initialization == "uniform"
    assert not paper.refines_labels
    assert (paper.objective.coarse_weight, paper.objective.positive_radius_m) == (0.1, 1.0)
