"""Laws of compact scans: small integers from which surface and free space are made again, within stated errors."""

from __future__ import annotations

import numpy as np
import pytest

from dpmjax.scans.compact import compact_image, compact_surface, expand_image, expand_surface
from dpmjax.scans.free_space import range_image, view_points
from dpmjax.scans.surfaces import SurfaceConfig, scan_surface


def room(num: int = 20000, seed: int = 0) -> np.ndarray:
    """Points on the walls and the floor of a room of 20 x 10 x 4 m, the lidar in it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-10, -5, -1], [10, 5, 3], (num, 3))
    side = rng.integers(0, 5, num)
    points[side < 2, 0] = np.where(side[side < 2] == 0, -10, 10)
    points[(side == 2) | (side == 3), 1] = np.where(side[(side == 2) | (side == 3)] == 2, -5, 5)
    points[side == 4, 2] = -1
    return points.astype(np.float32)


SURFACE = scan_surface(room(), SurfaceConfig(voxel_size_m=0.15))


@pytest.mark.parametrize("max_points", [0, 1, 500, 100_000])
def test_a_thinned_surface_is_of_points_of_the_surface(max_points) -> None:
    found = expand_surface(compact_surface(SURFACE, max_points))
    assert len(found.points) == min(max_points, len(SURFACE.points))
    if max_points == 0:
        return
    is_flat = SURFACE.flatness > 0.1
    assert (found.flatness > 0.1).sum() >= min(0.8 * max_points, is_flat.sum() - 20)
    rows, distances = (column[:, 0] for column in SURFACE.tree.nearest(found.points, 1))
    assert distances.max() < 10 / 32767 * 2
    np.testing.assert_allclose(found.flatness, SURFACE.flatness[rows], atol=0.5 / 255 + 1e-9)
    cosines = np.abs(np.sum(found.normals * SURFACE.normals[rows], axis=1))
    assert cosines.min() > np.cos(np.radians(1.0))
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, atol=1e-9)
    # The tree and the samples are those of the points.
    np.testing.assert_array_equal(found.tree.nearest(found.points, 1)[0][:, 0], np.arange(len(found.points)))
    assert (found.flatness[found.samples] > 0.1).all()


def test_thinned_points_cover_the_surface() -> None:
    found = expand_surface(compact_surface(SURFACE, 1000))
    assert found.tree.nearest(SURFACE.points, 1)[1].max() < 2.0


def test_an_empty_surface_stays_empty() -> None:
    empty = scan_surface(np.zeros((0, 3), np.float32))
    found = expand_surface(compact_surface(empty, 100))
    assert found.points.shape == found.normals.shape == (0, 3)
    image = expand_image(compact_image(range_image(empty.points)))
    assert not np.isfinite(image.nearest_m).any()
    assert not image.farthest_m.any()


def test_an_image_is_rounded_outwards() -> None:
    image = range_image(SURFACE.points)
    found = expand_image(compact_image(image))
    is_measured = np.isfinite(image.nearest_m)
    np.testing.assert_array_equal(np.isfinite(found.nearest_m), is_measured)
    np.testing.assert_array_equal(found.farthest_m > 0, is_measured)
    for ours, exact, sign in ((found.nearest_m, image.nearest_m, -1), (found.farthest_m, image.farthest_m, 1)):
        error = sign * (ours[is_measured] / exact[is_measured] - 1)
        assert error.min() > -1e-9
        assert error.max() < 0.024


def test_a_compact_image_contradicts_nothing_more() -> None:
    image = range_image(SURFACE.points)
    points = np.random.default_rng(1).uniform(-12, 12, (2000, 3))
    exact, found = view_points(image, points), view_points(expand_image(compact_image(image)), points)
    assert not (found.is_contradicted & ~exact.is_contradicted).any()
    assert found.is_contradicted.sum() > 0.9 * exact.is_contradicted.sum()


def test_expanding_twice_gives_the_same() -> None:
    compact = compact_surface(SURFACE, 700)
    first, second = expand_surface(compact), expand_surface(compact)
    for name in ("points", "normals", "flatness", "samples"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
