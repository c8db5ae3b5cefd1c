"""A pipeline gives the same for a file or folder as for the arrays in it, and names a bad one in a line."""

from pathlib import Path

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.slam import SlamConfig, SlamMethods
from tests.deeppointmap import toy
from tests.slam.truth import TruthGeometry, TruthMatcher, pose, scans_of

NUM_SCANS = 12
POSES = np.array([pose(2.0 * number, 0.0, 0.0) for number in range(NUM_SCANS + 1)])
METHODS = SlamMethods(TruthMatcher(POSES, gross_share=0.0), TruthGeometry(POSES), SlamConfig())
DRIVE = scans_of(range(1, NUM_SCANS + 1))


def assert_equal(found, expected) -> None:
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    (folder / "drive").mkdir()
    for number, scan in enumerate(DRIVE):
        np.save(folder / "drive" / f"{number:03}.npy", scan)
    for name, scan in zip("ab", toy.drive(num_scans=2), strict=True):
        np.save(folder / f"{name}.npy", scan)
    dpmjax.save_map(folder / "map.npz", dpmjax.run_slam(METHODS, DRIVE).map)
    return folder


def test_scans_of_the_network_may_be_files(folder, model) -> None:
    a, b = toy.drive(num_scans=2)
    files = str(folder / "a.npy"), folder / "b.npy"
    assert_equal(dpmjax.encode(model, files[0]), dpmjax.encode(model, a))
    assert_equal(dpmjax.encode_scans(model, files), dpmjax.encode_scans(model, [a, b]))
    assert_equal(dpmjax.overlap(model, *files), dpmjax.overlap(model, a, b))
    assert_equal(dpmjax.register(model, *files), dpmjax.register(model, a, b))


def test_a_drive_and_a_map_may_be_paths(folder) -> None:
    expected = dpmjax.run_slam(METHODS, DRIVE)
    files = sorted((folder / "drive").iterdir())
    for drive in (folder / "drive", str(folder / "drive"), files):
        assert_equal(dpmjax.run_slam(METHODS, drive).T_world_scan, expected.T_world_scan)
    extended = dpmjax.run_slam(METHODS, DRIVE, slam_map=folder / "map.npz")
    assert len(extended.map) > len(expected.map)
    assert dpmjax.merge_maps(METHODS, str(folder / "map.npz"), folder / "map.npz").is_joined
    assert dpmjax.run_agents(METHODS, [folder / "drive"] * 2).T_world_scan[1].shape == (NUM_SCANS, 4, 4)
    found = dpmjax.localize(METHODS, folder / "map.npz", files[5])
    again = dpmjax.localize(METHODS, expected.map, DRIVE[5])
    assert_equal(found.T_world_scan, again.T_world_scan)


def test_planar_scans_may_be_a_file_or_its_sequence(tmp_path) -> None:
    points = np.random.default_rng(0).uniform(1.0, 5.0, (3, 20, 2)).astype(np.float32)
    np.savez(tmp_path / "log.npz", points=points)
    expected = dpmjax.checks.as_beams("scans", points)
    for scans in (tmp_path / "log.npz", str(tmp_path / "log.npz"), dpmjax.io.read_sequence(tmp_path / "log.npz")):
        assert_equal(dpmjax.checks.as_beams("scans", scans), expected)


def test_drives_give_numpy_and_pairs_give_jax(model) -> None:
    a, b = toy.drive(num_scans=2)
    pairs = dpmjax.encode(model, a).features, dpmjax.register(model, a, b).T_target_source, dpmjax.overlap(model, a, b)
    assert {(type(array).__module__.partition(".")[0], str(array.dtype)) for array in pairs} == {("jaxlib", "float32")}
    poses = dpmjax.run_slam(METHODS, DRIVE).T_world_scan
    assert (type(poses), poses.dtype) == (np.ndarray, np.float64)


@pytest.mark.parametrize(
    "call",
    [
        lambda path: dpmjax.encode(dpmjax.Model({}, toy.MODEL), path),
        lambda path: dpmjax.run_slam(METHODS, path),
        lambda path: dpmjax.localize(METHODS, path, DRIVE[0]),
        lambda path: dpmjax.register_scans(path, key=jax.random.key(0)),
        lambda path: dpmjax.register_depth(path, key=jax.random.key(0)),
    ],
)
def test_a_path_that_is_not_there_is_named_in_one_line(call) -> None:
    with pytest.raises(dpmjax.io.InputError, match=r"^nowhere[^\n]*: no such (file|folder)[^\n]*$"):
        call("nowhere.npz")
