"""Laws of DeepMapping on depth images."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.deepmapping.engine import init
from dpmjax.deepmapping.mapping import mapping_problem
from dpmjax.deepmapping.problem import MappingData
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.scan.depth.compare import Agreement, image_agreement, projective_consistency
from dpmjax.scan.depth.record import PixelSample, as_depth_scans, fit_pinhole, image_surface
from tests.tolerances import ROUNDING

KEY = jax.random.key(0)


def small(motion: str) -> dm.DeepMappingConfig:
    config = dm.preset("fast", "depth", motion=motion)
    phases = [replace(phase, num_steps=4, beams_per_step=64) for phase in config.cold_phases]
    return replace(
        config,
        cold_phases=(phases[0], phases[2]),
        warm_phases=(phases[2],),
        localization=LocalizationNetConfig(features=(8, 16), strides=(2, 1), hidden=(16,)),
        occupancy=OccupancyConfig(kind="grid", resolutions=(4, 8)),
        steps_per_call=2,
    )


def test_planar_motions_turn_about_the_vertical_axis() -> None:
    T = np.asarray(motion_matrices(jnp.array([[1.0, 2.0, 0.3]])))[0]
    np.testing.assert_allclose(T[:3, 3], [1.0, 0.0, 2.0], **ROUNDING)
    np.testing.assert_allclose(T[:3, :3] @ [0, 0, 1], [np.sin(0.3), 0.0, np.cos(0.3)], **ROUNDING)
    full = np.asarray(motion_matrices(jnp.array([[0.0, 0.0, 0.0, 0.0, 0.3, 0.0]])))[0]
    np.testing.assert_allclose(full[:3, :3], T[:3, :3], **ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["planar", "full"])
def test_a_fit_goes_through_all_phases_and_returns_rigid_motions(scans, motion: str) -> None:
    start = None if motion == "planar" else np.tile(np.eye(4), (4, 1, 1))
    fitted = dm.fit_deepmapping(scans, small(motion), key=KEY, start=start)
    R = fitted.T_world_scan[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (4, 1, 1)), atol=1e-5)
    # A planar motion stays in its plane.
    assert ((fitted.T_world_scan[:, 1, 3] == 0.0) == (motion == "planar")).all()
    assert np.isfinite(fitted.report.loss)


@pytest.mark.slow
def test_a_fit_improves_the_trajectory_of_a_perturbed_start(walk, scans) -> None:
    rng = np.random.default_rng(0)
    shake = np.asarray(motion_matrices(jnp.asarray(rng.normal(size=(4, 3)) * [0.06, 0.06, 0.03], jnp.float32)))
    start = walk.T_world_camera @ shake
    refine = replace(dm.preset("fast", "depth").warm_phases[0], num_steps=60)
    config = replace(small("planar"), warm_phases=(refine,), steps_per_call=30)
    fitted = dm.fit_deepmapping(scans, config, key=KEY, start=start)

    def ate(T: np.ndarray) -> float:
        return absolute_trajectory_error(T[:, :3, 3], walk.T_world_camera[:, :3, 3])

    assert ate(fitted.T_world_scan) < 0.5 * ate(start)


def test_masked_pixels_never_matter(walk) -> None:
    mask = walk.mask.copy()
    mask[:, 3:5] = False
    results = []
    for filling in (0.0, 1e6, np.nan):
        points = np.where(mask[..., None], walk.points, filling)
        results.append(as_depth_scans(points, mask))
    jax.tree.map(np.testing.assert_array_equal, results[0], results[1])
    jax.tree.map(np.testing.assert_array_equal, results[0], results[2])


def test_direct_form_starts_where_the_network_does(scans) -> None:
    config = small("planar")
    data = MappingData(scans)
    direct, network = (init(mapping_problem(c, data), data, key=KEY).params for c in (dm.as_direct(config), config))
    assert float(jnp.abs(direct.poses).max()) > 0.0
    assert float(jnp.abs(network.poses).max()) == 0.0
    assert all(phase.poses == "free" for phase in dm.as_direct(config).cold_phases)


def test_pinhole_is_found_in_the_clouds(walk) -> None:
    pinhole = fit_pinhole(walk.points, walk.mask)
    x, y, z = walk.points[0, 7, 11]
    np.testing.assert_allclose(pinhole.fx * x / z + pinhole.cx, 11.0, atol=0.02)
    np.testing.assert_allclose(pinhole.fy * y / z + pinhole.cy, 7.0, atol=0.02)


def test_the_surface_between_pixels_of_a_plane_is_the_plane(scans) -> None:
    row, column = np.meshgrid(np.arange(4.0), np.arange(5.0), indexing="ij")
    inverse = 0.5 + 0.03 * row - 0.02 * column
    depth = 1.0 / inverse
    depth[0, 4] *= 2.0
    depth[3, 0] = 0.0
    value, along_row, along_column, twist = np.asarray(image_surface(jnp.asarray(depth, jnp.float32)))
    is_surface = np.ones((3, 4), bool)
    # Beside an edge and beside a hole there is none.
    is_surface[0, 3] = is_surface[2, 0] = False
    np.testing.assert_allclose(value, np.where(is_surface, inverse[:-1, :-1], 0.0), **ROUNDING)
    np.testing.assert_allclose(along_row, np.where(is_surface, -0.02, 0.0), **ROUNDING)
    np.testing.assert_allclose(along_column, np.where(is_surface, 0.03, 0.0), **ROUNDING)
    np.testing.assert_allclose(twist, 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3, 4])
def test_every_pair_of_images_counts_once(walk, count: int) -> None:
    scans = as_depth_scans(walk.points[:count], walk.mask[:count])
    T = walk.T_world_camera[:count] @ np.asarray(motion_matrices(0.05 * jnp.arange(3.0 * count).reshape(count, 3)))
    T_i_j = np.linalg.inv(T)[:, None] @ T
    sample = [PixelSample(scans.points[i].reshape(-1, 3), scans.mask[i].reshape(-1)) for i in range(count)]
    T_i_j, radius = jnp.asarray(T_i_j, jnp.float32), jnp.asarray(0.02)
    pairs = [
        image_agreement(T_i_j[i, j], sample[j], scans.surfaces[i], scans.pinhole, radius)
        for i, j in itertools.permutations(range(count), 2)
    ]
    pooled = Agreement(*(jnp.stack(values) for values in zip(*pairs, strict=True))).consistency()
    np.testing.assert_allclose(projective_consistency(scans, T), pooled, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.ones((2, 3, 4)), {}, "points: expected shape"),
        (np.ones((1, 3, 4, 3)), {}, "points: expected shape"),
        (np.stack([np.ones((3, 4, 3)), np.zeros((3, 4, 3))]), {}, "image 1 has no valid pixel"),
        (np.ones((2, 3, 4, 3)), {"start": np.zeros((3, 4, 4))}, "start: expected finite"),
    ],
)
def test_bad_input_is_named(points, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.fit_deepmapping(as_depth_scans(points), small("planar"), key=KEY, **options)
    with pytest.raises(ValueError, match="preset"):
        dm.preset("quick", "depth")


def test_the_truth_is_more_consistent_than_a_walk_with_one_wrong_turn(walk, scans) -> None:
    turned = walk.T_world_camera.copy()
    turned[2] = turned[2] @ np.asarray(motion_matrices(jnp.array([[0.0, 0.0, 0.3]])))[0]
    truth, wrong = (float(projective_consistency(scans, T)) for T in (walk.T_world_camera, turned))
    assert truth > wrong + 0.02
    assert truth <= 1.0


@pytest.mark.slow
def test_consistency_has_finite_slopes_where_nothing_overlaps(scans) -> None:
    def slope(turn: float) -> jax.Array:
        def loss(values: jax.Array) -> jax.Array:
            return projective_consistency(scans, motion_matrices(values), 0.05)

        motions = jnp.zeros((4, 3)).at[:, 2].set(turn * jnp.arange(4))
        return jax.grad(loss)(motions)

    assert jnp.isfinite(slope(1.5)).all()
    assert jnp.isfinite(slope(0.1)).all()
