"""Laws of saved maps: a loaded map equals the saved one, and any other file is refused in one line."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest

from dpmjax import load_map, save_map
from dpmjax.deeppointmap.compact_scans import CompactScan, compact_scan
from dpmjax.io import InputError
from dpmjax.saved_maps import load_state, map_bytes
from dpmjax.scan.lidar.slide import diagonal_information
from dpmjax.scan.lidar.surfaces import SurfaceConfig, range_image, scan_surface
from dpmjax.slam import SlamConfig
from dpmjax.slam.keyframe_map import (
    Keyframe,
    KeyframeMap,
    MapEdge,
    MapOrigin,
    add_keyframe,
    with_origin,
)
from dpmjax.types import DescriptorCloud
from tests.deeppointmap.test_compact import room
from tests.saved_maps.comparison import assert_damage_is_refused, assert_same
from tests.slam.truth import noise

NUM_DESCRIPTORS, NUM_ELEMENTS, CHANNELS = 24, 60, 16


def scan(seed: int, num_elements: int = NUM_ELEMENTS) -> CompactScan:
    rng = np.random.default_rng(seed)
    surface = scan_surface(room(3000, seed), SurfaceConfig(voxel_size_m=0.15))
    rows = rng.permutation(len(surface.points))[:num_elements]
    # Features as networks make them: few components carry nearly all.
    features = rng.normal(size=(NUM_DESCRIPTORS, 4)) @ np.random.default_rng(7).normal(size=(4, CHANNELS))
    features += 0.01 * rng.normal(size=features.shape)
    angles = rng.uniform(-np.pi, np.pi, NUM_DESCRIPTORS)
    cloud = DescriptorCloud(
        surface.points[rows].astype(np.float32),
        features.astype(np.float32),
        rng.random(num_elements) > 0.2,
        np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
        surface.normals[rows].astype(np.float32),
        np.where(rng.random(num_elements) > 0.1, surface.flatness[rows], 0).astype(np.float32),
    )
    return compact_scan(cloud, range_image(surface.points if seed != 2 else np.zeros((0, 3))))


def make_map(num_keyframes: int = 4) -> KeyframeMap:
    config = replace(SlamConfig(), loops=replace(SlamConfig().loops, min_probability=0.6))
    slam_map = with_origin(KeyframeMap(), MapOrigin("0123456789abcdef", config, "dpm_small"))
    rng = np.random.default_rng(1)
    for row in range(num_keyframes):
        T = noise(rng, 100.0, 1.0)
        keyframe = Keyframe(3 * row, noise(rng, 9.0, 1.0), 1.1 * row, row // 2, 7.3, scan(row))
        information = diagonal_information(0.1, 0.3) + 0.1
        edge = MapEdge(row, row - 1, noise(rng, 3.0, 0.2), information, ("odometry", "loop", "guess")[row % 3])
        slam_map = add_keyframe(slam_map, keyframe, T, rng.normal(size=8), edge if row else None)
    return slam_map


MAP = make_map()


def test_full_precision_is_exact(tmp_path) -> None:
    path = save_map(tmp_path / "deeper" / "map.npz", MAP)
    assert_same(load_map(path), MAP)


def test_int8_has_small_errors(tmp_path) -> None:
    found = load_map(save_map(tmp_path / "map.npz", MAP, "int8"))
    np.testing.assert_allclose(found.T_world_keyframe, MAP.T_world_keyframe, atol=1e-4)
    np.testing.assert_allclose(found.vectors, MAP.vectors, atol=0.6 / 127)
    for keyframe, expected in zip(found.keyframes, MAP.keyframes, strict=True):
        ours, theirs = keyframe.compact.cloud, expected.compact.cloud
        np.testing.assert_array_equal(ours.mask, theirs.mask)
        np.testing.assert_allclose(ours.positions, theirs.positions, atol=0.011)
        np.testing.assert_array_equal(ours.directions, theirs.directions)
        spread = theirs.features.std()
        np.testing.assert_allclose(ours.features, theirs.features, atol=1.5 * spread)
        assert np.sqrt(np.mean((ours.features - theirs.features) ** 2)) < 0.3 * spread
        np.testing.assert_allclose(ours.planarity, theirs.planarity, atol=0.04)
        is_plane = theirs.mask & (theirs.planarity > 0.04)
        cosines = np.abs(np.sum(ours.normals * theirs.normals, axis=1))
        assert cosines[is_plane].min() > np.cos(np.radians(2.0))
        ours, theirs = keyframe.compact.image, expected.compact.image
        assert ours[:2] == theirs[:2]
        # Free space never grows.
        assert set(np.unique(theirs.nearest.astype(int) - ours.nearest)) <= {0, 1}
        assert set(np.unique(ours.farthest.astype(int) - theirs.farthest)) <= {0, 1}


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_what_was_loaded_is_saved_again_without_further_error(tmp_path, precision) -> None:
    once = load_map(save_map(tmp_path / "map.npz", MAP, precision))
    twice = load_map(save_map(tmp_path / "map.npz", once, precision))
    for keyframe, expected in zip(twice.keyframes, once.keyframes, strict=True):
        for name in ("positions", "planarity", "mask"):
            ours, theirs = (getattr(one.compact.elements, name) for one in (keyframe, expected))
            np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_allclose(twice.T_world_keyframe, once.T_world_keyframe, atol=1e-6)


def test_int8_leaves_out_keyframes_that_others_cover(tmp_path) -> None:
    apart = MAP.T_world_keyframe.copy()
    apart[:, :3, 3] = [[0, 0, 0], [3, 0, 0], [8, 0, 0], [9, 0, 0]]  # the extent is 7.3 m
    joined = replace(MAP, T_world_keyframe=apart, edges=tuple(edge._replace(kind="odometry") for edge in MAP.edges))
    path = tmp_path / "map.npz"
    scans = [keyframe.scan for keyframe in load_map(save_map(path, joined, "int8")).keyframes]
    assert scans == [keyframe.scan for keyframe in MAP.keyframes[:3]]
    assert len(load_map(save_map(path, joined))) == 4
    # The counted bytes are those of the file.
    assert len(map_bytes(joined, "int8")) == save_map(path, joined, "int8").stat().st_size


def with_compact(slam_map: KeyframeMap, compact: CompactScan) -> KeyframeMap:
    """Replaces the first scan."""
    return replace(slam_map, keyframes=(slam_map.keyframes[0]._replace(compact=compact), *slam_map.keyframes[1:]))


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_keyframes_may_have_different_numbers_of_elements(tmp_path, precision) -> None:
    """As in a map of exact keyframes that extends one of fewer elements; the first are those with descriptors."""
    fewer = with_compact(MAP, scan(0, NUM_DESCRIPTORS + 5))
    found = load_map(save_map(tmp_path / "map.npz", fewer, precision))
    elements, expected = (one.keyframes[0].compact.elements for one in (found, fewer))
    assert len(elements.mask) == NUM_ELEMENTS
    assert not elements.mask[NUM_DESCRIPTORS + 5 :].any()
    np.testing.assert_array_equal(elements.mask[: NUM_DESCRIPTORS + 5], expected.mask)
    clouds = [one.keyframes[0].compact.cloud for one in (found, fewer)]
    np.testing.assert_allclose(clouds[0].positions[: NUM_DESCRIPTORS + 5], clouds[1].positions, atol=0.011)


def test_wrong_arguments_are_refused(as_user, tmp_path) -> None:
    with pytest.raises(ValueError, match="path: expected a file that ends in .npz"):
        save_map(tmp_path / "map.bin", MAP)
    with pytest.raises(ValueError, match="precision: expected one of float32"):
        save_map(tmp_path / "map.npz", MAP, "int4")
    with pytest.raises(ValueError, match="got an empty map"):
        save_map(tmp_path / "map.npz", KeyframeMap())
    assert not list(tmp_path.iterdir())


def changed(arrays: dict, **changes) -> dict:
    return {name: array for name, array in {**arrays, **changes}.items() if array is not None}


def header(arrays: dict, **changes) -> np.ndarray:
    return np.frombuffer(json.dumps({**json.loads(arrays["header"].tobytes()), **changes}).encode(), np.uint8)


BROKEN = {
    "no map": lambda a: {"points": np.zeros(3)},
    "version 2, this dpmjax reads 3; map the drive again": lambda a: changed(a, header=header(a, version=2)),
    "version 4, this dpmjax reads 3; update dpmjax": lambda a: changed(a, header=header(a, version=4)),
    "not a dpmjax map": lambda a: changed(a, header=header(a, format="other")),
    "precision int4": lambda a: changed(a, header=header(a, precision="int4")),
    "expected an object": lambda a: changed(a, header=header(a, config={"loops": 1})),
    "header cannot be read": lambda a: changed(a, header=a["header"][:-5]),
    "feature_steps holds": lambda a: changed(a, feature_steps=a["feature_steps"] * np.nan),
    "T_world_keyframe holds": lambda a: changed(a, T_world_keyframe=a["T_world_keyframe"] * np.inf),
    "scan is missing": lambda a: changed(a, scan=None),
    "with 5 descriptors or more": lambda a: changed(
        a, directions=np.zeros((4, 5), np.int8), element_mask=a["element_mask"][:, :4]
    ),
    "feature_steps: expected shape": lambda a: changed(a, directions=a["directions"][:, :5]),
    "element_positions: expected shape": lambda a: changed(a, element_positions=a["element_positions"][:, :5]),
    "element_unit_m: expected shape": lambda a: changed(a, element_unit_m=a["element_unit_m"][:3]),
    "element_mask: expected shape": lambda a: changed(a, element_mask=a["element_mask"].astype(np.int8)),
    "expected rotations": lambda a: changed(a, T_world_keyframe=2 * a["T_world_keyframe"]),
    "expected rows of 4 keyframes": lambda a: changed(a, edge_rows=a["edge_rows"] + 9),
    "image_nearest: expected shape": lambda a: changed(a, image_count=a["image_count"] + 1),
    "image_first_row": lambda a: changed(a, image_first_row=a["image_first_row"] - 900),
    "expected rows of 0 keyframes": lambda a: changed(
        a, directions=a["directions"][:0], element_mask=a["element_mask"][:0]
    ),
    "holds values": lambda a: changed(a, scan=np.array(["a"] * 4)),
}


@pytest.mark.parametrize("found", BROKEN)
def test_foreign_and_broken_files_are_refused(as_user, tmp_path, found) -> None:
    with np.load(io.BytesIO(map_bytes(MAP))) as archive:
        arrays = dict(archive)
    path = tmp_path / "map.npz"
    np.savez(path, **BROKEN[found](arrays))
    expected = "not one of a dpmjax map" if found == "no map" else found
    with pytest.raises(InputError, match=expected) as error:
        load_map(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("load", [load_map, load_state])
@pytest.mark.parametrize(
    ("content", "found"),
    [
        (None, "no such file"),
        (b"", "an empty file of 0 bytes"),
        (b"a map\n", "not a readable NumPy file"),
        (b"PK\3\4", "not a readable NumPy file"),
    ],
)
def test_files_that_are_none_are_refused_in_one_line(as_user, tmp_path, load, content, found) -> None:
    path = tmp_path / "map.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=found) as error:
        load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("precision", ["float32", "int8"])
def test_flipped_and_cut_files_load_equal_or_are_refused(tmp_path, precision) -> None:
    assert_damage_is_refused(tmp_path / "map.npz", map_bytes(make_map(2), precision), load_map, 100)
