"""Laws of surface elements: normals of planes, the order of farthest points, masks, both builders."""

import jax
import numpy as np
import pytest

from dpmjax.geometry.normals import pyramid_elements
from dpmjax.geometry.pyramid import PyramidConfig, PyramidStage, build_pyramid, build_pyramid_on_host
from dpmjax.types import SurfaceElements
from tests.tolerances import ROUNDING

CONFIG = PyramidConfig(stages=(PyramidStage(96, (0.3,), 12), PyramidStage(24, (0.5,), 8)), num_interpolations=1)
NORMAL = np.array([0.48, 0.6, 0.64])


def plane(num: int = 600, noise: float = 0.0) -> np.ndarray:
    """Random points of the plane NORMAL . x = -0.5, within a unit of its centre."""
    rng = np.random.default_rng(0)
    along = np.linalg.svd(NORMAL[None])[2][1:]
    points = rng.uniform(-1, 1, (num, 2)) @ along + (noise * rng.normal(size=(num, 1)) - 0.5) * NORMAL
    return points.astype(np.float32)


def elements_of(points: np.ndarray, mask: np.ndarray | None = None, num: int = 96) -> SurfaceElements:
    return jax.device_get(pyramid_elements(build_pyramid(points, mask, CONFIG), num))


def test_elements_are_the_planes_of_the_principal_components() -> None:
    """The oracle sees all points and takes those that are nearest."""
    points = plane(noise=0.05)
    found = elements_of(points)
    for position, normal, planarity in zip(found.positions, found.normals, found.planarity, strict=True):
        distances = np.linalg.norm(points.astype(float) - position, axis=1)
        near = np.argsort(distances)[:12]
        values, vectors = np.linalg.eigh(np.cov(points[near[distances[near] < 0.3]].astype(float).T, bias=True))
        assert planarity == pytest.approx((values[1] - values[0]) / values[2], abs=1e-4)
        if planarity > 0.05:
            assert abs(normal @ vectors[:, 0]) == pytest.approx(1, abs=1e-4)
            assert normal @ position < 0  # towards the lidar


def test_elements_stand_in_the_order_of_farthest_points() -> None:
    pyramid = build_pyramid(plane(), None, CONFIG)
    few, many = (pyramid_elements(pyramid, num) for num in (24, 96))
    np.testing.assert_array_equal(few.positions, pyramid.levels[2].positions)
    jax.tree.map(lambda some, more: np.testing.assert_allclose(some, more[:24], **ROUNDING), few, many)


@pytest.mark.parametrize("num_valid", [600, 60, 5, 3, 1, 0])
def test_both_builders_give_the_same_elements(num_valid: int) -> None:
    points, mask = plane(noise=0.02), np.arange(600) < num_valid
    points[~mask] = np.nan
    ours, host = (pyramid_elements(build(points, mask, CONFIG), 96) for build in (build_pyramid, build_pyramid_on_host))
    np.testing.assert_array_equal(ours.mask, np.arange(96) < num_valid)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(ours))
    assert num_valid > 3 or not ours.planarity.any()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), ours, host)


def test_points_of_a_line_or_of_one_place_are_no_plane() -> None:
    line = np.linspace(0, 1, 100, dtype=np.float32)[:, None] * np.array([1, 2, 3], np.float32)
    for points in (line, np.ones((100, 3), np.float32)):
        found = elements_of(points)
        np.testing.assert_allclose(found.planarity, 0, atol=1e-3)
        assert np.isfinite(found.normals).all()


@pytest.mark.parametrize("num", [0, 97])
def test_more_elements_than_points_are_refused(num: int) -> None:
    with pytest.raises(ValueError, match="num_elements: expected from 1 to 96"):
        elements_of(plane(), num=num)
