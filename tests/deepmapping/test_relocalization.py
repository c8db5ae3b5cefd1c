"""Laws of re-localisation: L-Net's proposals, rendered scans, and the search in the map."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpmjax
from dpmjax import deepmapping as dm
from dpmjax.deepmapping import relocalization
from dpmjax.deepmapping.engine import init
from dpmjax.deepmapping.map_rendering import make_raster, render_scans
from dpmjax.deepmapping.mapping import mapping_data, mapping_problem
from dpmjax.deepmapping.problem import MapFrame
from dpmjax.deepmapping.relocalization import propose_poses
from dpmjax.geometry import se2
from dpmjax.nets.mapping import LocalizationNetConfig, OccupancyConfig
from dpmjax.simulation import cast_scans, make_world, scan_world, simulate_sequence
from dpmjax.types import ScanSet

KEY = jax.random.key(0)


CELLS = 512


@pytest.fixture(scope="module")
def fitted(tiny_walk) -> dm.Fitted:
    """A fit of the shape of a cold start, whose poses are the truth and whose map is the true world."""
    config = replace(
        dm.preset("fast"),
        occupancy=OccupancyConfig(kind="grid", resolutions=(CELLS,)),
        localization=LocalizationNetConfig(features=(16, 32), strides=(1, 2), is_circular=True, hidden=(32,)),
        cold_phases=(replace(dm.preset("fast").cold_phases[0], scans_per_window=None),),
    )
    data, unit = mapping_data(ScanSet(tiny_walk.points, tiny_walk.mask))
    params = init(mapping_problem(config, data), data, key=KEY).params
    return dm.Fitted(tiny_walk.reference_poses, with_true_map(params, tiny_walk, unit), None, unit, config, 1)


def with_true_map(params, walk, unit: float):
    """Log odds of 4 or -4 at the nodes within reach of the walk, 0 elsewhere."""
    half = 2.2
    centre = walk.reference_poses[:, :2].mean(axis=0) / unit
    axis = np.linspace(-half, half, CELLS + 1)
    nodes = unit * (centre + np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1))
    grid = np.pad(make_world(0).is_obstacle, 1, constant_values=True)
    column, row = np.clip(np.floor(nodes).astype(int) + 1, 0, grid.shape[0] - 1).transpose(2, 0, 1)
    logits = jnp.asarray(np.where(grid[row, column], 4.0, -4.0), jnp.float32)
    frame = MapFrame(centre=jnp.asarray(centre, jnp.float32), half_side=jnp.float32(half))
    return replace(params, occupancy={"params": {f"level_{CELLS}": logits}}, frame=frame)


@pytest.fixture(scope="module")
def unmapped(fitted) -> dm.Fitted:
    """The same fit before M-Net has learned anything."""
    blank = jax.tree.map(jnp.zeros_like, fitted.params.occupancy)
    return fitted._replace(params=replace(fitted.params, occupancy=blank))


@pytest.fixture(scope="module")
def trained(fitted, tiny_walk) -> dm.Fitted:
    scans = ScanSet(tiny_walk.points, tiny_walk.mask)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relocalization, "_SCANS_PER_STEP", 32)
        patch.setattr(relocalization, "_NUM_RENDERED", 400)
        return dm.train_localization(fitted, scans, num_steps=400, key=KEY)


@pytest.fixture(scope="module")
def queries(tiny_walk) -> tuple[np.ndarray, np.ndarray]:
    """Scans some pixels beside the walk, at any heading, and where they were taken."""
    rng = np.random.default_rng(0)
    truth = tiny_walk.reference_poses + rng.uniform(-1, 1, (len(tiny_walk), 3)) * [5.0, 5.0, np.pi]
    return scan_world(make_world(0).is_obstacle, truth, num_beams=64)[0], truth


@pytest.mark.slow
def test_new_scans_of_any_heading_are_found_and_known(fitted, trained, queries) -> None:
    points, truth = queries
    found = dpmjax.relocalize(trained, points)
    error = np.linalg.norm(found.pose[:, :2] - truth[:, :2], axis=1)
    turn = np.abs(se2.wrap_angle(found.pose[:, 2] - truth[:, 2]))
    assert (error < 5.0).mean() > 0.8
    assert np.median(np.rad2deg(turn)) < 1.0
    assert found.is_known[error < 5.0].mean() > 0.8
    assert found.nats[error < 5.0].max() < found.nats[error > 50.0].min(initial=np.inf)
    np.testing.assert_allclose(found.T_world_scan, se2.to_matrix(found.pose))
    # One scan is one row of many.
    one = dpmjax.relocalize(trained, points[3])
    assert (one.pose.shape, one.is_known.shape) == ((3,), ())
    np.testing.assert_allclose(one.pose, found.pose[3], rtol=1e-4, atol=1e-2)
    # L-Net is taught, poses and map stay.
    np.testing.assert_array_equal(fitted.poses, trained.poses)
    jax.tree.map(np.testing.assert_array_equal, fitted.params.occupancy, trained.params.occupancy)


@pytest.mark.slow
def test_views_of_another_world_are_not_known(trained) -> None:
    elsewhere = simulate_sequence(1, 20, num_beams=64, seed=3)
    assert dpmjax.relocalize(trained, elsewhere.points).is_known.mean() < 0.2


@pytest.mark.slow
def test_without_a_map_no_scan_is_known_and_the_proposal_stays(unmapped, queries) -> None:
    found = dpmjax.relocalize(unmapped, queries[0])
    np.testing.assert_allclose(found.nats, np.log(4.0), rtol=1e-5)
    assert not found.is_known.any()
    scans = ScanSet(jnp.asarray(queries[0]) / unmapped.unit, jnp.ones(queries[0].shape[:2], bool))
    proposals = propose_poses(unmapped.params.localization, scans, num_turns=24, fit_config=unmapped.config)
    np.testing.assert_allclose(found.pose[:, :2] / unmapped.unit, proposals[:, 0, :2], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_rendered_scans_are_those_of_the_world(fitted, tiny_walk) -> None:
    scans = ScanSet(jnp.asarray(tiny_walk.points) / fitted.unit, jnp.asarray(tiny_walk.mask))
    raster = make_raster(fitted)
    rendered, poses = render_scans(raster, scans, 200, key=KEY)
    assert 100 < len(poses) <= 200
    places = np.asarray(poses, np.float64) * [fitted.unit, fitted.unit, 1.0]
    grid = make_world(0).is_obstacle
    # Near a wall, a node that is free may lie a pixel inside of it.
    inside = ((places[:, :2] >= 0) & (places[:, :2] < len(grid))).all(axis=1)
    column, row = np.where(inside, places[:, :2].T, 0).astype(int)
    rows = np.flatnonzero(inside & ~grid[row, column])
    assert len(rows) > 0.9 * len(poses)
    truth = cast_scans(grid, places[rows], num_beams=64)
    ranges = np.linalg.norm(np.asarray(rendered.points)[rows], axis=-1) * fitted.unit
    error = np.abs(ranges - truth)[np.asarray(rendered.mask)[rows]]
    spacing = float(raster.spacing) * fitted.unit
    assert np.median(error) < spacing
    assert (error < 3.0 * spacing).mean() > 0.9


def test_nothing_is_rendered_from_a_map_that_knows_nothing(unmapped, tiny_walk) -> None:
    scans = ScanSet(jnp.asarray(tiny_walk.points) / unmapped.unit, jnp.asarray(tiny_walk.mask))
    rendered, poses = render_scans(make_raster(unmapped), scans, 50, key=KEY)
    assert rendered.points.shape == (0, 64, 2)
    assert poses.shape == (0, 3)


@pytest.mark.slow
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
    with pytest.raises(ValueError, match="num_steps"):
        dm.train_localization(fitted, tiny_walk.points, num_steps=0, key=KEY)
    with pytest.raises(ValueError, match="max_nats"):
        dpmjax.relocalize(fitted, tiny_walk.points, max_nats=0.0)
