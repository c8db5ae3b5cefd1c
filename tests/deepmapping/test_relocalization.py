"""Laws of re-localisation by L-Net."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax import deepmapping as dm
from dpmjax.deepmapping.fit import init
from dpmjax.deepmapping.planar import planar_data, planar_problem
from dpmjax.deepmapping.relocalization import shift_scan, turn_scan
from dpmjax.geometry import se2
from dpmjax.nets.localization import LocalizationConfig
from dpmjax.nets.occupancy import OccupancyConfig
from dpmjax.simulation import scan_world
from dpmjax.types import ScanSet
from tests.tolerances import ROUNDING

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def fitted(tiny_walk) -> dm.Fitted:
    """A fit of the shape of a cold start, whose poses are the truth."""
    config = replace(
        dm.preset("fast"),
        occupancy=OccupancyConfig(kind="grid", resolutions=(4,)),
        localization=LocalizationConfig(features=(16, 32), strides=(1, 2), is_circular=True, hidden=(32,)),
        cold_phases=(replace(dm.preset("fast").cold_phases[0], scans_per_window=None),),
    )
    data, unit = planar_data(ScanSet(tiny_walk.points, tiny_walk.mask))
    params = init(planar_problem(config, data), data, key=KEY).params
    poses = tiny_walk.reference_poses - tiny_walk.reference_poses.mean(axis=0)
    return dm.Fitted(poses, params, None, unit, config)


@pytest.fixture(scope="module")
def trained(fitted, tiny_walk) -> dm.Fitted:
    scans = ScanSet(tiny_walk.points, tiny_walk.mask)
    return dm.train_localization(
        fitted, scans, dm.LocalizationTrainingConfig(num_steps=300, scans_per_step=20), key=KEY
    )


def test_trained_scans_come_back_near_their_poses(trained, tiny_walk) -> None:
    found = dpmjax.relocalize(trained, ScanSet(tiny_walk.points, tiny_walk.mask))
    spread = np.linalg.norm(trained.poses[:, :2], axis=1)
    error = np.linalg.norm(found.pose[:, :2] - trained.poses[:, :2], axis=1)
    assert np.median(error) < 0.4 * np.median(spread)
    np.testing.assert_allclose(found.T_world_scan, se2.to_matrix(found.pose))


def test_one_scan_is_one_row_of_many(trained, tiny_walk) -> None:
    scans = np.where(tiny_walk.mask[..., None], tiny_walk.points, 0.0)
    many = dpmjax.relocalize(trained, scans)
    one = dpmjax.relocalize(trained, scans[3])
    assert one.pose.shape == (3,)
    np.testing.assert_allclose(one.pose, many.pose[3], rtol=1e-4, atol=1e-3)


def test_teaching_keeps_poses_and_map(fitted, trained) -> None:
    np.testing.assert_array_equal(fitted.poses, trained.poses)
    jax.tree.map(np.testing.assert_array_equal, fitted.params.occupancy, trained.params.occupancy)


def test_a_turned_sensor_sees_points_turned_back() -> None:
    points = np.random.default_rng(0).normal(size=(5, 2))
    world = se2.transform_points(np.array([[0.0, 0.0, 0.7]]), points[None])[0]
    turned = np.asarray(turn_scan(jnp.asarray(points, jnp.float32), jnp.float32(0.4)))
    np.testing.assert_allclose(se2.transform_points(np.array([[0.0, 0.0, 1.1]]), turned[None])[0], world, **ROUNDING)


def test_a_shifted_scan_is_the_scan_of_the_place_in_a_convex_room() -> None:
    room = np.ones((202, 202), bool)
    room[1:-1, 1:-1] = False
    here, there = np.array([[90.0, 110.0, 0.4]]), np.array([[90.0, 110.0, 0.4]])
    shift = np.array([14.0, -9.0])
    cos, sin = np.cos(0.4), np.sin(0.4)
    there[0, :2] += [cos * shift[0] - sin * shift[1], sin * shift[0] + cos * shift[1]]
    (near, mask), (truth, _) = scan_world(room, here), scan_world(room, there)
    seen = np.asarray(shift_scan(jnp.asarray(near[0]), jnp.asarray(mask[0]), jnp.asarray(shift, jnp.float32)))
    error = np.linalg.norm(seen - truth[0], axis=-1)
    # Ranges are interpolated over corners; on the walls nothing is lost.
    assert np.median(error) < 0.05
    assert (error < 1.0).mean() > 0.95
    unmoved = shift_scan(jnp.asarray(near[0]), jnp.asarray(mask[0]), jnp.zeros(2))
    np.testing.assert_array_equal(np.asarray(unmoved), near[0])


def test_a_shifted_scan_of_no_or_few_beams_stays_finite() -> None:
    points = jnp.asarray(np.random.default_rng(0).normal(size=(16, 2)), jnp.float32)
    for valid in (0, 1, 2):
        seen = shift_scan(points, jnp.arange(16) < valid, jnp.asarray([0.3, 0.1]))
        assert np.isfinite(np.asarray(seen)).all()
        np.testing.assert_array_equal(np.asarray(seen)[valid:], np.asarray(points)[valid:])


def test_a_second_call_compiles_nothing(trained, tiny_walk, assert_compiles_nothing) -> None:
    scans = ScanSet(tiny_walk.points, tiny_walk.mask)
    dpmjax.relocalize(trained, scans)
    with assert_compiles_nothing():
        dpmjax.relocalize(trained, scans)


def test_bad_input_is_named(fitted, tiny_walk) -> None:
    with pytest.raises(ValueError, match="scans: expected shape"):
        dpmjax.relocalize(fitted, np.ones((4, 3, 3)))
    with pytest.raises(ValueError, match="no valid beam"):
        dpmjax.relocalize(fitted, np.zeros((64, 2)))
    warm = fitted._replace(params=replace(fitted.params, start=jnp.ones((20, 3))))
    with pytest.raises(ValueError, match="train_localization"):
        dpmjax.relocalize(warm, tiny_walk.points)
    with pytest.raises(ValueError, match="the 20 scans of the fit"):
        dm.train_localization(fitted, tiny_walk.points[:5], key=KEY)
    with pytest.raises(ValueError, match="drop"):
        dm.LocalizationTrainingConfig(drop=1.0)
