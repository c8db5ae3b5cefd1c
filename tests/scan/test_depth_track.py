"""Laws of the poses of depth images: alignment, tracking, proposals, trajectories that grow side by side."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import io, simulation
from dpmjax.geometry.sampling import typical_range
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.scan import DepthScans, as_depth_scans, initialize_depth
from dpmjax.scan.depth import track as trajectory_search
from dpmjax.scan.depth.align import (
    DepthCamera,
    DepthImages,
    adjust_poses,
    depth_view,
    linearise_images,
    step_poses,
)
from dpmjax.scan.depth.propose import MAX_TRANSLATION, propose_motions
from dpmjax.scan.depth.slide import slide_margin
from dpmjax.scan.depth.track import explained_shares
from dpmjax.sequences import ACTIVE_VISION
from dpmjax.simulation.apartments import cast_depth, make_apartment

KEY = jax.random.key(0)
ALONG, ACROSS = np.array([0.8, 0.0, 0.6]), np.array([0.6, 0.0, -0.8])
"""Directions in and across a wall."""


@pytest.fixture(scope="module")
def walk() -> io.DepthSequence:
    config = simulation.DepthWalkConfig(height=18, width=32)
    return simulation.simulate_depth_sequence(0, 4, seed=3, config=config)


@pytest.fixture(scope="module")
def stream() -> io.DepthSequence:
    """A camera that turns by 4 degrees and moves by 3 cm between images."""
    home, camera = make_apartment(0), ACTIVE_VISION
    count = np.arange(12)
    T = np.tile(np.eye(4), (len(count), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("y", 4.0 * count[:, None] + 20.0, degrees=True).as_matrix()
    T[:, :3, 3] = np.stack([2.0 + 0.03 * count, 0.0 * count, 2.0 + 0.01 * count], axis=1)
    rows, columns = camera.sample_pixels(18, 32)
    rays = camera.rays(columns, rows)
    cast = jax.vmap(cast_depth, in_axes=(0, None, None, None, None))
    depth = np.asarray(cast(T, rays, home.centres, home.half_sizes, home.yaws), np.float64)
    points = (rays * depth[..., None]).astype(np.float32)
    return io.DepthSequence("stream", points, np.ones(depth.shape, bool), True, T)


def images_of(scans: DepthScans, motion: str = "planar", unit: float | None = None, count: int = 3) -> DepthImages:
    unit = float(typical_range(scans.points, scans.mask)) if unit is None else unit
    camera = DepthCamera(scans.pinhole, unit, motion)
    rng = np.random.default_rng(0)
    return DepthImages([depth_view(scans, k, camera, rng) for k in range(len(scans.mask))], camera, count)


def pairs_of(count: int) -> np.ndarray:
    return np.argwhere(~np.eye(count, dtype=bool))


def ate(T: np.ndarray, truth: np.ndarray) -> float:
    return float(absolute_trajectory_error(T[:, :3, 3], truth[:, :3, 3]))


@pytest.mark.parametrize("motion", ["planar", "full"])
def test_adjusted_poses_come_back_to_the_truth(walk, motion: str) -> None:
    truth, images = walk.T_world_camera, images_of(as_depth_scans(walk.points, walk.mask), motion)
    step = 0.01 * np.random.default_rng(0).standard_normal((4, 6))
    step[0] = 0.0
    start = step_poses(truth, step * (np.isin(np.arange(6), images.camera.axes)))
    T = adjust_poses(images, start, pairs_of(4), 0.02, num_iterations=10)
    np.testing.assert_array_equal(T[0], start[0])
    assert ate(T, truth) < 0.3 * ate(start, truth)
    np.testing.assert_allclose(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-9)
    if motion == "planar":
        np.testing.assert_allclose(T[:, 1], start[:, 1], atol=1e-12)


def test_the_gradient_of_a_pair_is_that_of_its_gaps(walk) -> None:
    """At a wide tolerance the match is exp(-gap^2), and J^T r is half the slope of the sum of squared gaps."""
    images = images_of(as_depth_scans(walk.points[:2], walk.mask[:2]), "full", count=1)
    T = step_poses(np.eye(4), np.array([[0.0] * 6, [0.02, 0.01, 0.05, 0.01, -0.02, 0.01]]))
    twice, pair, wide = images._replace(views=[images.views[0]] * 2), np.array([[1, 0]]), 1.0

    def cost(step: np.ndarray) -> float:
        moved = np.stack([T[0], step_poses(T[1:], step[None])[0]])
        match = linearise_images(twice, moved, pair, wide).match
        return float(-np.log(match[match > 0]).sum())

    slope = np.array([(cost(step) - cost(-step)) / 2e-3 for step in 1e-3 * np.eye(6)])
    gradient = linearise_images(twice, T, pair, wide).gradient[0]
    np.testing.assert_allclose(2.0 * gradient, slope, rtol=0.1, atol=0.02 * np.abs(slope).max())


def test_poses_that_no_pair_joins_do_not_matter_to_each_other(walk) -> None:
    images = images_of(as_depth_scans(walk.points, walk.mask))
    start = step_poses(walk.T_world_camera, np.full((4, 6), 0.01) * [1, 0, 1, 0, 1, 0])
    nodes = np.array([0, 1, 2])
    alone = [adjust_poses(DepthImages([images.views[0], images.views[k]], images.camera), start[[0, k]], pairs_of(2),
                          0.02, num_iterations=3)[1] for k in (1, 2)]  # fmt: skip
    pairs = np.array([[0, 1], [1, 0], [0, 2], [2, 0]])
    both = adjust_poses(DepthImages([images.views[k] for k in nodes], images.camera), start[nodes], pairs, 0.02,
                        num_iterations=3)  # fmt: skip
    np.testing.assert_allclose(both[1:], np.stack(alone), atol=1e-6)


def test_images_that_do_not_see_each_other_stay(walk) -> None:
    images = images_of(as_depth_scans(walk.points[:2], walk.mask[:2]))
    apart = np.tile(np.eye(4), (2, 1, 1))
    apart[1, 0, 3] = 100.0
    np.testing.assert_array_equal(adjust_poses(images, apart, pairs_of(2), 0.02, num_iterations=2), apart)


def test_another_number_of_images_compiles_nothing(walk, assert_compiles_nothing) -> None:
    images = images_of(as_depth_scans(walk.points, walk.mask))
    linearise_images(images, walk.T_world_camera, pairs_of(4)[:1], 0.02)
    with assert_compiles_nothing():
        linearise_images(images._replace(num_samples=40), walk.T_world_camera, pairs_of(4), 0.03)


@pytest.mark.slow
def test_images_are_registered_without_a_first_guess(walk) -> None:
    placed = []
    scans = as_depth_scans(walk.points, walk.mask)
    found = initialize_depth(scans, key=KEY, on_image=lambda *numbers: placed.append(numbers))
    T = found.T_world_camera
    assert placed == [(number, len(T)) for number in range(1, len(T) + 1)]
    relative = np.linalg.inv(walk.T_world_camera[0]) @ walk.T_world_camera
    assert ate(T, relative) < 0.02
    assert np.abs(T[:, 0, 2] - relative[:, 0, 2]).max() < 0.02
    np.testing.assert_array_equal(T[0], np.eye(4))
    np.testing.assert_array_equal(found.keyframes, np.arange(4))
    assert found.is_trusted
    assert not found.uncertain_images


def test_a_stream_is_tracked_without_a_search(stream, monkeypatch) -> None:
    monkeypatch.setattr(trajectory_search, "propose_motions", lambda *_: pytest.fail("searched"))
    found = initialize_depth(as_depth_scans(stream.points, stream.mask), key=KEY)
    assert 2 <= len(found.keyframes) < 0.7 * len(stream)
    assert ate(found.T_world_camera, stream.T_world_camera) < 0.02


def two_views_of_a_wall(depth: float = 2.0) -> DepthScans:
    """The same image twice, of a bare wall with the normal `ACROSS`."""
    rays = np.stack([*np.meshgrid(np.linspace(-0.7, 0.7, 12), np.linspace(-0.4, 0.4, 8)), np.ones((8, 12))], axis=-1)
    wall = rays * (-depth / (rays @ ACROSS))[..., None]
    return as_depth_scans(np.stack([wall, wall]))


def test_an_image_of_one_wall_is_slid_along_it_first() -> None:
    for motion in ("planar", "full"):
        directions = images_of(two_views_of_a_wall(), motion).views[0].directions
        assert directions.shape == (2 if motion == "planar" else 3, 3)
        # In space the two directions in the wall are equal.
        np.testing.assert_allclose(np.linalg.norm(directions[:-1] @ ALONG), 1.0, atol=1e-3)
        np.testing.assert_allclose(np.abs(directions[-1] @ ACROSS), 1.0, atol=1e-3)


def test_a_bare_wall_holds_no_pose_along_it_and_a_room_does(walk) -> None:
    same = np.tile(np.eye(4), (2, 1, 1))
    same[1, :3, 3] = 1e-4  # so that no point lies on the border of two cells, where rounding decides
    consistency, margin = slide_margin(images_of(two_views_of_a_wall()), same, 0.02, 0.1)
    assert consistency > 0.5
    assert margin < 0.05
    room = images_of(as_depth_scans(walk.points[[0, 0]], walk.mask[[0, 0]]))
    assert slide_margin(room, same, 0.02, 0.1)[1] > 0.1


def test_what_a_wall_leaves_open_is_proposed_side_by_side() -> None:
    images = images_of(two_views_of_a_wall(), unit=2.0)
    T = propose_motions(np.eye(4)[None], images.views[:1], images.views[1], images.camera, np.random.default_rng(0))
    assert len(T) > 10
    np.testing.assert_allclose(T[:, :3, 3] @ ACROSS, 0.0, atol=0.005)
    np.testing.assert_allclose(T[:, 0, 2], 0.0, atol=0.005)
    places = np.sort(T[:, :3, 3] @ ALONG)
    assert np.diff(places).min() > 0.1 * MAX_TRANSLATION
    assert np.ptp(places) > MAX_TRANSLATION


def share(scans: DepthScans, T: np.ndarray, unit: float = 3.0) -> float:
    return float(explained_shares(images_of(scans, unit=unit), T[:-1], T[-1:], 0.02)[0])


def test_a_point_is_explained_once(walk) -> None:
    def of_rows(rows: list[int], T: np.ndarray) -> float:
        return share(as_depth_scans(walk.points[rows], walk.mask[rows]), T)

    same = np.tile(np.eye(4), (4, 1, 1))
    np.testing.assert_allclose(of_rows([0, 0, 0, 0], same), of_rows([0, 0], same[:2]), atol=0.05)
    assert of_rows([0, 0], same[:2]) > 0.4
    away = same[:2].copy()
    away[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert of_rows([0, 0], away) == 0.0
    nearer = same[:2].copy()
    nearer[1, 2, 3] = -0.6
    assert of_rows([0, 0], nearer) < -1.0
    # A gap of one to two tolerances explains less and contradicts nothing.
    off = same[:2].copy()
    off[1, 2, 3] = -0.03
    assert 0.0 < of_rows([0, 0], off) < of_rows([0, 0], same[:2])


def test_near_points_have_the_leeway_of_farther_ones() -> None:
    rays = np.stack([*np.meshgrid(np.linspace(-0.7, 0.7, 12), np.linspace(-0.4, 0.4, 8)), np.ones((8, 12))], axis=-1)
    moved = np.tile(np.eye(4), (2, 1, 1))
    moved[1, 2, 3] = -0.05
    shares = [
        share(as_depth_scans(np.stack([depth * rays] * 2)), moved, unit)
        for depth, unit in ((0.3, 0.3), (0.3, 4.0), (2.0, 4.0))
    ]
    assert shares[0] < -5.0
    assert abs(shares[1]) < 0.5
    assert shares[2] > 0.0
