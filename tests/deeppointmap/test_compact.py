"""Laws of compact scans: small integers from which elements and free space are made again, within stated errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dpmjax.deeppointmap.compact_scans import compact_elements, compact_image, expand_elements, expand_image
from dpmjax.scans.surfaces import Surface, SurfaceConfig, range_image, scan_surface
from dpmjax.types import SurfaceElements


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


def elements_of(surface: Surface, seed: int = 0) -> SurfaceElements:
    """A tenth of the surface as elements; a fifth of them is not there and may be anything, some have no plane."""
    rng = np.random.default_rng(seed)
    rows = rng.permutation(len(surface.points))[: len(surface.points) // 10]
    mask, is_plane = rng.random(len(rows)) > 0.2, rng.random(len(rows)) > 0.1
    positions = np.where(mask[:, None], surface.points[rows], np.nan).astype(np.float32)
    normals = np.where(is_plane[:, None], surface.normals[rows], 0).astype(np.float32)
    planarity = np.where(is_plane, surface.flatness[rows], 0).astype(np.float32)
    return SurfaceElements(positions, normals, np.where(mask, planarity, np.nan), mask)


ELEMENTS = elements_of(SURFACE)


@pytest.mark.parametrize("scale", [0.01, 1.0, 6.0])
def test_elements_are_rounded_within_stated_errors(scale: float) -> None:
    mask = ELEMENTS.mask
    compact = compact_elements(replace(ELEMENTS, positions=np.float32(scale) * ELEMENTS.positions))
    found = expand_elements(compact)
    farthest_m = max(np.abs(ELEMENTS.positions[mask]).max() * scale, 1.0)
    np.testing.assert_allclose(compact.unit_m, farthest_m / 32767, rtol=1e-6)
    np.testing.assert_array_equal(found.mask, mask)
    errors = np.abs(found.positions - scale * ELEMENTS.positions)[mask]
    assert errors.max() <= 0.51 * compact.unit_m + 1e-6 * farthest_m
    assert np.abs(found.planarity - ELEMENTS.planarity)[mask].max() <= 0.5 / 255 + 1e-6
    is_plane = mask & (np.linalg.norm(ELEMENTS.normals, axis=1) > 0)
    cosines = np.sum(found.normals * ELEMENTS.normals, axis=1)[is_plane]
    assert cosines.min() > np.cos(np.radians(0.5))
    np.testing.assert_allclose(np.linalg.norm(found.normals[is_plane], axis=1), 1, atol=1e-6)
    assert not found.normals[mask & ~is_plane].any()
    assert {array.dtype for array in (found.positions, found.normals, found.planarity)} == {np.dtype(np.float32)}


def test_elements_that_are_not_there_are_zero() -> None:
    found = compact_elements(ELEMENTS)
    for array in (found.positions, found.planarity):
        assert not array[~ELEMENTS.mask].any()
    # The other elements do not depend on them.
    other = replace(ELEMENTS, positions=np.where(ELEMENTS.mask[:, None], ELEMENTS.positions, 1e9))
    for ours, theirs in zip(found, compact_elements(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_rounding_twice_moves_nothing() -> None:
    once = compact_elements(ELEMENTS)
    twice = compact_elements(expand_elements(once))
    np.testing.assert_allclose(twice.unit_m, once.unit_m, rtol=1e-6)
    for name in ("positions", "planarity", "mask"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name))
    # The length of a rounded normal is not 127: its components move by a step at most.
    assert np.abs(twice.normals.astype(int) - once.normals).max() <= 1


@pytest.mark.parametrize("num", [0, 5])
def test_a_scan_without_elements_stays_empty(num: int) -> None:
    nothing = SurfaceElements(np.zeros((num, 3)), np.zeros((num, 3)), np.zeros(num), np.zeros(num, bool))
    found = expand_elements(compact_elements(nothing))
    assert found.positions.shape == found.normals.shape == (num, 3)
    assert not found.mask.any()
    image = expand_image(compact_image(range_image(np.zeros((0, 3)))))
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
