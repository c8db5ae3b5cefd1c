from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.checkpoints import Checkpoints
from dpmjax.deepmapping.fit import _draw_batch, run_phases
from dpmjax.deepmapping.stepping import steps_per_call
from dpmjax.geometry import se2
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.localization import LocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig
from dpmjax.types import ScanSet

KEY = jax.random.key(3)
# The fast preset in small: fewer levels, beams and steps.
SMALL = dm.with_steps(
    replace(
        dm.preset("fast"),
        occupancy=OccupancyConfig(kind="grid", resolutions=(16, 32, 64, 128)),
        localization=LocalizationConfig(features=(16, 32), strides=(1, 2), is_circular=True, hidden=(32,)),
    ),
    150,
)
BRIEF = replace(dm.with_steps(SMALL, 6), steps_per_call=2)


def ate(poses: np.ndarray, reference: np.ndarray) -> float:
    return absolute_trajectory_error(poses[:, :2], reference[:, :2])


def assert_same(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.fixture(scope="module")
def warm(tiny_walk, shaken) -> dm.Fitted:
    return dm.fit_deepmapping(ScanSet(tiny_walk.points, tiny_walk.mask), SMALL, key=KEY, init=shaken)


def test_a_perturbed_start_is_improved(tiny_walk, shaken, warm) -> None:
    assert ate(warm.poses, tiny_walk.reference_poses) < 0.4 * ate(shaken, tiny_walk.reference_poses)
    np.testing.assert_allclose(se2.to_matrix(warm.poses), warm.T_world_scan)
    assert int(warm.state.step) == 150


@pytest.mark.slow
def test_a_cold_start_finds_the_walk_roughly(tiny_walk) -> None:
    cold = dm.fit_deepmapping(ScanSet(tiny_walk.points, tiny_walk.mask), dm.with_steps(SMALL, 300), key=KEY)
    # All poses at one place are off by the spread of the walk.
    spread = ate(np.zeros((20, 3)), tiny_walk.reference_poses)
    assert ate(cold.poses, tiny_walk.reference_poses) < 0.5 * spread


def test_picture_is_dark_at_walls_and_light_in_free_space(tiny_walk, warm) -> None:
    picture = dm.draw_map(
        warm.state, SMALL, tiny_walk.points, tiny_walk.mask, warm.poses, reach=warm.reach, num_cells=200
    )
    world = se2.transform_points(warm.poses, tiny_walk.points)
    sensors = np.broadcast_to(warm.poses[:, None, :2], world.shape)
    x_min, x_max, y_min, y_max = picture.extent
    height, width = picture.probability.shape

    def at(places: np.ndarray) -> np.ndarray:
        column = ((places[:, 0] - x_min) / (x_max - x_min) * width).astype(int)
        row = ((places[:, 1] - y_min) / (y_max - y_min) * height).astype(int)
        assert picture.explored[row, column].mean() > 0.99
        return picture.probability[row, column]

    walls, free = at(world[tiny_walk.mask]), at((0.5 * (world + sensors))[tiny_walk.mask])
    assert np.median(walls) > 0.5
    assert np.median(free) < 0.2
    assert not picture.explored.all()


@pytest.fixture(scope="module")
def brief_steps(tiny_scans) -> dict[str, Callable]:
    """The compiled steps of the brief cold start, one a phase."""
    return {phase.name: dm.make_step(tiny_scans, BRIEF, phase) for phase in BRIEF.cold_phases}


def test_same_key_same_numbers_and_another_key_others(tiny_scans, brief_steps) -> None:
    step = brief_steps[BRIEF.cold_phases[0].name]

    def run(key: jax.Array) -> dm.State:
        return step(dm.init(key, tiny_scans, BRIEF), key=key)[0]

    one = run(KEY)
    assert_same(one, run(KEY))
    assert not np.array_equal(*(jax.tree.leaves(s.params.localization)[-1] for s in (one, run(jax.random.key(4)))))


def test_second_step_compiles_nothing(tiny_scans, brief_steps, assert_compiles_nothing) -> None:
    step = brief_steps[BRIEF.cold_phases[0].name]
    state, _ = step(dm.init(KEY, tiny_scans, BRIEF), key=KEY)
    with assert_compiles_nothing():
        state, report = step(state, key=KEY)
    assert np.isfinite(report.loss)


def test_interrupted_and_restored_equals_unbroken(tiny_scans, brief_steps, tmp_path, monkeypatch) -> None:
    module = importlib.import_module("dpmjax.deepmapping.fit")
    monkeypatch.setattr(module, "make_step", lambda scans, config, phase: brief_steps[phase.name])
    start = dm.init(KEY, tiny_scans, BRIEF)
    states = [state for _, state, _ in run_phases(tiny_scans, BRIEF, start, key=KEY, is_warm=False)]
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    # The first call ends inside the first phase.
    checkpoints.save(2, states[0])
    restored = Checkpoints(tmp_path / "checkpoints").restore_latest(start, fallback=start)
    assert_same(restored, states[0])
    *_, (_, resumed, _) = run_phases(tiny_scans, BRIEF, restored, key=KEY, is_warm=False)
    assert_same(resumed, states[-1])


def test_a_checkpoint_that_was_cut_off_is_passed_over(tmp_path, caplog) -> None:
    checkpoints, fallback = Checkpoints(tmp_path / "checkpoints"), {"x": jnp.zeros(3)}
    assert checkpoints.restore_latest(fallback, fallback=fallback) is fallback
    for step in (1, 2, 3):
        checkpoints.save(step, {"x": jnp.full(3, float(step))})
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir() if path.name.isdigit())
    assert kept == ["2", "3"]
    np.testing.assert_array_equal(checkpoints.restore_latest(fallback, fallback=fallback)["x"], 3.0)
    for path in (tmp_path / "checkpoints" / "3").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    np.testing.assert_array_equal(checkpoints.restore_latest(fallback, fallback=fallback)["x"], 2.0)
    assert "checkpoint 3 cannot be read" in caplog.text


def test_the_paper_preset_steps_on_a_tiny_set(tiny_scans) -> None:
    config = dm.with_steps(dm.preset("paper"), 1)
    (phase,) = config.cold_phases
    assert (phase.num_free, phase.is_free_factor_shared, phase.occupancy_weight, phase.num_offsets) == (
        19,
        True,
        0.1,
        3,
    )
    few = ScanSet(tiny_scans.points[:4, ::4], tiny_scans.mask[:4, ::4])
    state = dm.init(KEY, few, config)
    after, report = dm.make_step(few, config, phase)(state, key=KEY)
    assert float(report.loss) > 0.0
    for name in ("localization", "occupancy"):
        moved = [
            not np.array_equal(a, b)
            for a, b in zip(*(jax.tree.leaves(getattr(s.params, name)) for s in (state, after)), strict=True)
        ]
        assert any(moved)
    np.testing.assert_array_equal(state.params.poses, after.params.poses)


def test_every_scan_is_in_some_batch_of_the_published_order() -> None:
    scans = ScanSet(jnp.zeros((11, 4, 2)), jnp.ones((11, 4), bool))
    phase = replace(dm.preset("paper").cold_phases[0], scans_per_step=4)
    rows = [np.asarray(_draw_batch(scans, phase, jnp.int32(k), key=KEY).rows) for k in range(3)]
    assert set(np.concatenate(rows).tolist()) == set(range(11))
    assert all((np.diff(r) == 1).all() for r in rows)


def test_masked_beams_never_matter(tiny_scans) -> None:
    mask = tiny_scans.mask & (jax.random.uniform(KEY, tiny_scans.mask.shape) < 0.8)
    scans = [
        dm.as_scan_set(ScanSet(jnp.where(mask[..., None], tiny_scans.points, filling), mask))
        for filling in (0.0, 1e6, np.nan)
    ]
    assert_same(scans[0], scans[1])
    assert_same(scans[0], scans[2])
    assert dm.measure_reach(scans[0]) == pytest.approx(1.0, rel=0.1)


def test_beams_that_are_zero_or_not_finite_are_masked() -> None:
    points = np.ones((3, 5, 2))
    points[0, 1], points[1, 2] = 0.0, [np.nan, 1.0]
    scans = dm.as_scan_set(points)
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
        (np.ones((2, 5, 2)), {"init": np.zeros((3, 3))}, "init: expected shape"),
        (np.ones((2, 5, 2)), {"init": np.full((2, 3), np.nan)}, "init: expected finite"),
    ],
)
def test_bad_input_is_named(as_user, scans, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.fit_deepmapping(scans, BRIEF, key=KEY, **options)


def test_unknown_presets_and_too_few_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="preset: expected 'fast' or 'paper'"):
        dm.preset("quick")
    with pytest.raises(ValueError, match="steps: expected at least one"):
        dm.with_steps(dm.preset("fast"), 1)


@pytest.mark.parametrize(("num_steps", "expected"), [(60, 60), (20, 20), (61, 63), (25, 25)])
def test_calls_of_a_step_share_the_steps_of_the_phase(num_steps: int, expected: int) -> None:
    config = dm.with_steps(dm.preset("fast"), num_steps)
    length = steps_per_call(config, config.warm_phases[0])
    assert length * -(-num_steps // length) == expected


def test_scans_without_an_order_get_a_pointnet() -> None:
    assert dm.preset("fast", is_organised=False).localization.kind == "point"
