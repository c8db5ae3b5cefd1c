"""Laws of compact scans: verification by rounded elements finds the same motion, descriptors change by a rounding."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from dpmjax.deeppointmap import init_model, model_preset
from dpmjax.deeppointmap.compact_scans import (
    compact_elements,
    compact_image,
    compact_scan,
    expand_elements,
    expand_image,
    expand_scan,
    round_directions,
    round_features,
)
from dpmjax.deeppointmap.encoding import pyramid_of_scan
from dpmjax.deeppointmap.model import model_fingerprint
from dpmjax.geometry import rigid
from dpmjax.geometry.normals import pyramid_elements
from dpmjax.scan.lidar.choose import choose_motion, refine_motion
from dpmjax.scan.lidar.compare import VerificationConfig
from dpmjax.scan.lidar.record import measure_scan
from dpmjax.scan.lidar.surfaces import Surface, SurfaceConfig, range_image, scan_surface, surface_of_elements
from dpmjax.types import DescriptorCloud, SurfaceElements
from tests.scan.surface_scenes import motion, seen_from, street

CONFIG = VerificationConfig(plane_radius_m=2.0)
"""Elements are metres apart."""

T_WORLD_A, T_WORLD_B = motion(5, (1, -2, 0), 1), motion(130, (-4, 3, 0))
T_TRUE = rigid.inverse(T_WORLD_B) @ T_WORLD_A
NUM_ELEMENTS, NUM_DESCRIPTORS = 1536, 16


def cloud_of(points: np.ndarray, seed: int = 0) -> DescriptorCloud:
    """Elements of a scan, of which the first have random descriptors."""
    config, rng = model_preset("small"), np.random.default_rng(seed)
    elements = jax.device_get(pyramid_elements(pyramid_of_scan(points, config), NUM_ELEMENTS))
    angles = rng.uniform(-np.pi, np.pi, NUM_DESCRIPTORS)
    return DescriptorCloud(
        elements.positions * config.scale_m,
        (rng.normal(size=(NUM_DESCRIPTORS, 8)) * rng.uniform(0.01, 100, (NUM_DESCRIPTORS, 1))).astype(np.float32),
        elements.mask,
        np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
        elements.normals,
        elements.planarity,
    )


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    return [seen_from(street(seed, 24_000), T) for seed, T in enumerate((T_WORLD_A, T_WORLD_B))]


@pytest.mark.slow
def test_compact_scans_find_the_same_motion(scans) -> None:
    images = [measure_scan(scan).image for scan in scans]
    compact = [compact_scan(cloud_of(scan), image) for scan, image in zip(scans, images, strict=True)]
    found = [expand_scan(one) for one in compact]
    hypotheses = np.stack([motion(200, (3, 0, 0)), T_TRUE @ motion(3, (1.0, -0.8, 0.1))])
    chosen = choose_motion(*found, hypotheses, CONFIG)
    T = refine_motion(*found, chosen, CONFIG).T_target_source
    assert chosen.row == 1
    assert np.linalg.norm((rigid.inverse(T_TRUE) @ T)[:3, 3]) < 0.03
    assert chosen.verification.gap > 0.2


def test_a_compact_scan_is_the_cloud_within_rounding(scans) -> None:
    cloud, image = cloud_of(scans[0]), measure_scan(scans[0]).image
    compact = compact_scan(cloud, image)
    found = compact.cloud
    np.testing.assert_array_equal(found.mask, cloud.mask)
    # Each descriptor has a step of its own: large ones take nothing from small ones.
    largest = np.abs(cloud.features).max(axis=1, keepdims=True)
    assert np.abs((found.features - cloud.features) / largest).max() <= 0.501 / 127
    cosines = np.sum(found.directions * cloud.directions, axis=1)
    assert cosines.min() > np.cos(np.radians(0.5 * 180 / 127 + 0.01))
    # The scan that registration reads is made of the same elements.
    surface, expected = expand_scan(compact).surface, surface_of_elements(found.elements)
    for name in ("points", "normals", "flatness", "samples"):
        np.testing.assert_array_equal(getattr(surface, name), getattr(expected, name))


def test_features_that_are_zero_stay_so_and_rounding_twice_changes_nothing() -> None:
    features = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    features[2] = 0
    codes, steps = round_features(features)
    assert not codes[2].any()
    assert (steps > 0).all()
    assert (np.abs(codes).max(axis=1)[[0, 1, 3, 4]] == 127).all()
    again, _ = round_features(codes * steps[:, None])
    np.testing.assert_array_equal(again, codes)
    assert round_features(np.zeros((0, 4), np.float32))[0].shape == (0, 4)


def test_directions_turn_round_without_a_break() -> None:
    angles = np.linspace(-np.pi, np.pi, 1001)
    codes = round_directions(np.stack([np.cos(angles), np.sin(angles)], axis=-1))
    turned = (codes * (np.pi / 127) - angles + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turned).max() < 0.51 * np.pi / 127


@pytest.mark.slow
def test_the_fingerprint_is_that_of_the_parameters_without_the_overlap_head() -> None:
    first, other = (init_model(jax.random.key(seed), model_preset("tiny")) for seed in (0, 1))
    assert model_fingerprint(first) == model_fingerprint(jax.device_get(first)) != model_fingerprint(other)
    decoder = {**first.params["decoder"], "overlap_head": other.params["decoder"]["overlap_head"]}
    assert model_fingerprint(first.replace(params={**first.params, "decoder": decoder})) == model_fingerprint(first)


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
