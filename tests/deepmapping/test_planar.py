"""Laws of DeepMapping on planar scans."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.deepmapping.engine import fit, init
from dpmjax.deepmapping.mapping import mapping_problem
from dpmjax.deepmapping.objective import blocks_of_step
from dpmjax.deepmapping.problem import MappingData
from dpmjax.deepmapping.sensors import as_scan_set
from dpmjax.geometry import se2
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.types import ScanSet

KEY = jax.random.key(3)
# The fast preset in small: fewer levels, beams and steps.
SMALL = dm.with_steps(
    replace(
        dm.preset("fast"),
        occupancy=OccupancyConfig(kind="grid", resolutions=(16, 32, 64, 128)),
        localization=LocalizationNetConfig(features=(16, 32), strides=(1, 2), is_circular=True, hidden=(32,)),
    ),
    150,
)


def ate(poses: np.ndarray, reference: np.ndarray) -> float:
    return absolute_trajectory_error(poses[:, :2], reference[:, :2])


@pytest.fixture(scope="module")
def warm(tiny_walk, shaken) -> dm.Fitted:
    return dm.fit_deepmapping(ScanSet(tiny_walk.points, tiny_walk.mask), SMALL, key=KEY, start=shaken)


def test_a_perturbed_start_is_improved(tiny_walk, shaken, warm) -> None:
    assert ate(warm.poses, tiny_walk.reference_poses) < 0.4 * ate(shaken, tiny_walk.reference_poses)
    np.testing.assert_allclose(se2.to_matrix(warm.poses), warm.T_world_scan)


@pytest.mark.slow
def test_a_cold_start_finds_the_walk_roughly(tiny_walk) -> None:
    cold = dm.fit_deepmapping(ScanSet(tiny_walk.points, tiny_walk.mask), dm.with_steps(SMALL, 300), key=KEY)
    # All poses at one place are off by the spread of the walk.
    spread = ate(np.zeros((20, 3)), tiny_walk.reference_poses)
    assert ate(cold.poses, tiny_walk.reference_poses) < 0.5 * spread


def test_picture_is_dark_at_walls_and_light_in_free_space(tiny_walk, warm) -> None:
    picture = dm.map_picture(warm, tiny_walk.points, tiny_walk.mask, num_cells=200)
    world = se2.transform_points(warm.poses, tiny_walk.points)
    sensors = np.broadcast_to(warm.poses[:, None, :2], world.shape)
    x_min, x_max, y_min, y_max = picture.extent
    height, width = picture.probability.shape

    def at(centres: np.ndarray) -> np.ndarray:
        column = ((centres[:, 0] - x_min) / (x_max - x_min) * width).astype(int)
        row = ((centres[:, 1] - y_min) / (y_max - y_min) * height).astype(int)
        assert picture.explored[row, column].mean() > 0.99
        return picture.probability[row, column]

    walls, free = at(world[tiny_walk.mask]), at((0.5 * (world + sensors))[tiny_walk.mask])
    assert np.median(walls) > 0.5
    assert np.median(free) < 0.2
    assert not picture.explored.all()


@pytest.mark.slow
def test_steps_of_the_paper_preset_lower_its_loss(tiny_data) -> None:
    config = dm.preset("paper")
    (phase,) = config.cold_phases
    assert (phase.num_free, phase.is_sampled_as_published, phase.occupancy_weight, phase.num_offsets) == (
        19,
        True,
        0.1,
        3,
    )
    # Its phase with all samplings, and its networks with fewer channels; a rate that shows in few steps.
    small = replace(
        config,
        cold_phases=(replace(phase, num_steps=60),),
        localization=replace(config.localization, features=(16, 32, 64), hidden=(32,)),
        occupancy=replace(config.occupancy, features=(32, 32)),
        steps_per_call=20,
    )
    scans = tiny_data.scans
    few = MappingData(ScanSet(scans.points[:6, ::2], scans.mask[:6, ::2]))
    losses: list[float] = []
    problem = mapping_problem(small, few)
    before = init(problem, few, key=KEY).params
    after = fit(problem, few, key=KEY, on_report=lambda p: losses.append(p.report.loss)).state.params
    assert losses[2] < losses[1] < losses[0]
    assert losses[2] < 0.8 * losses[0]
    for name, moves in (("localization", True), ("occupancy", True), ("poses", False), ("start", False)):
        pairs = zip(*(jax.tree.leaves(getattr(params, name)) for params in (before, after)), strict=True)
        assert any(not np.array_equal(a, b) for a, b in pairs) == moves, name


def test_every_scan_is_in_some_batch_of_the_published_order() -> None:
    phase = replace(dm.preset("paper").cold_phases[0], scans_per_step=4)
    rows = [np.asarray(blocks_of_step(phase, 11, jnp.int32(k), key=KEY)).reshape(-1) for k in range(3)]
    assert set(np.concatenate(rows).tolist()) == set(range(11))
    assert all((np.diff(r) == 1).all() for r in rows)


def test_large_sets_are_drawn_in_blocks_of_neighbours() -> None:
    rows = np.asarray(blocks_of_step(dm.preset("fast").warm_phases[0], 1000, jnp.int32(0), key=KEY))
    assert rows.shape == (8, 32)
    assert (np.diff(rows, axis=1) == 1).all()
    assert rows.min() >= 0
    assert rows.max() < 1000


@pytest.mark.parametrize(("num_scans", "shape"), [(16, (1, 16)), (40, (1, 32)), (100, (3, 32))])
def test_steps_of_few_scans_have_one_block(num_scans: int, shape: tuple[int, int]) -> None:
    phase = replace(dm.preset("fast").warm_phases[0], scans_per_step=num_scans)
    rows = np.asarray(blocks_of_step(phase, 200, jnp.int32(0), key=KEY))
    assert rows.shape == shape
    assert (np.diff(rows, axis=1) == 1).all()


def test_a_start_far_from_the_origin_is_refused(tiny_walk, as_user) -> None:
    start = tiny_walk.reference_poses + np.array([4.5e6, 5.4e7, 0.0])
    with pytest.raises(ValueError, match="start: the positions are too far from the origin"):
        dm.fit_deepmapping(tiny_walk.points, key=KEY, start=start)


def test_masked_beams_never_matter(tiny_data) -> None:
    scans = tiny_data.scans
    mask = scans.mask & (jax.random.uniform(KEY, scans.mask.shape) < 0.8)
    scans = [
        as_scan_set(ScanSet(jnp.where(mask[..., None], scans.points, filling), mask)) for filling in (0.0, 1e6, np.nan)
    ]
    jax.tree.map(np.testing.assert_array_equal, scans[0], scans[1])
    jax.tree.map(np.testing.assert_array_equal, scans[0], scans[2])


def test_beams_that_are_zero_or_not_finite_are_masked() -> None:
    points = np.ones((3, 5, 2))
    points[0, 1], points[1, 2] = 0.0, [np.nan, 1.0]
    scans = as_scan_set(points)
    assert np.argwhere(~np.asarray(scans.mask)).tolist() == [[0, 1], [1, 2]]
    assert np.isfinite(scans.points).all()


@pytest.mark.parametrize(
    ("scans", "options", "message"),
    [
        (np.ones((4, 5)), {}, "scans: expected shape"),
        (np.ones((4, 5, 3)), {}, "scans: expected shape"),
        (np.ones((1, 5, 2)), {}, "scans: expected at least 2"),
        (np.stack([np.ones((5, 2)), np.zeros((5, 2))]), {}, "scan 1 has no valid beam"),
        (ScanSet(jnp.full((2, 5, 2), jnp.nan), jnp.ones((2, 5), bool)), {}, "scans: expected finite"),
        (np.ones((2, 5, 2)), {"start": np.zeros((3, 3))}, "start: expected shape"),
        (np.ones((2, 5, 2)), {"start": np.full((2, 3), np.nan)}, "start: expected finite"),
    ],
)
def test_bad_input_is_named(as_user, scans, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.fit_deepmapping(scans, SMALL, key=KEY, **options)


def test_unknown_presets_and_too_few_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="preset: expected one of fast, paper"):
        dm.preset("quick")
    with pytest.raises(ValueError, match="steps: expected at least one"):
        dm.with_steps(dm.preset("fast"), 1)


def test_scans_without_an_order_get_a_pointnet() -> None:
    assert dm.preset("fast", is_organised=False).localization.kind == "point"
