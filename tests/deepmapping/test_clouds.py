"""Laws of DeepMapping on lidar clouds, in a room of exact planes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.deepmapping.cloud_scans import find_partners, misfit_of_pairs, plane_misfit, trajectory_misfit
from dpmjax.deepmapping.engine import init
from dpmjax.deepmapping.mapping import mapping_data, mapping_problem
from dpmjax.deepmapping.objective import blocks_of_step
from dpmjax.geometry import rigid
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.types import SurfaceElements
from tests.tolerances import ACCUMULATED, ROUNDING

KEY = jax.random.key(0)
NUM_SCANS = 5
HALF_SIDES = np.array([4.0, 3.0, 1.5])


def look_around(position: np.ndarray, rng: np.random.Generator, count: int = 1500) -> np.ndarray:
    """Points (count, 3) on the walls of a box about the origin, seen from a position, in the axes of the box."""
    beams = rng.normal(size=(count, 3))
    ends = np.where(beams > 0, HALF_SIDES, -HALF_SIDES) - position
    return beams * np.min(ends / beams, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    steps = np.arange(float(NUM_SCANS))[:, None] * np.array([[0.25, 0.1, 0.02, 0.01, -0.01, 0.08]])
    return np.asarray(rigid.exp(jnp.asarray(steps, jnp.float32)), np.float64)


@pytest.fixture(scope="module")
def clouds(truth) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [look_around(T[:3, 3], rng) @ T[:3, :3] for T in truth]


@pytest.fixture(scope="module")
def scans(clouds) -> dm.CloudScans:
    return dm.as_cloud_scans(clouds, 512)


@pytest.fixture(scope="module")
def start(truth) -> np.ndarray:
    rng = np.random.default_rng(1)
    return truth @ np.asarray(rigid.exp(jnp.asarray(rng.normal(size=(NUM_SCANS, 6)) * 0.03)), np.float64)


def small(num_steps: int = 4) -> dm.DeepMappingConfig:
    """The fast preset in small."""
    config = dm.preset("fast", "clouds")
    cold = [replace(phase, num_steps=2, beams_per_step=32) for phase in config.cold_phases]
    warm = replace(config.warm_phases[0], num_steps=num_steps, num_offsets=2)
    return replace(
        config,
        cold_phases=(cold[0], cold[2]),
        warm_phases=(warm,),
        localization=LocalizationNetConfig(kind="point", features=(8, 16), hidden=(16,)),
        occupancy=OccupancyConfig(kind="grid", resolutions=(4, 8)),
        steps_per_call=max(2, num_steps // 2),
    )


def all_pairs(count: int) -> jnp.ndarray:
    return jnp.asarray([(i, j) for i in range(count) for j in range(i)])


def ate(T: np.ndarray, truth: np.ndarray) -> float:
    return absolute_trajectory_error(T[:, :3, 3], truth[:, :3, 3])


def test_misfit_of_a_point_is_the_kernel_of_its_distance_to_the_plane() -> None:
    floor = np.stack(np.meshgrid(np.arange(-2.0, 3.0), np.arange(-2.0, 3.0)), -1).reshape(-1, 2)
    up = np.tile([0.0, 0.0, 1.0], (25, 1))
    target = SurfaceElements(
        jnp.asarray(np.column_stack([floor, np.zeros(25)])), jnp.asarray(up), jnp.ones(25), jnp.ones(25, bool)
    )
    source = SurfaceElements(jnp.array([[0.3, 0.2, 0.1]]), jnp.array([[0.0, 0.0, 1.0]]), jnp.ones(1), jnp.ones(1, bool))
    found = plane_misfit(jnp.eye(4), source, target, 0.2, 1.0)
    np.testing.assert_allclose(found, 0.1**2 / (0.1**2 + 0.2**2), **ROUNDING)
    far = replace_points(source, [[0.3, 0.2, 5.0]])
    np.testing.assert_allclose(plane_misfit(jnp.eye(4), far, target, 0.2, 1.0), 1.0, **ROUNDING)
    other_side = replace(source, normals=-source.normals)
    np.testing.assert_allclose(plane_misfit(jnp.eye(4), other_side, target, 0.2, 1.0), 1.0, **ROUNDING)


def replace_points(cloud: SurfaceElements, points: list[list[float]]) -> SurfaceElements:
    return replace(cloud, positions=jnp.asarray(points))


@pytest.mark.slow
def test_the_gradient_vanishes_at_the_true_poses_of_exact_planes(truth, scans) -> None:
    # Only points whose neighbourhood lies on one wall have its exact normal.
    exact = replace(scans, flatness=jnp.where(is_exact(scans, truth), scans.flatness, 0.0)).planes

    def misfit(twists: jnp.ndarray, cloud: SurfaceElements) -> jnp.ndarray:
        T = jnp.asarray(truth, jnp.float32) @ rigid.exp(twists)
        return misfit_of_pairs(T, cloud, cloud, all_pairs(NUM_SCANS), jnp.ones(10, bool), (0.1, scans.spacing))

    gradient = jax.jit(jax.grad(misfit))
    shaken = gradient(jnp.full((NUM_SCANS, 6), 0.01).at[::2].set(-0.01), exact)
    still = gradient(jnp.zeros((NUM_SCANS, 6)), exact)
    assert np.abs(np.asarray(still)).max() < 0.01 * np.abs(np.asarray(shaken)).max()


def is_exact(scans: dm.CloudScans, truth: np.ndarray) -> jnp.ndarray:
    normals = np.einsum("nij,ncj->nci", truth[:, :3, :3], np.asarray(scans.normals))
    return jnp.asarray(np.abs(normals).max(-1) > 1.0 - 1e-6)


@pytest.mark.slow
def test_no_plane_is_a_misfit_with_a_finite_gradient(scans) -> None:
    empty = replace(scans, mask=jnp.zeros_like(scans.mask)).planes
    first = jax.tree.map(lambda leaf: leaf[0], empty)
    value, gradient = jax.value_and_grad(plane_misfit)(jnp.eye(4), first, first, 0.1, 0.1)
    assert float(value) == 1.0
    assert np.isfinite(np.asarray(gradient)).all()


@pytest.mark.slow
def test_rows_that_are_not_there_never_matter(truth, scans) -> None:
    short = replace(scans, mask=scans.mask & (jnp.arange(512) < 300))
    filled = replace(short, points=jnp.where(short.mask[..., None], short.points, jnp.nan))
    values = [float(trajectory_misfit(each, jnp.asarray(truth, jnp.float32), 0.05)) for each in (short, filled)]
    assert values[0] == values[1]


@pytest.mark.slow
def test_a_perturbed_start_comes_back(truth, scans, start) -> None:
    fitted = dm.register_clouds(scans, small(80), key=KEY, start=start)
    assert fitted.kept == "fit"
    assert fitted.misfit < fitted.start_misfit
    assert ate(fitted.T_world_scan, truth) < 0.25 * ate(start, truth)


@pytest.mark.slow
def test_a_fit_that_is_worse_than_its_start_is_not_kept(truth, scans) -> None:
    config = small(2)
    thrown = replace(config.warm_phases[0], learning_rate=1.0)
    fitted = dm.register_clouds(scans, replace(config, warm_phases=(thrown,)), key=KEY, start=truth)
    assert fitted.kept == "start"
    assert fitted.misfit > fitted.start_misfit
    np.testing.assert_allclose(fitted.T_world_scan, truth, **ACCUMULATED)


@pytest.mark.slow
def test_equal_keys_give_equal_fits_and_the_second_compiles_nothing(scans, start, assert_compiles_nothing) -> None:
    first = dm.register_clouds(scans, small(), key=KEY, start=start)
    with assert_compiles_nothing():
        second = dm.register_clouds(scans, small(), key=KEY, start=start)
    np.testing.assert_array_equal(first.T_world_scan, second.T_world_scan)


@pytest.mark.slow
def test_a_cold_start_goes_through_all_phases(scans) -> None:
    fitted = dm.register_clouds(scans, small(), key=KEY)
    square = np.einsum("nji,njk->nik", fitted.T_world_scan[:, :3, :3], fitted.T_world_scan[:, :3, :3])
    np.testing.assert_allclose(square, np.tile(np.eye(3), (NUM_SCANS, 1, 1)), atol=1e-5)
    assert fitted.start_misfit is None
    assert np.isfinite(fitted.fitted.report.loss)


def test_long_sets_are_fitted_in_blocks_that_see_every_scan(scans) -> None:
    phase = replace(dm.preset("fast", "clouds").warm_phases[0], scans_per_step=64)
    seen = set()
    for step in range(60):
        rows = np.asarray(blocks_of_step(phase, 100, jnp.int32(step), key=jax.random.fold_in(KEY, step)).rows)
        assert rows.shape == (2, 32)
        assert (np.diff(rows, axis=1) == 1).all()
        seen |= set(rows.ravel().tolist())
    assert seen == set(range(100))


@pytest.mark.slow
def test_a_step_of_blocks_moves_the_scans_that_it_draws(scans) -> None:
    many = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 8), replace(scans, spacing=jnp.zeros(1)))
    many = replace(many, spacing=scans.spacing)
    phase = replace(small().warm_phases[0], scans_per_step=32, beams_per_step=16)
    config = replace(small(), warm_phases=(phase,))
    data, _ = mapping_data(many, np.tile(np.eye(4), (40, 1, 1)))
    problem = mapping_problem(config, data)
    params = init(problem, data, key=KEY).params

    def loss(params: object) -> jnp.ndarray:
        return problem.loss(config, phase, params, data, jnp.int32(0), KEY)[0]

    moved = np.abs(np.asarray(jax.jit(jax.grad(loss, allow_int=True))(params).poses)).sum(-1) > 0
    assert moved.sum() >= 32
    assert np.isfinite(float(loss(params)))


def test_partners_are_near_in_space_and_not_in_time() -> None:
    T = np.tile(np.eye(4), (30, 1, 1))
    angle = 2.0 * np.pi * np.arange(30) / 15.0
    T[:, :2, 3] = 3.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    partners = np.asarray(find_partners(T, 1.0))
    assert (partners[:, 0] == (np.arange(30) + 15) % 30).all()
    for row, others in enumerate(partners):
        others = others[others >= 0]
        assert (np.linalg.norm(T[others, :3, 3] - T[row, :3, 3], axis=1) <= 0.5).all()
        assert (np.abs(others - row) > 8).all()


def test_thinning_keeps_points_of_the_scan_and_fills_the_capacity(clouds) -> None:
    ragged = [clouds[0], clouds[1][:100], np.concatenate([clouds[2], np.full((3, 3), np.nan)])]
    scans = dm.as_cloud_scans(ragged, 256)
    counts = np.asarray(scans.mask).sum(1)
    assert counts[1] <= 100
    assert (counts[[0, 2]] > 180).all()
    for cloud, points, mask in zip(ragged, np.asarray(scans.points), np.asarray(scans.mask), strict=True):
        distances = np.linalg.norm(points[mask][:, None] - np.nan_to_num(cloud)[None], axis=-1).min(1)
        assert distances.max() < 1e-5
        assert (points[~mask] == 0.0).all()


@pytest.mark.parametrize(
    ("scans", "message"),
    [
        ([np.ones((4, 3))], "at least 2"),
        ([np.ones((4, 3)), np.ones((4, 2))], r"shape \(m, 3\) of scan 1"),
        ([np.ones((4, 3)), np.full((4, 3), np.nan)], "scan 1 has no valid point"),
    ],
)
def test_bad_scans_are_refused(scans, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.register_clouds(scans, key=KEY)


def test_bad_starts_are_refused(scans) -> None:
    with pytest.raises(ValueError, match="init"):
        dm.register_clouds(scans, small(), key=KEY, start=np.eye(4))
