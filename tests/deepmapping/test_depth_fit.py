"""Laws of DeepMapping on depth images."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dpmjax.deepmapping.depth_agreement import agreement
from dpmjax.deepmapping.depth_scans import fit_pinhole
from dpmjax.deepmapping.depth_start import DepthStartConfig
from dpmjax.nets.depth_localization import DepthLocalizationConfig

from dpmjax import deepmapping as dm
from dpmjax import io, simulation
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.nets.occupancy import OccupancyConfig
from tests.tolerances import ROUNDING

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def walk() -> io.DepthSequence:
    config = simulation.GridWalkConfig(height=12, width=16)
    return simulation.simulate_depth_sequence(0, 4, seed=1, config=config)


@pytest.fixture(scope="module")
def scans(walk) -> dm.DepthScans:
    return dm.as_depth_scans(walk.points, walk.mask)


def small(motion: str) -> dm.DepthMappingConfig:
    """The fast preset in small."""
    config = dm.depth_preset("fast", motion=motion)
    phases = [replace(phase, num_steps=4, beams_per_step=64) for phase in config.cold_phases]
    return replace(
        config,
        cold_phases=(phases[0], phases[2]),
        warm_phases=(phases[2],),
        localization=DepthLocalizationConfig(features=(8, 16), strides=(2, 1), hidden=(16,)),
        occupancy=OccupancyConfig(kind="grid", resolutions=(4, 8)),
        steps_per_call=2,
    )


def test_planar_motions_turn_about_the_vertical_axis() -> None:
    T = np.asarray(dm.motion_matrices(jnp.array([[1.0, 2.0, 0.3]])))[0]
    np.testing.assert_allclose(T[:3, 3], [1.0, 0.0, 2.0], **ROUNDING)
    np.testing.assert_allclose(T[:3, :3] @ [0, 0, 1], [np.sin(0.3), 0.0, np.cos(0.3)], **ROUNDING)
    full = np.asarray(dm.motion_matrices(jnp.array([[0.0, 0.0, 0.0, 0.0, 0.3, 0.0]])))[0]
    np.testing.assert_allclose(full[:3, :3], T[:3, :3], **ROUNDING)


@pytest.fixture(scope="module")
def steps() -> dict:
    """Compiled steps of the planar fit, shared by the tests."""
    return {}


@pytest.mark.slow
def test_a_fit_goes_through_all_phases_and_returns_rigid_motions(scans, steps) -> None:
    fitted = dm.fit_depth(scans, small("planar"), key=KEY, steps=steps)
    assert_rigid(fitted.T_world_camera)
    np.testing.assert_array_equal(fitted.T_world_camera[:, 1, 3], 0.0)
    assert int(fitted.state.step) == 8
    assert np.isfinite(float(fitted.report.loss))


def test_full_motion_leaves_the_plane(scans) -> None:
    fitted = dm.fit_depth(scans, small("full"), key=KEY, init=np.tile(np.eye(4), (4, 1, 1)))
    assert_rigid(fitted.T_world_camera)
    assert (fitted.T_world_camera[:, 1, 3] != 0.0).all()


def assert_rigid(T: np.ndarray) -> None:
    assert T.shape == (4, 4, 4)
    square = np.einsum("nji,njk->nik", T[:, :3, :3], T[:, :3, :3])
    np.testing.assert_allclose(square, np.tile(np.eye(3), (4, 1, 1)), atol=1e-5)


def test_sets_of_one_shape_share_their_compilation(scans, steps, assert_compiles_nothing) -> None:
    one = dm.fit_depth(scans, small("planar"), key=KEY, steps=steps)
    with assert_compiles_nothing():
        two = dm.fit_depth(scans, small("planar"), key=KEY, steps=steps)
    np.testing.assert_array_equal(one.T_world_camera, two.T_world_camera)


def test_masked_pixels_never_matter(walk) -> None:
    mask = walk.mask.copy()
    mask[:, 3:5] = False
    results = []
    for filling in (0.0, 1e6, np.nan):
        points = np.where(mask[..., None], walk.points, filling)
        results.append(dm.as_depth_scans(points, mask))
    jax.tree.map(np.testing.assert_array_equal, results[0], results[1])
    jax.tree.map(np.testing.assert_array_equal, results[0], results[2])


def test_direct_form_starts_where_the_network_does(scans) -> None:
    config = small("planar")
    direct = dm.init_depth(KEY, scans, dm.as_direct(config))
    network = dm.init_depth(KEY, scans, config)
    assert float(jnp.abs(direct.params.poses).max()) > 0.0
    assert float(jnp.abs(network.params.poses).max()) == 0.0
    assert all(phase.poses == "free" for phase in dm.as_direct(config).cold_phases)


def test_pinhole_is_found_in_the_clouds(walk) -> None:
    pinhole = fit_pinhole(walk.points, walk.mask)
    x, y, z = walk.points[0, 7, 11]
    np.testing.assert_allclose(pinhole.fx * x / z + pinhole.cx, 11.0, atol=0.02)
    np.testing.assert_allclose(pinhole.fy * y / z + pinhole.cy, 7.0, atol=0.02)


def test_an_image_agrees_with_itself_and_contradicts_itself_from_elsewhere(walk) -> None:
    points, mask = jnp.asarray(walk.points[0].reshape(-1, 3)), jnp.asarray(walk.mask[0].reshape(-1))
    depth = jnp.where(walk.mask[0], walk.points[0, ..., 2], 0.0)
    pinhole, tolerance = fit_pinhole(walk.points, walk.mask), jnp.float32(0.05)
    assert float(agreement(jnp.eye(4), points, mask, depth, pinhole, tolerance)) > 0.8
    nearer = jnp.eye(4).at[2, 3].set(-0.6)
    assert float(agreement(nearer, points, mask, depth, pinhole, tolerance)) < 0.0
    hidden = jnp.zeros_like(mask)
    assert float(agreement(jnp.eye(4), points, hidden, depth, pinhole, tolerance)) == 0.0


def test_images_are_placed_without_a_first_guess(walk, scans) -> None:
    config = DepthStartConfig(num_candidates=512, num_kept=16, num_points=100, num_references=2)
    T = dm.place_images(scans, config, key=KEY)
    p = walk.T_world_camera[:, :3, 3]
    relative = np.linalg.inv(walk.T_world_camera[0]) @ walk.T_world_camera
    assert absolute_trajectory_error(T[:, :3, 3], p) < 0.15
    assert np.abs(T[:, 0, 2] - relative[:, 0, 2]).max() < 0.1


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.ones((2, 3, 4)), {}, "points: expected shape"),
        (np.ones((1, 3, 4, 3)), {}, "points: expected shape"),
        (np.stack([np.ones((3, 4, 3)), np.zeros((3, 4, 3))]), {}, "image 1 has no valid pixel"),
        (np.ones((2, 3, 4, 3)), {"init": np.zeros((3, 4, 4))}, "init: expected finite"),
    ],
)
def test_bad_input_is_named(points, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        dm.fit_depth(points, small("planar"), key=KEY, **options)
    with pytest.raises(ValueError, match="preset"):
        dm.depth_preset("quick")


def test_the_truth_agrees_more_than_a_walk_with_one_wrong_turn(walk, scans) -> None:
    turned = walk.T_world_camera.copy()
    turned[2] = turned[2] @ np.asarray(dm.motion_matrices(jnp.array([[0.0, 0.0, 0.3]])))[0]
    truth, wrong = (float(dm.mean_agreement(scans, T)) for T in (walk.T_world_camera, turned))
    assert truth > wrong + 0.02
    assert truth <= 1.0


def test_agreement_has_finite_slopes_where_nothing_overlaps(scans) -> None:
    def slope(turn: float) -> jax.Array:
        def loss(values: jax.Array) -> jax.Array:
            return dm.mean_agreement(scans, dm.motion_matrices(values), 0.05)

        motions = jnp.zeros((4, 3)).at[:, 2].set(turn * jnp.arange(4))
        return jax.grad(loss)(motions)

    assert jnp.isfinite(slope(1.5)).all()
    assert jnp.isfinite(slope(0.1)).all()
