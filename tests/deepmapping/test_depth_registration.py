"""Laws of the registration of depth images by one call."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dpmjax import deepmapping as dm
from dpmjax.geometry import typical_range
from dpmjax.scan import DepthScans, PlacedImages, initialize_depth, projective_consistency

KEY = jax.random.key(3)
CONFIG = replace(dm.preset("fast", "depth"), steps_per_call=1)


def returning(T: np.ndarray, scans: DepthScans) -> Callable[..., dm.Fit]:
    """An engine that trains nothing and returns poses."""
    poses = np.array(T)
    poses[:, :3, 3] /= typical_range(scans.points, scans.mask)

    def engine(problem, data, *, key):
        done = dm.fit(problem, data, key=key, stop=lambda: True)
        return done._replace(poses=poses, state=done.state.replace(step=jnp.ones((), jnp.int32)))

    return engine


@pytest.mark.slow
def test_of_start_and_fit_the_more_consistent_one_is_kept(walk, scans) -> None:
    right, apart = walk.T_world_camera, np.array(walk.T_world_camera)
    apart[:, 0, 3] += np.arange(4.0)
    for start, fitted, kept in ((right, apart, "start"), (apart, right, "fit")):
        found = dm.register_depth(scans, CONFIG, key=KEY, start=start, engine=returning(fitted, scans))
        assert found.kept == kept
        np.testing.assert_allclose(found.T_world_scan, right, atol=1e-6)
        assert (found.misfit < found.start_misfit) == (kept == "fit")
        assert found.misfit == pytest.approx(1.0 - float(projective_consistency(scans, fitted)), abs=1e-4)


def test_a_fit_that_is_not_finite_or_has_no_step_is_not_kept(walk, scans) -> None:
    apart = np.array(walk.T_world_camera)
    apart[:, 0, 3] += np.arange(4.0)
    right, lost = (returning(T, scans) for T in (walk.T_world_camera, np.full((4, 4, 4), np.nan)))

    def without_step(problem, data, *, key):
        done = right(problem, data, key=key)
        return done._replace(state=done.state.replace(step=jnp.zeros((), jnp.int32)))

    for start, engine in ((walk.T_world_camera, lost), (apart, without_step)):
        found = dm.register_depth(scans, CONFIG, key=KEY, start=start, engine=engine)
        assert found.kept == "start"
        np.testing.assert_array_equal(found.T_world_scan, start)


@pytest.mark.slow
def test_without_a_start_the_search_is_the_start(walk, scans) -> None:
    found = dm.register_depth(scans, CONFIG, key=KEY, engine=returning(walk.T_world_camera, scans))
    placed = initialize_depth(scans, key=KEY)
    np.testing.assert_array_equal(found.start, placed.T_world_camera)
    again = dm.register_depth(scans, CONFIG, key=KEY, start=placed, engine=returning(walk.T_world_camera, scans))
    np.testing.assert_array_equal(again.T_world_scan, found.T_world_scan)


def test_images_between_keyframes_follow_the_keyframe_before_them(walk, scans) -> None:
    apart, rows = np.array(walk.T_world_camera), np.array([0, 2])
    apart[2:, 0, 3] += 2.0
    placed = PlacedImages(apart, rows, np.ones(4), 0.25)
    engine = returning(walk.T_world_camera[rows], scans.take(rows))
    found = dm.register_depth(scans, CONFIG, key=KEY, start=placed, engine=engine)
    assert (found.kept, list(found.keyframes)) == ("fit", [0, 2])
    np.testing.assert_allclose(found.T_world_scan, walk.T_world_camera, atol=1e-5)


def test_bad_input_is_named(scans) -> None:
    with pytest.raises(ValueError, match="points: expected shape"):
        dm.register_depth(np.zeros((4, 3)), key=KEY)
    with pytest.raises(ValueError, match="start: expected"):
        dm.register_depth(scans, key=KEY, start=np.eye(4))
