"""Features and offsets are relative to the frame of each descriptor, in scans and in maps."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax.deeppointmap import Model, encode_pyramid, init_model, merge_clouds
from dpmjax.deeppointmap.encoding import pyramid_of_scan
from dpmjax.deeppointmap.model import predict_offsets
from dpmjax.geometry.bearing import directions_of, wall_normals
from dpmjax.types import DescriptorCloud
from tests.deeppointmap import toy
from tests.tolerances import ACCUMULATED


@pytest.fixture(scope="module")
def model() -> Model:
    model = init_model(jax.random.key(0), replace(toy.MODEL, encoder=replace(toy.MODEL.encoder, frame="local")))
    # Of so narrow a head, most units are silent; a bias wakes them.
    head = jax.tree.map(lambda leaf: leaf + 0.5, model.params["decoder"]["offset_head"])
    return model.replace(params={**model.params, "decoder": {**model.params["decoder"], "offset_head": head}})


@pytest.fixture(scope="module")
def turn() -> np.ndarray:
    T = np.eye(4, dtype=np.float32)
    T[:3, :3] = Rotation.from_euler("z", 2.2).as_matrix()
    return T


@pytest.fixture(scope="module")
def clouds(model, turn) -> tuple[DescriptorCloud, DescriptorCloud]:
    """Returns descriptors of a scan, and of the same scan after a turn about the vertical."""
    pyramid = pyramid_of_scan(toy.drive().read_scan(3), toy.MODEL)
    levels = tuple(level.replace(positions=level.positions @ turn[:3, :3].T) for level in pyramid.levels)
    return encode_pyramid(model, pyramid), encode_pyramid(model, pyramid.replace(levels=levels))


def offsets(model: Model, cloud: DescriptorCloud, *, in_ray_frame: bool = False) -> np.ndarray:
    """Returns offsets from each descriptor to the one before it; any features serve here."""
    features = jnp.tile(cloud.features, (1, 2))[:, : model.config.decoder.model_channels]
    directions = None if in_ray_frame else directions_of(cloud)
    return np.asarray(predict_offsets(model, features, jnp.roll(features, 1, axis=0), directions))


def test_a_turn_of_the_scan_leaves_offsets_along_the_rays_and_turns_those_of_the_cloud(model, clouds, turn) -> None:
    scan, turned = clouds
    np.testing.assert_allclose(turned.features, scan.features, atol=1e-4)
    along_rays = offsets(model, scan, in_ray_frame=True)
    np.testing.assert_allclose(offsets(model, turned, in_ray_frame=True), along_rays, atol=1e-3)
    expected = offsets(model, scan) @ turn[:3, :3].T
    np.testing.assert_allclose(offsets(model, turned), expected, atol=1e-3)
    assert np.abs(expected - offsets(model, scan)).max() > 0.1


def test_a_map_predicts_the_offsets_of_its_scans(model, clouds, turn) -> None:
    """A scan and its turned copy are one and the same, once both are in the frame of the first."""
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)
    T_map_scan = np.stack([np.eye(4, dtype=np.float32), turn.T])
    merged = merge_clouds(both, T_map_scan)
    half = len(clouds[0].mask)
    for rows in (slice(half), slice(half, None)):
        part = jax.tree.map(lambda leaf, rows=rows: leaf[rows], merged)
        np.testing.assert_allclose(part.positions, clouds[0].positions, atol=1e-4)
        np.testing.assert_allclose(offsets(model, part), offsets(model, clouds[0]), atol=1e-3)


def test_a_wall_has_one_frame_wherever_the_lidar_stands() -> None:
    rng = np.random.default_rng(0)
    along, height = rng.uniform(-1, 1, (2, 40))
    for angle in (0.3, 1.9, -2.5):
        normal, tangent = (np.array([np.cos(angle + turn), np.sin(angle + turn)]) for turn in (0, np.pi / 2))
        wall = np.column_stack([along[:, None] * tangent + 0.01 * rng.normal(size=(40, 1)) * normal, height])
        ground = np.column_stack([rng.uniform(-1, 1, (200, 2)), np.full(200, 0.0)])
        for seen_from in (0.0, 0.7, -1.2):  # angle of the ray to the normal
            ray = -np.array([np.cos(angle + seen_from), np.sin(angle + seen_from)])
            found = np.asarray(wall_normals(np.concatenate([wall, ground]).astype(np.float32), ray.astype(np.float32)))
            np.testing.assert_allclose(found, normal, atol=0.02)


def test_without_a_wall_the_frame_is_that_of_the_ray() -> None:
    angles = np.linspace(0, 2 * np.pi, 13)[:-1]
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.ones(12)]).astype(np.float32)
    ray = np.array([0.6, -0.8], np.float32)
    for offsets_of in (ring, np.zeros((5, 3), np.float32)):
        np.testing.assert_allclose(wall_normals(offsets_of, ray), -ray, atol=1e-4)


def test_in_the_frame_of_the_lidar_nothing_is_turned(model, clouds) -> None:
    published = model.replace(config=replace(model.config, encoder=replace(model.config.encoder, frame="lidar")))
    found = offsets(published, clouds[1])
    np.testing.assert_allclose(found, offsets(published, clouds[1], in_ray_frame=True), **ACCUMULATED)
