"""Laws of the DeepMapping authors' layout."""

import tarfile

import numpy as np
import pytest

from dpmjax.io import InputError
from dpmjax.io.scans2d import read_deepmapping_folder
from tests.data_sets import read_pcd, write_deepmapping_folder, write_pcd


def assert_same_scans(a, b):
    np.testing.assert_allclose(a.points, b.points, rtol=1e-6)
    np.testing.assert_array_equal(a.mask, b.mask)
    np.testing.assert_array_equal(a.reference_poses, b.reference_poses)


def test_sequence_survives_the_authors_layout(tmp_path, small):
    folder = write_deepmapping_folder(tmp_path / "run", small)
    assert sorted(file.name for file in folder.iterdir()) == ["000.pcd", "001.pcd", "002.pcd", "gt_pose.mat"]
    again = read_deepmapping_folder(folder)
    assert_same_scans(again, small)
    assert again.unit == "px"
    assert again.is_organised
    stored = read_pcd(folder / "000.pcd")
    np.testing.assert_allclose(stored[:, :2] * 512, small.points[0], rtol=1e-6)


@pytest.mark.parametrize("mode", ["w", "w:gz"])
def test_archive_reads_like_its_folder(tmp_path, small, mode):
    folder = write_deepmapping_folder(tmp_path / "run", small)
    with tarfile.open(tmp_path / "run.tar", mode) as archive:
        archive.add(folder, "run")
    assert_same_scans(read_deepmapping_folder(tmp_path / "run.tar"), small)


def test_names_are_in_natural_order_and_ragged_scans_are_masked(tmp_path):
    for index in (10, 2, 1):
        write_pcd(tmp_path / f"scan_{index}.pcd", np.full((index, 2), index / 10))
    sequence = read_deepmapping_folder(tmp_path, unit="m")
    np.testing.assert_array_equal(sequence.mask.sum(axis=1), [1, 2, 10])
    np.testing.assert_allclose(sequence.points[:, 0, 0], [0.1, 0.2, 1.0])
    assert sequence.reference_poses is None
    assert not sequence.is_organised


def test_coordinates_too_large_for_the_authors_unit_are_refused_unless_a_unit_is_named(tmp_path):
    for index in range(2):
        write_pcd(tmp_path / f"{index}.pcd", np.full((4, 2), 20.0))
    with pytest.raises(InputError, match="unit m"):
        read_deepmapping_folder(tmp_path)
    assert read_deepmapping_folder(tmp_path, unit="m").points.max() == 20


def test_bad_folders_and_archives_are_refused(tmp_path, small):
    from scipy.io import savemat

    with pytest.raises(InputError, match=r"no \.pcd file"):
        read_deepmapping_folder(tmp_path)
    (tmp_path / "cut.tar").write_bytes(b"x" * 700)
    with pytest.raises(InputError, match=r"cut\.tar.*archive"):
        read_deepmapping_folder(tmp_path / "cut.tar")
    folder = write_deepmapping_folder(tmp_path / "run", small)
    for variables, found in (
        ({"pose": np.zeros((2, 3))}, "for 3 scans"),
        ({"other": 1.0}, "pose"),
        ({"pose": np.full((3, 3), np.nan)}, "NaN"),
    ):
        savemat(folder / "gt_pose.mat", variables)
        with pytest.raises(InputError, match=found):
            read_deepmapping_folder(folder)
    (folder / "gt_pose.mat").write_bytes(b"no matlab")
    with pytest.raises(InputError, match=r"gt_pose\.mat"):
        read_deepmapping_folder(folder)


def test_authors_trajectory_reads_as_they_describe_it(real_data):
    sequence = read_deepmapping_folder(real_data / "deepmapping_2d" / "v1_pose0.tar")
    assert sequence.points.shape == (256, 256, 2)
    assert sequence.mask.all()
    assert sequence.is_organised
    # At the reference poses the points lie on the edges of pixels.
    x, y, heading = sequence.reference_poses.T[..., None]
    world_x = np.cos(heading) * sequence.points[..., 0] - np.sin(heading) * sequence.points[..., 1] + x
    world_y = np.sin(heading) * sequence.points[..., 0] + np.cos(heading) * sequence.points[..., 1] + y
    off_edge = np.minimum(np.abs(world_x - np.round(world_x)), np.abs(world_y - np.round(world_y)))
    assert (off_edge < 2e-3).mean() > 0.99
