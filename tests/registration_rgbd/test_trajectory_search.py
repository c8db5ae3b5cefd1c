"""Laws of the first poses of depth images: proposals, adjustment, trajectories that grow side by side."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import io, simulation
from dpmjax.geometry.sampling import typical_range
from dpmjax.geometry.se3 import motion_matrices
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.registration_rgbd import (
    DepthScans,
    DepthSearchConfig,
    as_depth_scans,
    initialize_depth,
)
from dpmjax.registration_rgbd.depth_images import SampledImages, Views
from dpmjax.registration_rgbd.motion_search import (
    MAX_TRANSLATION,
    SearchCamera,
    propose_motions,
    surface_directions,
)
from dpmjax.registration_rgbd.projective_consistency import adjust_poses

KEY = jax.random.key(0)
ALONG, ACROSS = np.array([0.8, 0.0, 0.6]), np.array([0.6, 0.0, -0.8])
"""Directions in and across a wall."""


@pytest.fixture(scope="module")
def walk() -> io.DepthSequence:
    config = simulation.DepthWalkConfig(height=18, width=32)
    return simulation.simulate_depth_sequence(0, 4, seed=3, config=config)


@pytest.fixture(scope="module")
def scans(walk) -> DepthScans:
    return as_depth_scans(walk.points, walk.mask)


def moved(T: np.ndarray, spread: float, motion: str, seed: int = 0) -> np.ndarray:
    """The poses, each but the first with a random motion after it."""
    values = spread * np.random.default_rng(seed).standard_normal((len(T), 3 if motion == "planar" else 6))
    values[0] = 0.0
    return T @ np.asarray(motion_matrices(jnp.asarray(values, jnp.float32)), np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["planar", "full"])
def test_adjusted_poses_come_back_to_the_truth(walk, scans, motion: str) -> None:
    truth = walk.T_world_camera
    start = moved(truth, 0.01, motion)
    unit = typical_range(scans.points, scans.mask)
    motions = adjust_poses(
        jnp.asarray(start, jnp.float32),
        SampledImages(scans, scans.pixels, unit),
        0.02,
        num_iterations=10,
        motion=motion,
    )
    T = start @ np.asarray(motions, np.float64)
    np.testing.assert_array_equal(T[0], start[0])
    before, after = (absolute_trajectory_error(X[:, :3, 3], truth[:, :3, 3]) for X in (start, T))
    assert after < 0.3 * before
    np.testing.assert_allclose(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-5)


@pytest.mark.slow
def test_images_are_registered_without_a_first_guess(walk, scans) -> None:
    config = DepthSearchConfig(num_candidates=512)
    placed = []
    T = initialize_depth(scans, config, key=KEY, on_image=lambda *numbers: placed.append(numbers))
    assert placed == [(number, len(T)) for number in range(1, len(T) + 1)]
    relative = np.linalg.inv(walk.T_world_camera[0]) @ walk.T_world_camera
    assert absolute_trajectory_error(T[:, :3, 3], relative[:, :3, 3]) < 0.02
    assert np.abs(T[:, 0, 2] - relative[:, 0, 2]).max() < 0.02
    np.testing.assert_array_equal(T[0], np.eye(4))


def two_views_of_a_wall() -> DepthScans:
    """The same image twice, of a bare wall with the normal `ACROSS`, two metres away."""
    rays = np.stack([*np.meshgrid(np.linspace(-0.7, 0.7, 12), np.linspace(-0.4, 0.4, 8)), np.ones((8, 12))], axis=-1)
    wall = rays * (-2.0 / (rays @ ACROSS))[..., None]
    return as_depth_scans(np.stack([wall, wall]))


def test_an_image_of_one_wall_is_slid_along_it_first() -> None:
    scans = two_views_of_a_wall()
    for motion in ("planar", "full"):
        directions = surface_directions(scans, motion)
        assert directions.shape == (2, 2 if motion == "planar" else 3, 3)
        # In space the two directions in the wall are equal.
        in_wall = directions[0, : directions.shape[1] - 1]
        np.testing.assert_allclose(np.linalg.norm(in_wall @ ALONG), 1.0, atol=1e-3)
        np.testing.assert_allclose(np.abs(directions[0, -1] @ ACROSS), 1.0, atol=1e-3)


@pytest.mark.slow
def test_what_a_wall_leaves_open_is_proposed_side_by_side() -> None:
    scans = two_views_of_a_wall()
    views, directions = Views(scans.pixels, scans.surfaces), jnp.asarray(surface_directions(scans, "planar"))
    config = DepthSearchConfig(num_candidates=256, num_varied=8)
    T = propose_motions(np.eye(4)[None], views, directions, SearchCamera(scans.pinhole, 2.0), config, key=KEY)
    assert T.shape == (16, 4, 4)
    np.testing.assert_allclose(T[:, :3, 3] @ ACROSS, 0.0, atol=0.005)
    np.testing.assert_allclose(T[:, 0, 2], 0.0, atol=0.005)
    places = np.sort(T[:, :3, 3] @ ALONG)
    assert np.diff(places).min() > 0.1 * MAX_TRANSLATION
    assert np.ptp(places) > MAX_TRANSLATION
