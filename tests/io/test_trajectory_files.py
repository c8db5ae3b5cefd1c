"""Laws of trajectory files; evo is the oracle that reads them, where it is installed."""

import os

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import io
from dpmjax.io.poses import planar_to_homogeneous, read_stamped_poses
from dpmjax.sequences import homogeneous
from tests.optional import import_or_skip

POSES = np.column_stack([np.random.default_rng(0).uniform(-500, 500, (9, 2)), np.linspace(-3.1, 3.1, 9)])
WRITTEN = 1e-6  # The files keep nine digits.
WRITERS = {"tum.txt": io.write_tum, "kitti.txt": io.write_kitti, "poses.npy": io.write_poses_npy}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("is_spatial", [False, True])
def test_poses_survive_writing(tmp_path, name, is_spatial):
    path = WRITERS[name](tmp_path / "sub" / name, planar_to_homogeneous(POSES) if is_spatial else POSES)
    np.testing.assert_allclose(io.read_planar_poses(path, 9, "m"), POSES, atol=WRITTEN)
    np.testing.assert_allclose(io.read_poses(path), planar_to_homogeneous(POSES), atol=WRITTEN)
    assert [file.name for file in path.parent.iterdir()] == [name]


def test_evo_reads_what_we_write(tmp_path):
    file_interface = import_or_skip("evo.tools.file_interface")
    times = np.linspace(1.25, 9, 9)
    tum = file_interface.read_tum_trajectory_file(str(io.write_tum(tmp_path / "t.txt", POSES, times=times)))
    kitti = file_interface.read_kitti_poses_file(str(io.write_kitti(tmp_path / "k.txt", POSES)))
    np.testing.assert_allclose(tum.timestamps, times, atol=1e-6)
    for trajectory in (tum, kitti):
        np.testing.assert_allclose(trajectory.poses_se3, planar_to_homogeneous(POSES), atol=WRITTEN)


def test_tum_tells_its_frame_and_keeps_the_digits(tmp_path):
    lines = io.write_tum(tmp_path / "t.txt", POSES, unit="px").read_text().splitlines()
    assert lines[0].startswith("#")
    assert "T_world_scan" in lines[0]
    assert "px" in lines[0]
    assert all(len(word.split(".")[1]) >= 6 for line in lines[1:] for word in line.split())
    with pytest.raises(io.InputError, match="poses in px"):
        io.read_planar_poses(tmp_path / "t.txt", 9, "m")


def test_planar_columns_are_read_with_comments(tmp_path):
    path = tmp_path / "start.txt"
    path.write_text("# x_px y_px theta_rad\n\n1 2 0.5\n3, 4, -0.5\n")
    np.testing.assert_array_equal(io.read_planar_poses(path, 2, "px"), [[1, 2, 0.5], [3, 4, -0.5]])


EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"


@pytest.mark.parametrize("separator", [",", "; ", "\t"])
@pytest.mark.parametrize(
    ("names", "is_w_first", "num_more"),
    [
        (EUROC, True, 0),
        (f"{EUROC}, v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]", True, 9),
        ("timestamp,tx,ty,tz,qw,qx,qy,qz", True, 0),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", False, 0),
        ("\ufeff% time x y z", False, 0),
    ],
)
def test_the_names_of_the_columns_order_the_quaternion(tmp_path, names, is_w_first, num_more, separator):
    turns = Rotation.random(5, rng=np.random.default_rng(0))
    poses = homogeneous(turns.as_matrix(), np.arange(15.0).reshape(5, 3))
    quaternions = np.roll(turns.as_quat(), int(is_w_first), axis=1)
    rows = np.column_stack([np.arange(5), poses[:, :3, 3], quaternions, np.ones((5, num_more))])
    lines = [names, *(separator.join(f"{value:.9f}" for value in row) for row in rows)]
    (tmp_path / "a.txt").write_text("\r\n".join(lines), encoding="utf-8")
    found = read_stamped_poses(tmp_path / "a.txt")
    np.testing.assert_allclose(found.poses, poses, atol=1e-8)
    np.testing.assert_array_equal(found.stamps, np.arange(5))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "no row"),
        ("1 2 3\n", "1 pose for 2 scans"),
        ("1 2 3\n1 2 nan\n", "NaN"),
        ("1 2 3\n1 2\n", "row 2 is not 3 numbers"),
        ("1 2\n1 2\n", "columns"),
        ("1 2 3\n1 2 x\n", "row 2 is not 3 numbers"),
        ("0 1 2 3 0 0 0 2\n1 1 2 3 0 0 0 1\n", "quaternions"),
        ("1 0 0 0 0 0 -1 0 0 1 0 0\n" * 2, "tilted by 90"),
        ("# x_px y_px theta_rad\n1 2 3\n1 2 3\n", "poses in px"),
    ],
)
def test_bad_start_is_told_in_one_line(tmp_path, text, found):
    path = tmp_path / "start.txt"
    path.write_text(text)
    with pytest.raises(io.InputError, match=found) as caught:
        io.read_planar_poses(path, 2, "m")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_arrays_are_refused(tmp_path):
    with pytest.raises(io.InputError, match="no such file"):
        io.read_planar_poses(tmp_path / "none.npy", 2, "m")
    np.save(tmp_path / "a.npy", np.ones((2, 5)))
    with pytest.raises(io.InputError, match="rows of 5 columns"):
        io.read_planar_poses(tmp_path / "a.npy", 2, "m")
    (tmp_path / "b.npy").write_bytes(b"cut")
    with pytest.raises(io.InputError, match="NumPy"):
        io.read_planar_poses(tmp_path / "b.npy", 2, "m")


@pytest.mark.parametrize("bad", [np.ones((3, 2)), np.ones((3, 3, 3)), np.full((3, 3), np.nan)])
def test_writers_refuse_what_is_no_trajectory(tmp_path, bad):
    for name, write in WRITERS.items():
        with pytest.raises(ValueError, match="poses must be"):
            write(tmp_path / name, bad)
    assert list(tmp_path.iterdir()) == []


def test_interrupted_writing_leaves_the_old_file(tmp_path, monkeypatch):
    path = io.write_atomically(tmp_path / "a.txt", "old")

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        io.write_atomically(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_start_of_the_authors_trajectory_is_read(real_data):
    assert io.read_planar_poses(real_data / "deepmapping_2d" / "start_16px.txt", 256, "px").shape == (256, 3)
