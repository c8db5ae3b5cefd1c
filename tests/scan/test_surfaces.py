from __future__ import annotations

import numpy as np
import pytest

from dpmjax.geometry import estimate_normals
from dpmjax.geometry.neighbours import HostTree
from dpmjax.scan.lidar.align import LEVELS, align_on_host
from dpmjax.scan.lidar.pairs import nearest_planes
from dpmjax.scan.lidar.surfaces import MIN_FLATNESS, SurfaceConfig, firm_surface, scan_surface, surface_at
from tests.scan.surface_scenes import motion, street


def test_normals_are_those_of_the_device() -> None:
    points = street(0, 800)
    surface = scan_surface(points, SurfaceConfig(voxel_size_m=0.01, neighbour_radius_m=100, num_neighbours=8))
    expected = estimate_normals(surface.points.astype(np.float32), 8)
    flat = (np.asarray(expected.flatness) > 0.05) & (surface.flatness > 0.05)
    cosines = np.abs(np.sum(np.asarray(expected.normals) * surface.normals, axis=1))
    assert flat.mean() > 0.5
    np.testing.assert_allclose(cosines[flat], 1, atol=1e-2)
    np.testing.assert_allclose(surface.flatness, expected.flatness, atol=1e-2)


def test_a_sparse_scan_has_normals_too() -> None:
    """Hardly any of 240 points on the street has four neighbours within 1.5 m."""
    sparse = street(0, 240, noise_m=0.0)
    fixed, adapted = (scan_surface(sparse, SurfaceConfig(sparse_radius_share=share)) for share in (0.0, 1.5))
    assert len(fixed.samples) < 0.3 * len(sparse)
    is_ground = (adapted.points[:, 2] < -1.69) & (np.abs(adapted.points[:, 1]) < 5)
    assert len(adapted.samples) > 0.7 * len(sparse)
    assert np.median(np.abs(adapted.normals[is_ground, 2])) > 0.99


def test_samples_tell_as_much_about_each_direction() -> None:
    surface = scan_surface(street(2))
    first = np.argmax(np.abs(surface.normals[surface.samples[:300]]), axis=1)
    np.testing.assert_array_less(80, np.bincount(first, minlength=3))
    assert len(np.unique(surface.samples)) == len(surface.samples)


@pytest.mark.parametrize("num_points", [0, 1, 3])
def test_surface_of_hardly_any_point_is_flat_nowhere(num_points: int) -> None:
    surface = scan_surface(np.eye(3)[:num_points] * 5)
    assert len(surface.points) == num_points
    assert len(surface.samples) == 0
    start = motion(10, (1, 0, 0))
    np.testing.assert_array_equal(align_on_host(surface, surface, start[None], LEVELS).T_target_source[0], start)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SurfaceConfig(voxel_size_m=0.0), "voxel_size_m"),
        (lambda: SurfaceConfig(min_range_m=90.0), "min_range_m"),
    ],
)
def test_settings_out_of_range_are_named(make, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make()


def test_wrong_shape_is_named(as_user) -> None:
    with pytest.raises(ValueError, match="^points: expected shape"):
        scan_surface(np.zeros((4, 2)))


def street_under_foliage() -> np.ndarray:
    return np.concatenate([street(0), np.random.default_rng(0).uniform(15, 25, (200, 3))])


def test_a_surface_at_some_points_has_the_normals_of_all() -> None:
    points = street_under_foliage()
    whole = scan_surface(points)
    rows = np.random.default_rng(1).permutation(len(whole.points))[:700]
    some = surface_at(HostTree(whole.points), rows)
    is_flat = whole.flatness[rows] > MIN_FLATNESS
    np.testing.assert_array_equal(some.points, whole.points[rows])
    np.testing.assert_allclose(some.flatness[is_flat], whole.flatness[rows][is_flat], atol=1e-12)
    np.testing.assert_allclose(np.abs((some.normals * whole.normals[rows]).sum(axis=1)[is_flat]), 1, atol=1e-6)


def test_points_of_no_surface_are_the_last_samples_and_are_paired_with_any_plane() -> None:
    points = street_under_foliage()
    whole = scan_surface(points)
    some = surface_at(HostTree(whole.points), np.arange(len(whole.points)))
    num_flat = int((some.flatness > 0).sum())
    assert 100 < len(some.points) - num_flat < 400
    assert sorted(some.samples) == list(range(len(some.points)))
    assert (some.flatness[some.samples[:num_flat]] > MIN_FLATNESS).all()
    assert not some.normals[some.samples[num_flat:]].any()
    planes = nearest_planes(some, whole, np.eye(4)[None], 3.0, len(some.points))
    assert (planes.cosines[0, num_flat:] == 1).all()


def test_a_firm_surface_has_fewer_normals_and_the_same_points() -> None:
    whole = scan_surface(street_under_foliage())
    firm = firm_surface(whole, 0.4)
    has_normal = firm.normals.any(axis=1)
    np.testing.assert_array_equal(has_normal, whole.flatness > 0.4)
    np.testing.assert_array_equal(firm.normals[has_normal], whole.normals[has_normal])
    np.testing.assert_array_equal(firm.points, whole.points)
    assert sorted(firm.samples) == list(range(len(whole.points)))
    assert not has_normal[firm.samples[has_normal.sum() :]].any()


def test_points_are_thinned_and_within_range() -> None:
    points = np.concatenate([street(1), [[0.1, 0, 0], [500, 0, 0], [np.nan, 0, 0]]])
    surface = scan_surface(points, SurfaceConfig(voxel_size_m=1.0, max_range_m=20))
    ranges = np.linalg.norm(surface.points, axis=1)
    assert ((ranges >= 1) & (ranges <= 20)).all()
    voxels = np.floor(surface.points).astype(int)
    assert len(np.unique(voxels, axis=0)) == len(surface.points)
