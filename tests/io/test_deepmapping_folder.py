"""Laws of PCD files and of the authors' layout."""

import tarfile

import numpy as np
import pytest

from dpmjax.io import InputError
from dpmjax.io.scans2d import read_deepmapping_folder
from tests.data_sets import read_pcd, write_deepmapping_folder, write_pcd

POINTS = np.array([[1, 2, 3], [4, 5, 6], [-7, 8.5, 0]], np.float32)


def pcd(fields="x y z", data="ascii", body=b"1 2 3\n4 5 6\n-7 8.5 0\n", num_points=3, kind="F", size="4"):
    count = len(fields.split())
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {' '.join([size] * count)}\nTYPE {' '.join([kind] * count)}\n"
        f"COUNT {' '.join(['1'] * count)}\nWIDTH {num_points}\nHEIGHT 1\nPOINTS {num_points}\nDATA {data}\n"
    )
    return header.encode() + body


@pytest.mark.parametrize(
    "content",
    [
        pcd(),
        pcd(data="binary", body=POINTS.tobytes()),
        pcd("z intensity y x", body=b"3 0 2 1\n6 0 5 4\n0 0 8.5 -7\n"),
        pcd("z y x", "binary", POINTS[:, ::-1].tobytes()),
        pcd(data="binary", body=POINTS.astype("<f8").tobytes(), size="8"),
    ],
)
def test_points_are_read_whatever_the_encoding_and_order(tmp_path, content):
    path = tmp_path / "a.pcd"
    path.write_bytes(content)
    np.testing.assert_array_equal(read_pcd(path), POINTS)


def test_missing_z_is_zero(tmp_path):
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd("x y", body=b"1 2\n3 4\n5 6\n"))
    np.testing.assert_array_equal(read_pcd(path), [[1, 2, 0], [3, 4, 0], [5, 6, 0]])


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "no PCD header"),
        (b"hello\nworld\n", "no PCD header"),
        (pcd(data="binary", body=POINTS.tobytes()[:-5]), "truncated"),
        (pcd(body=b"1 2 3\n"), "truncated"),
        (pcd(body=b"1 2 3\n4 5\n6 7 8\n"), "line 12 has 2 columns"),
        (pcd(body=b"1 2 3\n4 x 5\n6 7 8\n"), "line 12, column 2: 'x' is not a number"),
        (pcd("x z w"), "column y"),
        (pcd(data="packed"), "not supported"),
        (pcd(data="binary_compressed"), "truncated"),
        (pcd(num_points=-1), "broken PCD header"),
        (pcd(kind="Q"), "broken PCD header"),
    ],
)
def test_bad_file_is_told_in_one_line_with_its_name(tmp_path, content, found):
    path = tmp_path / "bad.pcd"
    path.write_bytes(content)
    with pytest.raises(InputError, match=found) as caught:
        read_pcd(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_pcd_survives_writing(tmp_path):
    np.testing.assert_array_equal(read_pcd(write_pcd(tmp_path / "a.pcd", POINTS)), POINTS)
    np.testing.assert_array_equal(read_pcd(write_pcd(tmp_path / "b.pcd", POINTS[:, :2]))[:, :2], POINTS[:, :2])
    assert read_pcd(write_pcd(tmp_path / "empty.pcd", np.zeros((0, 3)))).shape == (0, 3)


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
        ({"other": 1.0}, "other"),
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


def test_our_pcd_header_is_the_authors(real_data, tmp_path):
    with tarfile.open(real_data / "deepmapping_2d" / "v1_pose0.tar") as archive:
        theirs = archive.extractfile("v1_pose0/000.pcd").read()
    (tmp_path / "theirs.pcd").write_bytes(theirs)
    assert write_pcd(tmp_path / "ours.pcd", read_pcd(tmp_path / "theirs.pcd")).read_bytes() == theirs
