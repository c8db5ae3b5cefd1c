"""Laws of the engine, on problems whose answer is known and on the smallest planar fit."""

import itertools
import operator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dpmjax import deepmapping as dm
from dpmjax.checkpoints import Checkpoints
from dpmjax.deepmapping.objective import draw_offsets
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.types import ScanSet
from tests.tolerances import ACCUMULATED, DOUBLE

KEY, OTHER_KEY = jax.random.key(3), jax.random.key(4)


@dataclass(frozen=True)
class Valley:
    """Settings of a problem with two minima: gradient descent on (x^2 - 1)^2 + x / 4 + data."""

    name: str = "valley"
    num_steps: int = 60


def height(x):
    return (x**2 - 1.0) ** 2 + 0.25 * x


VALLEY = dm.Problem(
    Valley(),
    (Valley(), Valley(name="again", num_steps=20)),
    init=lambda config, key, data: 2.0 * jax.random.normal(key),
    optimizer=lambda config, phase: optax.sgd(0.02),
    loss=lambda config, phase, params, data, step, key: (height(params) + data, (params,)),
    poses=lambda config, phase, params, data: params,
    next_phase=lambda config, phase, params, data: params,
    steps_per_call=5,
)


def descend(x: float, num_steps: int) -> float:
    """The oracle: plain gradient descent in float64."""
    for _ in range(num_steps):
        x -= 0.02 * (4.0 * x * (x**2 - 1.0) + 0.25)
    return x


def test_a_fit_is_plain_gradient_descent_through_all_phases() -> None:
    problem = replace(VALLEY, init=lambda config, key, data: jnp.asarray(0.9))
    done = dm.fit(problem, jnp.zeros(()), key=KEY)
    assert float(done.poses) == pytest.approx(descend(0.9, 80), abs=1e-4)
    assert (int(done.state.step), int(done.state.phase), int(done.state.phase_step)) == (80, 1, 20)
    np.testing.assert_allclose(done.report.terms[0], [descend(0.9, 75 + k) for k in range(5)], **ACCUMULATED)


def test_each_of_several_starts_is_a_fit_of_its_own() -> None:
    keys = jax.random.split(KEY, 3)
    state, report = jax.vmap(lambda key: dm.solve(VALLEY, jnp.zeros(()), key=key))(keys)
    alone = [dm.fit(VALLEY, jnp.zeros(()), key=key) for key in keys]
    np.testing.assert_allclose(report.poses, [one.poses for one in alone], **ACCUMULATED)
    assert state.step.tolist() == [80, 80, 80]


def test_steps_solve_and_a_fit_without_jit_are_the_fit() -> None:
    problem, data = VALLEY, jnp.zeros(())
    done = dm.fit(problem, data, key=KEY)
    state = dm.init(problem, data, key=KEY)
    while not dm.is_finished(problem, state):
        state, report = dm.step(problem, state, data)
    jax.tree.map(np.testing.assert_array_equal, state, done.state)
    assert report.loss == pytest.approx(float(np.mean(done.report.losses)))
    solved = dm.solve(problem, data, key=KEY)
    with jax.disable_jit():
        without_jit = dm.fit(problem, data, key=KEY)
    for state, report in (solved, (without_jit.state, without_jit.report)):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **ACCUMULATED), state, done.state)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **ACCUMULATED), report, done.report)


def test_an_older_key_is_the_same_key_and_bad_input_is_named() -> None:
    problem, data = VALLEY, jnp.zeros(())
    older = dm.fit(problem, data, key=jax.random.PRNGKey(3))
    np.testing.assert_array_equal(older.poses, dm.fit(problem, data, key=KEY).poses)
    with pytest.raises(ValueError, match=r"^key: expected a key such as jax.random.key\(0\), got int"):
        dm.fit(problem, data, key=3)
    with pytest.raises(ValueError, match="phase: expected the index"):
        jax.jit(lambda state: dm.step(problem, state, data))(dm.init(problem, data, key=KEY))


def test_stop_ends_the_fit_and_a_state_goes_on_to_the_same_numbers() -> None:
    problem, calls = VALLEY, []
    unbroken = dm.fit(problem, jnp.zeros(()), key=KEY)
    stopped = dm.fit(problem, jnp.zeros(()), key=KEY, on_report=calls.append, stop=lambda: len(calls) == 12)
    # The first phase has 12 calls: the stop falls on the border of the phases.
    assert int(stopped.state.step) == 60
    assert not dm.is_finished(problem, stopped.state)
    resumed = dm.resume(problem, stopped.state, jnp.zeros(()))
    jax.tree.map(np.testing.assert_array_equal, resumed.state, unbroken.state)
    assert dm.resume(problem, unbroken.state, jnp.zeros(())).report is None


def test_a_second_fit_traces_nothing() -> None:
    num_traced = 0

    def counted(*arguments):
        nonlocal num_traced
        num_traced += 1
        return VALLEY.loss(*arguments)

    problem = replace(VALLEY, loss=counted)
    dm.fit(problem, jnp.zeros(()), key=KEY)
    first = num_traced
    assert first > 0
    dm.fit(problem, jnp.ones(()), key=jax.random.key(8))
    assert num_traced == first


def test_the_steps_of_a_phase_run_under_jit_and_vmap() -> None:
    problem, data = VALLEY, jnp.linspace(0.0, 1.0, 3)
    keys = jax.random.split(KEY, 3)
    states = jax.vmap(lambda x, key: dm.init(problem, x, key=key))(data, keys)
    enter = jax.jit(jax.vmap(lambda state, x: dm.begin_phase(problem, state, x, phase=1)))
    take = jax.jit(jax.vmap(lambda state, x: dm.step(problem, state, x, phase=1)))
    together, reports = take(enter(states, data), data)
    for row in range(3):
        state = dm.begin_phase(problem, dm.init(problem, data[row], key=keys[row]), data[row], phase=1)
        state, report = dm.step(problem, state, data[row])
        expected = state.params, report.losses, state.phase, state.phase_step
        actual = (together.params, reports.losses, together.phase, together.phase_step)
        of_row = jax.tree.map(operator.itemgetter(row), actual)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **ACCUMULATED), of_row, expected)


def test_progress_tells_shares_phases_and_seconds() -> None:
    seen: list[dm.Progress] = []
    dm.fit(VALLEY, jnp.zeros(()), key=KEY, on_report=seen.append)
    np.testing.assert_allclose([p.share for p in seen], np.arange(5, 81, 5) / 80, **DOUBLE)
    assert [p.phase.name for p in seen] == ["valley"] * 12 + ["again"] * 4
    assert all(later.run_s > earlier.run_s > 0.0 for earlier, later in itertools.pairwise(seen))


NO_SCANS = ScanSet(jnp.zeros((2, 4, 2)), jnp.zeros((2, 4), bool))


@pytest.mark.parametrize(("num_steps", "expected"), [(60, 60), (20, 20), (61, 63), (25, 25)])
def test_calls_of_a_step_share_the_steps_of_the_phase(num_steps: int, expected: int) -> None:
    problem = dm.mapping_problem(dm.with_steps(dm.preset("fast"), num_steps), dm.MappingData(NO_SCANS, np.zeros(3)))
    length = dm.steps_per_call(problem, problem.phases[0])
    assert length * -(-num_steps // length) == expected


# The fast preset in small: few levels, channels and steps; two phases.
BRIEF = replace(
    dm.with_steps(
        replace(
            dm.preset("fast"),
            occupancy=OccupancyConfig(kind="grid", resolutions=(8, 16)),
            localization=LocalizationNetConfig(features=(8, 16), strides=(1, 2), is_circular=True, hidden=(16,)),
        ),
        6,
    ),
    steps_per_call=2,
)
COLD = dm.mapping_problem(BRIEF, dm.MappingData(NO_SCANS))


@pytest.mark.slow
def test_other_data_of_the_same_shape_compile_nothing_in_any_phase(tiny_data, assert_compiles_nothing) -> None:
    first = dm.fit(COLD, tiny_data, key=KEY)
    # Another random key and other scans; the problem is made anew from equal settings.
    other = dm.MappingData(replace(tiny_data.scans, points=0.9 * tiny_data.scans.points))
    with assert_compiles_nothing():
        second = dm.fit(dm.mapping_problem(replace(BRIEF), other), other, key=OTHER_KEY)
    assert int(first.state.phase) == int(second.state.phase) == len(COLD.phases) - 1
    assert not np.array_equal(first.poses, second.poses)


@pytest.mark.slow
def test_planar_fits_under_vmap_are_the_single_fits(tiny_data) -> None:
    sets = [tiny_data, dm.MappingData(replace(tiny_data.scans, points=0.9 * tiny_data.scans.points))]
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sets)
    keys = jax.random.split(KEY, 2)
    state, report = jax.vmap(lambda data, key: dm.solve(COLD, data, key=key))(both, keys)
    for row in range(2):
        alone = dm.fit(COLD, sets[row], key=keys[row])
        # Adam turns rounding into a shift of the whole map, which the losses leave open.
        shape, shape_alone = (poses - poses.mean(axis=0) for poses in map(np.asarray, (report.poses[row], alone.poses)))
        np.testing.assert_allclose(shape, shape_alone, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(report.losses[row], alone.report.losses, rtol=1e-3)
        assert int(state.step[row]) == int(alone.state.step)


@pytest.mark.slow
def test_restored_from_disk_in_any_phase_equals_unbroken(tiny_data, tmp_path) -> None:
    states = []
    dm.fit(COLD, tiny_data, key=KEY, on_report=lambda progress: states.append(progress.state))
    like = dm.init(COLD, tiny_data, key=jax.random.key(0))
    for number, state in enumerate(states[:-1]):
        folder = tmp_path / str(number)
        Checkpoints(folder).save(int(state.step), state)
        restored = Checkpoints(folder).restore_latest(like, fallback=None)
        jax.tree.map(np.testing.assert_array_equal, restored, state)
    resumed = dm.resume(COLD, restored, tiny_data)
    jax.tree.map(np.testing.assert_array_equal, resumed.state, states[-1])


def test_a_checkpoint_that_was_cut_off_is_passed_over(tmp_path, caplog) -> None:
    checkpoints, fallback = Checkpoints(tmp_path / "checkpoints"), {"x": jnp.zeros(3)}
    assert checkpoints.restore_latest(fallback, fallback=fallback) is fallback
    for number in (1, 2, 3):
        checkpoints.save(number, {"x": jnp.full(3, float(number))})
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir() if path.name.isdigit())
    assert kept == ["2", "3"]
    np.testing.assert_array_equal(checkpoints.restore_latest(fallback, fallback=fallback)["x"], 3.0)
    for path in (tmp_path / "checkpoints" / "3").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    np.testing.assert_array_equal(checkpoints.restore_latest(fallback, fallback=fallback)["x"], 2.0)
    assert "checkpoint 3 cannot be read" in caplog.text


@pytest.mark.parametrize(("furthest", "expected"), [(1, {1}), (2, {1, 2}), (5, {1, 2, 3, 4, 5})])
def test_drawn_offsets_are_clamped_to_what_there_is(furthest: int, expected: set[int]) -> None:
    phase = replace(BRIEF.cold_phases[0], num_offsets=3, max_offset=8)
    drawn = [np.asarray(draw_offsets(phase, furthest, key=jax.random.key(k))).tolist() for k in range(20)]
    assert all(len(set(one)) == len(one) == min(3, furthest) and one[0] == 1 for one in drawn)
    assert set(np.concatenate(drawn).tolist()) == expected
