"""Laws of windows: cut and joined without a loss, and each with an L-Net of its own."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax import deepmapping as dm
from dpmjax.deepmapping.engine import init
from dpmjax.deepmapping.mapping import mapping_data, mapping_problem
from dpmjax.deepmapping.objective import blocks_of_step, join_windows, window_rows
from dpmjax.geometry import se2
from dpmjax.nets.mapping import LocalizationNet, LocalizationNetConfig, OccupancyConfig
from dpmjax.types import ScanSet

KEY = jax.random.key(5)
SIZES = [(2, 2), (3, 2), (9, 5), (10, 5), (12, 5), (20, 17), (5, 17), (4, 4), (17, 17), (18, 17)]
# The fast preset in small.
SMALL = replace(
    dm.preset("fast"),
    occupancy=OccupancyConfig(kind="grid", resolutions=(16, 32, 64, 128)),
    localization=LocalizationNetConfig(
        features=(16, 32), strides=(1, 2), is_circular=True, hidden=(32,), output_scale=0.1
    ),
)


@pytest.mark.parametrize(("num_scans", "length"), SIZES)
def test_windows_hold_every_motion_between_neighbours(num_scans: int, length: int) -> None:
    rows = window_rows(num_scans, length)
    assert rows.shape[1] == min(num_scans, length)
    assert (np.diff(rows, axis=1) == 1).all()
    pairs = {pair for row in rows.tolist() for pair in pairwise(row)}
    assert pairs == {(k, k + 1) for k in range(num_scans - 1)}
    phase = replace(dm.preset("fast").cold_phases[0], scans_per_window=length)
    np.testing.assert_array_equal(blocks_of_step(phase, num_scans, jnp.int32(0), key=KEY).rows, rows)


@pytest.mark.slow
@pytest.mark.parametrize(("num_scans", "length"), SIZES)
def test_windows_of_a_walk_join_to_the_walk_whatever_their_worlds(num_scans: int, length: int) -> None:
    rng = np.random.default_rng(num_scans)
    walk = se2.chain(rng.normal(size=(num_scans - 1, 3)))
    rows = window_rows(num_scans, length)
    worlds = rng.normal(size=(len(rows), 1, 3))
    joined = np.asarray(join_windows(jnp.asarray(se2.compose(worlds, walk[rows]), jnp.float32), num_scans))
    expected = se2.compose(worlds[0], walk)
    np.testing.assert_allclose(se2.to_matrix(joined), se2.to_matrix(expected), atol=2e-4)


def test_small_outputs_begin_near_zero_and_are_a_share_of_the_others() -> None:
    points, mask = jax.random.normal(KEY, (24, 2)), jnp.ones(24, bool)

    def output(scale: float) -> np.ndarray:
        net = LocalizationNet(replace(SMALL.localization, output_scale=scale))
        return np.asarray(net.apply(net.init(KEY, points, mask), points, mask))

    np.testing.assert_allclose(output(0.1), 0.1 * output(1.0), rtol=1e-5)


@pytest.mark.slow
def test_windows_with_different_scans_do_not_learn_from_each_other(tiny_data) -> None:
    phase = replace(SMALL.cold_phases[0], num_steps=2, scans_per_window=8)
    config = replace(SMALL, cold_phases=(phase,))
    other = replace(tiny_data.scans, points=tiny_data.scans.points.at[15:].multiply(0.5))
    problem = mapping_problem(config, tiny_data)

    def gradient(scans: ScanSet):
        data = tiny_data._replace(scans=scans)
        params = init(problem, data, key=KEY).params
        return jax.grad(lambda p: problem.loss(config, phase, p, data, jnp.int32(0), KEY)[0])(params).localization

    rows = window_rows(20, 8)
    assert rows[:, 0].tolist() == [0, 7, 12]
    for before, after in zip(jax.tree.leaves(gradient(tiny_data.scans)), jax.tree.leaves(gradient(other)), strict=True):
        np.testing.assert_allclose(before[:2], after[:2], rtol=1e-4, atol=1e-7)
        assert not np.allclose(before[2], after[2], rtol=1e-4, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("poses", ["network", "free"])
def test_poses_of_windows_start_in_the_world_of_the_given_start(tiny_walk, poses) -> None:
    phase = replace(SMALL.cold_phases[0], poses=poses, scans_per_window=8)
    config = replace(SMALL, warm_phases=(phase,), localization=replace(SMALL.localization, output_scale=0.0))
    data, unit = mapping_data(ScanSet(tiny_walk.points, tiny_walk.mask), tiny_walk.reference_poses)
    problem = mapping_problem(config, data)
    found = np.asarray(problem.poses(config, phase, init(problem, data, key=KEY).params, data)) * [unit, unit, 1.0]
    np.testing.assert_allclose(se2.to_matrix(found), se2.to_matrix(tiny_walk.reference_poses), atol=2e-2)


def test_networks_of_windows_do_not_relocalize(tiny_walk) -> None:
    data, unit = mapping_data(ScanSet(tiny_walk.points, tiny_walk.mask))
    params = init(mapping_problem(SMALL, data), data, key=KEY).params
    fitted = dm.Fitted(tiny_walk.reference_poses, params, None, unit, SMALL, 0)
    with pytest.raises(ValueError, match="train_localization"):
        dpmjax.relocalize(fitted, tiny_walk.points)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SMALL, dm.as_direct(SMALL)], ids=["network", "direct"])
def test_a_walk_is_found_from_zero(tiny_walk, settings) -> None:
    from dpmjax.metrics import absolute_trajectory_error

    cold = dm.fit_deepmapping(ScanSet(tiny_walk.points, tiny_walk.mask), settings, key=KEY)
    assert absolute_trajectory_error(cold.poses[:, :2], tiny_walk.reference_poses[:, :2]) < 2.0
