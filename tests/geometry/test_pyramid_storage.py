import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.geometry import PyramidConfig, PyramidStage, build_pyramid_on_host
from dpmjax.geometry.pyramid_storage import moved_pyramid, record_type, store_pyramid, stored_pyramids
from dpmjax.types import PointPyramid

CONFIG = PyramidConfig((PyramidStage(24, (0.3, 0.5), 6), PyramidStage(8, (1.0,), 3), PyramidStage(4, (2.0,), 3)), 2)
CAPACITY = 64
moved = jax.jit(moved_pyramid)


def pyramid(num_points: int) -> PointPyramid:
    points = np.zeros((CAPACITY, 3), np.float32)
    points[:num_points] = np.random.default_rng(num_points).uniform(-1, 1, (num_points, 3))
    return build_pyramid_on_host(points, np.arange(CAPACITY) < num_points, CONFIG)


def stored(*pyramids: PointPyramid):
    leaves = [tuple(jax.tree.leaves(store_pyramid(one))) for one in pyramids]
    return stored_pyramids(np.array(leaves, record_type(CONFIG, CAPACITY)), CONFIG)


def one_of(pyramid: PointPyramid):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), stored(pyramid))


@pytest.mark.parametrize("num_points", [0, 2, 19, 64])
def test_a_stored_pyramid_is_the_same_up_to_its_rounding(num_points: int) -> None:
    expected = pyramid(num_points)
    found = moved(one_of(expected), jnp.eye(4))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # 1e-8 in the weights' denominator is small against squared distances, but not against rounding.
        np.testing.assert_allclose(a, b, atol=2e-3 if b.dtype == np.float32 else 0)


def test_a_moved_pyramid_is_that_of_the_moved_points() -> None:
    before = pyramid(40)
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", (0.1, -0.2, 2.5)).as_matrix(), (0.02, -0.01, 0.005)
    found = moved(one_of(before), T)
    for level, of_before in zip(found.levels, before.levels, strict=True):
        num = int(of_before.mask.sum())
        expected = of_before.positions[:num] @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(level.positions[:num], expected, atol=1e-4)
        assert not np.asarray(level.positions[num:]).any()


def test_what_cannot_be_stored_is_refused() -> None:
    with pytest.raises(ValueError, match="capacity"):
        record_type(CONFIG, 70000)
    points = np.random.default_rng(0).uniform(-1, 1, (CAPACITY, 3)).astype(np.float32)
    with pytest.raises(ValueError, match="in front"):
        stored(build_pyramid_on_host(points, np.arange(CAPACITY) > 3, CONFIG))
