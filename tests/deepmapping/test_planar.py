"""Laws of DeepMapping on planar scans."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.deepmapping.config import REFINE
from dpmjax.deepmapping.engine import fit, init
from dpmjax.deepmapping.mapping import mapping_problem
from dpmjax.deepmapping.objective import blocks_of_step
from dpmjax.deepmapping.problem import MappingData
from dpmjax.deepmapping.sensors import as_scan_set
from dpmjax.deepmapping.toy import ToyConfig
from dpmjax.geometry import se2
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.types import ScanSet
from tests.tolerances import ACCUMULATED, ROUNDING

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
    # Its phase with all samplings, and its networks with fewer channels; a rate that shows in few steps.
    small = replace(
        config,
        cold_phases=(replace(phase, num_epochs=60),),
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


@pytest.mark.parametrize("num_scans", [8, 9, 11])
def test_an_epoch_has_every_scan_once_in_the_order_of_time(num_scans: int) -> None:
    phase = replace(dm.preset("paper").cold_phases[0], scans_per_step=4)
    num_steps = -(-num_scans // 4)
    for epoch in range(2):
        steps = jnp.arange(epoch * num_steps, (epoch + 1) * num_steps, dtype=jnp.int32)
        batches = [blocks_of_step(phase, num_scans, step, key=KEY) for step in steps]
        rows = np.concatenate([np.asarray(batch.rows[batch.is_scan]) for batch in batches])
        assert rows.tolist() == list(range(num_scans))


@pytest.mark.parametrize(("num_scans", "num_steps"), [(32, 3000), (128, 3000), (256, 6000), (300, 9000)])
def test_steps_of_the_paper_preset_are_3000_epochs(num_scans: int, num_steps: int) -> None:
    no_scans = ScanSet(jnp.zeros((num_scans, 4, 2)), jnp.ones((num_scans, 4), bool))
    for start in (None, jnp.zeros((num_scans, 3))):
        (phase,) = mapping_problem(dm.preset("paper"), MappingData(no_scans, start)).phases
        assert (phase.num_steps, phase.num_epochs) == (num_steps, 0)


def test_paper_preset_has_the_published_numbers() -> None:
    config = dm.preset("paper")
    assert config.cold_phases == config.warm_phases
    (phase,) = config.cold_phases
    gamma = phase.occupancy_weight
    np.testing.assert_allclose((1.0 - gamma) / gamma, 10.0)  # lambda of eq. 6
    assert (phase.num_free, phase.scans_per_step, phase.num_offsets, phase.max_offset) == (19, 128, 3, 3)
    assert (phase.learning_rate, phase.final_learning_rate, phase.adam_decay) == (1e-3, 1.0, (0.9, 0.999))
    assert (config.localization.dilation, config.unit) == (2, 512.0)
    (phase,) = dm.preset("paper", "depth").cold_phases
    np.testing.assert_allclose((1.0 - phase.occupancy_weight) / phase.occupancy_weight, 0.1)
    assert (phase.num_free, phase.scans_per_step, phase.num_epochs) == (35, 8, 3000)


@pytest.mark.slow
def test_loss_of_a_short_last_batch_is_that_of_its_scans_alone(tiny_data) -> None:
    config = dm.preset("paper")
    phase = replace(config.cold_phases[0], scans_per_step=8)
    config = replace(
        config,
        cold_phases=(phase,),
        localization=replace(config.localization, features=(8, 16, 16), hidden=(8,)),
        occupancy=replace(config.occupancy, features=(8, 8)),
    )
    scans = tiny_data.scans
    params = init(mapping_problem(config, tiny_data), tiny_data, key=KEY).params

    def loss(rows: slice, step: int) -> tuple[float, dm.problem.Params]:
        data = MappingData(ScanSet(scans.points[rows], scans.mask[rows]))
        problem = mapping_problem(config, data)
        own = replace(params, start=params.start[rows])
        value = jax.value_and_grad(lambda p: problem.loss(config, problem.phases[0], p, data, jnp.int32(step), KEY)[0])
        return jax.jit(value)(own)

    # Batches of 20 scans: 0 to 7, 8 to 15, 16 to 19.
    for rows, step in ((slice(8, 16), 1), (slice(16, 20), 2)):
        (one, grad), (other, grad_other) = loss(slice(0, 20), step), loss(rows, 0)
        np.testing.assert_allclose(one, other, **ACCUMULATED)
        for net in ("localization", "occupancy"):
            pairs = zip(*(jax.tree.leaves(getattr(g, net)) for g in (grad, grad_other)), strict=True)
            assert all(np.allclose(a, b, rtol=1e-3, atol=1e-5) for a, b in pairs)


def test_a_given_unit_scales_scans_and_poses(tiny_walk) -> None:
    scans, start = ScanSet(tiny_walk.points, tiny_walk.mask), tiny_walk.reference_poses
    data, unit = dm.mapping_data(scans, start, unit=512.0)
    assert unit == 512.0
    np.testing.assert_allclose(data.scans.points, tiny_walk.points / 512.0, **ROUNDING)
    np.testing.assert_allclose(data.start, start / [512.0, 512.0, 1.0], **ROUNDING)


# Losses of the preset `fast` at its initial parameters, by phase, from zero poses or from given ones.
FAST_LOSSES = {("L-Net", True): 0.1435001, ("free poses", True): 0.7525633, ("free poses", False): 0.7428900}


@pytest.mark.slow
def test_losses_of_the_fast_preset_do_not_change(tiny_walk, shaken) -> None:
    for (name, is_cold), expected in FAST_LOSSES.items():
        data, _ = dm.mapping_data(ScanSet(tiny_walk.points, tiny_walk.mask), None if is_cold else shaken)
        problem = mapping_problem(dm.preset("fast"), data)
        phase = next(phase for phase in problem.phases if phase.name == name)
        params = init(problem, data, key=KEY).params
        loss, _ = problem.loss(problem.config, phase, params, data, jnp.int32(0), KEY)
        np.testing.assert_allclose(loss, expected, rtol=1e-4)


@pytest.mark.parametrize("length", [None, 8])
def test_direct_optimisation_starts_at_the_output_of_the_untrained_networks(tiny_data, length: int | None) -> None:
    phases = tuple(replace(phase, scans_per_window=length) for phase in SMALL.cold_phases)
    config = replace(SMALL, cold_phases=phases)
    poses = []
    for settings in (config, dm.as_direct(config)):
        problem = mapping_problem(settings, tiny_data)
        state = init(problem, tiny_data, key=KEY)
        poses.append(problem.poses(settings, problem.phases[0], state.params, tiny_data))
    np.testing.assert_allclose(*poses, **ACCUMULATED)
    assert float(jnp.abs(poses[1]).max()) > 1e-3


@pytest.mark.parametrize(
    ("num_scans", "scans_per_step", "shape"),
    [(1000, None, (8, 32)), (200, 16, (1, 16)), (200, 40, (1, 32)), (200, 100, (3, 32))],
)
def test_scans_are_drawn_in_blocks_of_neighbours(num_scans: int, scans_per_step: int | None, shape) -> None:
    phase = dm.preset("fast").warm_phases[0]
    phase = phase if scans_per_step is None else replace(phase, scans_per_step=scans_per_step)
    rows, is_scan = map(np.asarray, blocks_of_step(phase, num_scans, jnp.int32(0), key=KEY))
    assert rows.shape == shape
    assert is_scan.all()
    assert (np.diff(rows, axis=1) == 1).all()
    assert 0 <= rows.min() <= rows.max() < num_scans


def test_masked_beams_never_matter_and_those_that_are_zero_or_not_finite_are_masked(tiny_data) -> None:
    scans = tiny_data.scans
    mask = scans.mask & (jax.random.uniform(KEY, scans.mask.shape) < 0.8)
    filled = (jnp.where(mask[..., None], scans.points, filling) for filling in (0.0, 1e6, np.nan))
    one, *others = (as_scan_set(ScanSet(points, mask)) for points in filled)
    points = np.where(mask[..., None], scans.points, 0.0)
    points[::2] = np.where(mask[::2, :, None], points[::2], np.nan)
    for other in (*others, as_scan_set(points)):
        jax.tree.map(np.testing.assert_array_equal, one, other)


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
        (np.ones((2, 5, 2)), {"start": np.full((2, 3), 5.4e7)}, "start: the positions are too far from the origin"),
        (np.ones((2, 5, 2)), {"config": dm.preset("paper")}, "unit: expected a length like the ranges of the scans"),
    ],
)
def test_bad_input_is_named(as_user, scans, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.fit_deepmapping(scans, **{"config": SMALL, "key": KEY, **options})


PHASES = dm.preset("fast").cold_phases
WINDOWS = PHASES[0], replace(PHASES[0], scans_per_window=None)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dm.preset("quick"), "preset: expected one of fast, paper"),
        (lambda: dm.with_steps(dm.preset("fast"), 1), "steps: expected at least one"),
        (lambda: replace(dm.preset("paper").cold_phases[0], num_steps=5), "num_epochs"),
        (lambda: replace(dm.preset("fast"), cold_phases=WINDOWS), "scans_per_window"),
        (lambda: replace(PHASES[0], scans_per_window=1), "scans_per_window"),
        (lambda: replace(REFINE, occupancy_weight=1.5), "occupancy_weight"),
        (lambda: replace(REFINE, num_offsets=9), "num_offsets"),
        (lambda: replace(REFINE, num_steps=0), "num_steps"),
        (lambda: ToyConfig(learning_rate=0.0), "learning_rate"),
        (lambda: ToyConfig(num_steps=0), "num_steps"),
        (lambda: ToyConfig(initialization="zeros"), "initialization"),
    ],
)
def test_senseless_settings_are_refused(as_user, make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_scans_without_an_order_get_a_pointnet() -> None:
    assert dm.preset("fast", is_organised=False).localization.kind == "point"
