"""Tiny drives in each layout, and the real ones."""

import gzip
import logging
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dpmjax import io
from dpmjax.geometry import rigid
from dpmjax.io import InputError, list_lidar_sequences, open_lidar_sequence, read_lidar_file, write_ply
from dpmjax.io.poses import interpolate_poses
from tests.data_sets import readable_scans, write_pcd
from tests.io.drives import AXES, WRITERS, rows_of, write_bin, write_kitti_360, write_kitti_odometry, write_kitti_raw
from tests.io.test_pcd import header as pcd_header


@pytest.fixture
def clouds():
    rng = np.random.default_rng(0)
    return [rng.normal(size=(20 + i, 3)).astype(np.float32) * [10, 10, 1] for i in range(12)]


@pytest.fixture
def poses():
    rng = np.random.default_rng(1)
    found = np.tile(np.eye(4), (12, 1, 1))
    found[1:, :3, :3] = Rotation.from_euler("zyx", rng.uniform(-0.5, 0.5, (11, 3))).as_matrix()
    found[1:, :3, 3] = np.cumsum(rng.uniform(0, 2, (11, 3)), axis=0)
    return found


def assert_same(sequence, clouds, poses):
    assert len(sequence) == len(clouds)
    for index, cloud in enumerate(clouds):
        np.testing.assert_allclose(sequence.read_scan(index), cloud, rtol=1e-6)
    if poses is None:
        assert sequence.T_world_lidar is None
    else:
        np.testing.assert_allclose(sequence.T_world_lidar, poses, atol=1e-6)


def test_semantic_kitti_prefers_the_poses_beside_the_scans(tmp_path, clouds, poses):
    folder = write_kitti_odometry(tmp_path, clouds, np.tile(np.eye(4), (12, 1, 1)))
    (folder / "poses.txt").write_text(rows_of(AXES @ poses @ rigid.inverse(AXES)))
    assert_same(open_lidar_sequence(tmp_path, sequence="00"), clouds, poses)


def test_poses_without_their_calibration_are_refused(tmp_path, clouds, poses):
    drive = write_kitti_raw(tmp_path / "raw", clouds[:3], poses[:3])
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(InputError, match=r"calib_imu_to_velo"):
        open_lidar_sequence(drive)
    folder = write_kitti_odometry(tmp_path, clouds, poses)
    (folder / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(InputError, match=r"calib.txt.*Tr"):
        open_lidar_sequence(folder)
    (folder / "calib.txt").unlink()
    with pytest.raises(InputError, match=r"calib.txt"):
        open_lidar_sequence(folder)


def test_a_part_of_a_sequence_takes_its_poses_by_number(tmp_path, clouds, poses):
    folder = write_kitti_odometry(tmp_path, clouds, poses)
    for index in (0, 1, 5):
        (folder / "velodyne" / f"{index:06d}.bin").unlink()
    kept = [2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert_same(open_lidar_sequence(folder), [clouds[i] for i in kept], poses[kept])


def test_roots_with_several_drives_ask_which(tmp_path, clouds, poses):
    write_kitti_odometry(tmp_path, clouds, poses, "00")
    write_kitti_odometry(tmp_path, clouds, poses, "10")
    assert list_lidar_sequences(tmp_path) == ["00", "10"]
    with pytest.raises(InputError, match=r"2 sequences: 00, 10"):
        open_lidar_sequence(tmp_path)
    with pytest.raises(InputError, match=r"no sequence 07"):
        open_lidar_sequence(tmp_path, sequence="07")


@pytest.mark.parametrize("layout", WRITERS)
def test_drives_of_each_layout_have_their_scans_and_poses(tmp_path, clouds, poses, layout):
    if layout == "raw":
        poses = np.tile(np.eye(4), (12, 1, 1))
        poses[:, 1, 3] = -10.0 * np.arange(12)  # eastwards
    folder = WRITERS[layout](tmp_path, clouds, poses)
    sequence = open_lidar_sequence(folder)
    assert_same(sequence, clouds, rigid.inverse(poses[0]) @ poses if layout == "360" else poses)
    step_s = {"kitti": 0.1, "raw": 1.0, "mulran": 0.1}.get(layout)
    if step_s is not None:
        np.testing.assert_allclose(sequence.times, step_s * np.arange(12), atol=1e-6)
    name, inner = {"kitti": ("00", [""]), "carla": ("Town01", ["Town01", "Town01/generated"])}.get(layout, ("", []))
    for part in inner:
        assert open_lidar_sequence(tmp_path / part).name == sequence.name == name


def test_scans_of_kitti_360_that_stand_still_are_interpolated(tmp_path, clouds, poses):
    write_kitti_360(tmp_path, clouds[:5], poses[:5])
    (path,) = tmp_path.glob("data_poses/*/poses.txt")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[i] for i in (1, 2, 4)))
    sequence = open_lidar_sequence(tmp_path)
    middle = interpolate_poses(np.array([2.0, 4.0]), poses[[2, 4]], np.array([3.0]))
    wanted = np.stack([poses[1], poses[2], middle[0], poses[4]])
    np.testing.assert_array_equal(sequence.has_reference, [False, True, True, True, True])
    assert any(note.is_doubt and "1 of 5 scans have no reference pose" in note.text for note in sequence.notes)
    np.testing.assert_allclose(sequence[0], clouds[0], rtol=1e-6)
    assert_same(sequence.take(sequence.has_reference), clouds[1:5], rigid.inverse(wanted[0]) @ wanted)


FORMATS = {
    ".bin": write_bin,
    ".npy": np.save,
    ".npz": lambda path, points: np.savez(path, points=points),
    ".pcd": write_pcd,
    ".ply": write_ply,
}


@pytest.mark.parametrize("suffix", FORMATS)
def test_plain_folders_in_natural_order(tmp_path, clouds, poses, suffix):
    for index, cloud in enumerate(clouds):
        FORMATS[suffix](tmp_path / f"scan_{index}{suffix}", cloud)
    (tmp_path / "notes.md").write_text("hello")
    assert_same(open_lidar_sequence(tmp_path), clouds, None)
    (tmp_path / "poses.txt").write_text(rows_of(poses))
    assert_same(open_lidar_sequence(tmp_path), clouds, poses)


def test_a_pose_file_can_be_named(tmp_path, clouds, poses):
    for index, cloud in enumerate(clouds):
        write_bin(tmp_path / "data" / f"{index}.bin", cloud)
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    tum = np.column_stack([np.arange(12), poses[:, :3, 3], quaternions])
    np.savetxt(tmp_path / "mine.tum", tum)
    assert_same(open_lidar_sequence(tmp_path, poses=tmp_path / "mine.tum"), clouds, poses)
    np.save(tmp_path / "mine.npy", poses[:5])
    with pytest.raises(InputError, match=r"5 poses for 12 scans|12 scans"):
        open_lidar_sequence(tmp_path / "data", poses=tmp_path / "mine.npy")


def test_sub_ranges_take_poses_and_times_along(tmp_path, clouds, poses):
    folder = write_kitti_odometry(tmp_path, clouds, poses)
    part = open_lidar_sequence(folder, selection=slice(2, 9, 3))
    assert_same(part, clouds[2:9:3], poses[2:9:3])
    np.testing.assert_allclose(part.times, [0.2, 0.5, 0.8])
    with pytest.raises(InputError, match="0 of 12 scans"):
        open_lidar_sequence(folder, selection=slice(20, None))


BAD = {
    "truncated": lambda path, cloud: path.write_bytes(cloud.astype("<f4").tobytes()[:-7]),
    "zero or not finite": lambda path, cloud: write_bin(path, np.full_like(cloud, np.nan)),
    "no point": lambda path, cloud: path.write_bytes(b""),
    "median range": lambda path, cloud: write_bin(path, 1000 * cloud),
    "out of range": lambda path, cloud: write_bin(path, 1e-3 * cloud / np.abs(cloud).max()),
}


@pytest.mark.parametrize("reason", BAD)
def test_one_bad_scan_is_named_and_the_others_are_read(tmp_path, clouds, poses, reason):
    folder = write_kitti_odometry(tmp_path, clouds, poses)
    BAD[reason](folder / "velodyne" / "000004.bin", clouds[4])
    sequence = open_lidar_sequence(folder)
    assert list(readable_scans(sequence)) == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    with pytest.raises(InputError, match=rf"000004\.bin: .*{reason}"):
        sequence.read_scan(4)


@pytest.mark.parametrize(
    "content",
    [np.zeros((5, 2)), np.zeros(7), np.array(["a"]), np.zeros((0, 3)), np.full((4, 3), np.inf), np.ones((3, 900))],
)
def test_wrong_arrays_are_named(tmp_path, content):
    np.save(tmp_path / "0.npy", content)
    with pytest.raises(InputError, match=r"0\.npy"):
        read_lidar_file(tmp_path / "0.npy")


def test_a_scan_in_millimetres_is_warned_of(tmp_path, clouds, caplog):
    for index in range(3):
        write_bin(tmp_path / f"{index}.bin", clouds[index] / np.linalg.norm(clouds[index], axis=1)[:, None] * 300)
    with caplog.at_level(logging.WARNING):
        assert len(readable_scans(open_lidar_sequence(tmp_path))) == 3
    assert caplog.text.count("are these millimetres or centimetres?") == 1
    read_lidar_file(tmp_path / "1.bin")
    assert "1.bin" in caplog.text


def write_timed(folder, kind, points, times):
    """A scan with times, as drivers write them: relative nanoseconds, absolute seconds, an array of its own."""
    if kind == "npz":
        np.savez(folder / "0.npz", points=points, times=times)
    elif kind == "pcd":
        rows = "".join(f"{x} {y} {z} {round(1e9 * t)}\n" for (x, y, z), t in zip(points, times, strict=True))
        head = pcd_header("x y z t", "4 4 4 4", "F F F U", "1 1 1 1", "ascii", len(points)).decode()
        (folder / "0.pcd").write_text(head + rows)
    else:
        names = "".join(f"property double {name}\n" for name in ("x", "y", "z", "timestamp"))
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
        rows = np.column_stack([points, 1.7e9 + times]).astype("<f8").tobytes()
        (folder / "0.ply").write_bytes(header.encode() + rows)


@pytest.mark.parametrize("kind", ["npz", "pcd", "ply"])
def test_times_of_points_are_read_and_belong_to_the_points(tmp_path, clouds, kind):
    points, times = clouds[0].copy(), np.linspace(0.0, 0.1, len(clouds[0]))
    points[[0, 7]] = 0  # beams that met nothing are left out, with their times
    write_timed(tmp_path, kind, points, times)
    sequence = open_lidar_sequence(tmp_path).take(slice(None))
    kept = np.delete(times, [0, 7])
    np.testing.assert_allclose(sequence.read_scan(0), np.delete(points, [0, 7], axis=0), rtol=1e-6)
    found = sequence.read_times(0)
    unit = 1e9 if kind == "pcd" else 1.0
    np.testing.assert_allclose((found - found[0]) / unit, kept - kept[0], atol=1e-6)


def test_files_without_times_say_so(tmp_path, clouds):
    write_bin(tmp_path / "0.bin", clouds[0])
    assert open_lidar_sequence(tmp_path).read_times(0) is None
    np.savez(tmp_path / "bad.npz", points=clouds[0], times=np.zeros(3))
    with pytest.raises(InputError, match=r"bad\.npz: times \(3,\).*one time a point"):
        read_lidar_file(tmp_path / "bad.npz")


def test_folders_without_scans_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"without scans"):
        open_lidar_sequence(tmp_path)
    with pytest.raises(InputError, match=r"no such file or folder"):
        open_lidar_sequence(tmp_path / "nowhere")
    (tmp_path / "0.bin").write_bytes(b"")
    with pytest.raises(InputError, match=r"single file"):
        open_lidar_sequence(tmp_path / "0.bin")


REAL = {"hilti_room": 177, "kitti_00": 4, "kitti_07": 4, "kitti_raw_0013": 144, "mulran_kaist03": 21}


@pytest.mark.parametrize("name", REAL)
def test_real_drives_are_opened(real_data, name):
    sequence = open_lidar_sequence(real_data / "lidar_3d" / name)
    assert len(sequence) == REAL[name]
    assert sequence.T_world_lidar is not None
    assert sequence.times is not None
    points = sequence.read_scan(len(sequence) - 1)
    assert points.dtype == np.float32
    assert len(points) > 3000


def test_a_name_that_is_no_utf_8_keeps_its_bytes(tmp_path):
    name = os.fsdecode(b"stra\xdfe_0.npy")
    assert io.write_atomically(tmp_path / "list.txt", name).read_bytes() == b"stra\xdfe_0.npy"


@pytest.mark.parametrize("separator", [" ", ",", ";"])
@pytest.mark.parametrize("name", ["a.xyz", "a.csv", "a.txt", "a.txt.gz"])
def test_columns_of_text_are_points(tmp_path: Path, separator: str, name: str) -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (50, 4)).round(3)
    header = "" if separator == " " else separator.join(["x", "y", "z", "intensity"])
    np.savetxt(tmp_path / name, points, delimiter=separator, header=header, comments="")
    np.testing.assert_allclose(read_lidar_file(tmp_path / name), points[:, :3], rtol=1e-6)


def test_a_packed_scan_is_that_of_the_plain_file(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-20, 20, (500, 4)).astype(np.float32)
    points.tofile(tmp_path / "a.bin")
    (tmp_path / "a.bin.gz").write_bytes(gzip.compress((tmp_path / "a.bin").read_bytes()))
    np.testing.assert_array_equal(read_lidar_file(tmp_path / "a.bin.gz"), read_lidar_file(tmp_path / "a.bin"))


@pytest.mark.parametrize("suffix", [".pcap", ".osf", ".feather", ".vtk", ".e57"])
def test_a_file_to_convert_names_the_converter(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(b"1")
    with pytest.raises(InputError, match="play|ouster-cli|read_feather|ParaView|PDAL"):
        read_lidar_file(tmp_path / f"a{suffix}")
