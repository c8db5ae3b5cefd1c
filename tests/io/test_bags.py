"""Bags of ROS: clouds of all drivers, planar scans with odometry, topics, and refusals."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from dpmjax.geometry import se2
from dpmjax.io import InputError, open_lidar_sequence, read_sequence, write_tum
from tests.io.bag_files import EPOCH_NS, KINDS, LAYOUTS, TIMES, BagWriter

STEP_NS, NUM = 100_000_000, 6


@pytest.fixture
def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.uniform(-20, 20, (120, 3)).astype(np.float32) for _ in range(NUM)]


def write_clouds(path: Path, kind: str, clouds: list[np.ndarray], **options) -> Path:
    with BagWriter(path, kind) as bag:
        for index, points in enumerate(clouds):
            bag.write_cloud(points, EPOCH_NS + index * STEP_NS, **options)
    return bag.path


@pytest.mark.parametrize("kind", KINDS)
def test_clouds_are_read_in_the_order_and_at_the_times_of_their_headers(tmp_path: Path, kind: str, clouds) -> None:
    with BagWriter(tmp_path / "drive", kind) as bag:
        bag.write_odometry(np.zeros(3), EPOCH_NS)
        for index in (0, 2, 1, *range(3, NUM)):  # the second and the third arrive in the other order
            delay = 250_000_000 if index == 1 else 20_000_000
            bag.write_cloud(clouds[index], EPOCH_NS + index * STEP_NS, delay_ns=delay)
    drive = open_lidar_sequence(bag.path)
    assert drive.name == "drive"
    np.testing.assert_allclose(drive.times, 1.6e9 + 0.1 * np.arange(NUM), atol=1e-6)
    for index in (4, 0, 5, 1, 2, 3):
        np.testing.assert_array_equal(drive.read_scan(index), clouds[index])
    with ThreadPoolExecutor(4) as pool:
        numbers = [0, 3, 1, 5] * 5
        for number, found in zip(numbers, pool.map(drive.read_scan, numbers), strict=True):
            np.testing.assert_array_equal(found, clouds[number])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_clouds_of_all_drivers_are_read(tmp_path: Path, layout: str, is_bigendian: bool, clouds) -> None:
    times = np.linspace(0, 0.1, len(clouds[0])) if layout in TIMES else None
    options = {"layout": layout, "times_s": times, "is_bigendian": is_bigendian, "num_rows": 4, "row_tail": 7}
    path = write_clouds(tmp_path / "a", "bag", clouds[:1], **options)
    drive = open_lidar_sequence(path)
    np.testing.assert_allclose(drive.read_scan(0), clouds[0], rtol=1e-6)
    found = drive.read_times(0)
    if times is None:
        assert found is None
    else:
        np.testing.assert_allclose((found - found[0]) / TIMES[layout][1], times, atol=1e-6)


def test_beams_that_met_nothing_are_left_out_with_their_times(tmp_path: Path, clouds) -> None:
    clouds[0][[3, 5]], clouds[0][7, 1], clouds[1][:] = np.nan, np.inf, 0
    times = np.linspace(0, 0.1, 120)
    drive = open_lidar_sequence(write_clouds(tmp_path / "a", "mcap", clouds[:2], times_s=times))
    np.testing.assert_array_equal(drive.read_scan(0), np.delete(clouds[0], [3, 5, 7], axis=0))
    np.testing.assert_allclose(drive.read_times(0) / 1e9, np.delete(times, [3, 5, 7]), atol=1e-8)
    assert drive[1].shape == (0, 3)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_the_message_of_livox_is_read(tmp_path: Path, kind: str, clouds) -> None:
    times_ns = np.arange(120) * 800_000
    with BagWriter(tmp_path / "a", kind) as bag:
        for index, points in enumerate(clouds):
            bag.write_livox(points, EPOCH_NS + index * STEP_NS, times_ns)
    drive = open_lidar_sequence(bag.path)
    np.testing.assert_array_equal(drive.read_scan(2), clouds[2])
    np.testing.assert_array_equal(drive.read_times(2), times_ns)


def test_headers_without_a_time_have_that_of_the_recording(tmp_path: Path, clouds) -> None:
    with BagWriter(tmp_path / "a", "bag") as bag:
        for index, points in enumerate(clouds):
            bag.write_cloud(points, 0, delay_ns=EPOCH_NS + index * STEP_NS)
    drive = open_lidar_sequence(bag.path)
    np.testing.assert_allclose(np.diff(drive.times), 0.1, atol=1e-6)
    np.testing.assert_array_equal(drive.read_scan(3), clouds[3])


def test_a_folder_of_parts_is_one_drive(tmp_path: Path, clouds) -> None:
    for part in range(2):
        with BagWriter(tmp_path / f"part_{part}", "bag") as bag:
            for index in range(3 * part, 3 * part + 3):
                bag.write_cloud(clouds[index], EPOCH_NS + index * STEP_NS)
    drive = open_lidar_sequence(tmp_path)
    assert len(drive) == NUM
    for index in range(NUM):
        np.testing.assert_array_equal(drive.read_scan(index), clouds[index])


def test_a_missing_part_of_a_bag_is_named(tmp_path: Path) -> None:
    files = "rosbag2_bagfile_information: {version: 5, relative_file_paths: [drive_0.db3]}"
    (tmp_path / "metadata.yaml").write_text(files)
    with pytest.raises(InputError, match="drive_0.db3"):
        open_lidar_sequence(tmp_path)


def test_a_renamed_bag_is_read_with_a_line(tmp_path: Path, clouds, caplog) -> None:
    path = write_clouds(tmp_path / "drive", "db3", clouds)
    (file,) = path.glob("*.db3")
    file.rename(path / "of_monday.db3")
    drive = open_lidar_sequence(path)
    np.testing.assert_array_equal(drive.read_scan(2), clouds[2])
    assert "metadata.yaml names files that are not there; of_monday.db3 is read" in caplog.text


@pytest.mark.parametrize("kind", KINDS)
def test_a_clock_that_was_set_back_leaves_the_order_of_the_recording(tmp_path: Path, kind: str, clouds) -> None:
    stamps = EPOCH_NS + STEP_NS * (np.arange(NUM) - np.where(np.arange(NUM) >= 3, 100, 0))
    with BagWriter(tmp_path / "a", kind) as bag:
        for index, stamp in enumerate(stamps.tolist()):
            delay = EPOCH_NS + STEP_NS * index - stamp
            bag.write_cloud(clouds[index], stamp, delay_ns=delay)
            bag.write_scan(np.linspace(2.0, 3.0, 40) + 0.1 * index, stamp, delay_ns=delay)
            bag.write_odometry(np.array([0.1 * index, 0.0, 0.0]), stamp, delay_ns=delay)
    drive, scans = open_lidar_sequence(bag.path), read_sequence(bag.path)
    for index in range(NUM):
        np.testing.assert_array_equal(drive.read_scan(index), clouds[index])
    np.testing.assert_allclose(np.linalg.norm(scans.points[:, 0], axis=1), 2.0 + 0.1 * np.arange(NUM), atol=1e-5)
    np.testing.assert_allclose(scans.odometry_poses[:, 0], 0.1 * np.arange(NUM), atol=1e-6)
    for notes in (drive.notes, scans.notes):
        assert "the stamps step back by 9.9 s at message 3; the order of the recording is used" in notes[0].text
        assert notes[0].is_doubt


@pytest.mark.parametrize("who", ["scan", "odometry", "scan and odometry"])
@pytest.mark.parametrize("back_ns", [STEP_NS + STEP_NS // 4, 20 * STEP_NS])
def test_any_clock_that_was_set_back_leaves_the_order_of_the_recording(tmp_path: Path, who: str, back_ns: int) -> None:
    """Also by little more than a step, and that of the wheels alone; a scan that was overtaken is no fault."""
    with BagWriter(tmp_path / "a", "bag") as bag:
        for index in range(20):
            now, back = EPOCH_NS + STEP_NS * index, back_ns if index >= 8 else 0
            stamps = [now - back if each in who else now for each in ("scan", "odometry")]
            bag.write_scan(np.linspace(2.0, 3.0, 40) + 0.1 * index, stamps[0], delay_ns=now - stamps[0])
            bag.write_odometry(np.array([0.1 * index, 0.0, 0.0]), stamps[1], delay_ns=now - stamps[1])
    scans = read_sequence(bag.path)
    np.testing.assert_allclose(np.linalg.norm(scans.points[:, 0], axis=1), 2.0 + 0.1 * np.arange(20), atol=1e-5)
    np.testing.assert_allclose(scans.odometry_poses[:, 0], 0.1 * np.arange(20), atol=1e-6)
    assert [note.text.count("step back") for note in scans.notes] == [1, 0]
    with BagWriter(tmp_path / "b", "bag") as bag:
        for index in range(20):
            delay = STEP_NS * 3 // 2 if index == 8 else 0
            bag.write_scan(np.linspace(2.0, 3.0, 40) + 0.1 * index, EPOCH_NS + STEP_NS * index, delay_ns=delay)
    scans = read_sequence(bag.path)
    np.testing.assert_allclose(np.linalg.norm(scans.points[:, 0], axis=1), 2.0 + 0.1 * np.arange(20), atol=1e-5)
    assert not scans.notes


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_poses_beside_a_bag_are_used_where_they_have_its_times(tmp_path: Path, kind: str, clouds) -> None:
    path = write_clouds(tmp_path / "a", kind, clouds)
    home = path if path.is_dir() else path.parent
    T = np.tile(np.eye(4), (30, 1, 1))
    write_tum(home / "groundtruth.txt", T, times=1.6e9 + 0.02 * np.arange(30))
    assert open_lidar_sequence(path).has_reference.all()
    write_tum(home / "groundtruth.txt", T, times=1.5e9 + 0.02 * np.arange(30))
    drive = open_lidar_sequence(path)
    assert drive.T_world_lidar is None
    assert "no scan has the time of a pose; these poses are not used" in drive.notes[0].text


def test_topics_are_chosen_or_named(tmp_path: Path, clouds) -> None:
    with BagWriter(tmp_path / "a", "bag") as bag:
        for topic in ("/left/points", "/right/points"):
            bag.write_cloud(clouds[0], EPOCH_NS, topic=topic)
        bag.write_scan(np.full(40, 3.0), EPOCH_NS)
    with pytest.raises(InputError, match=r"2 topics of point clouds: /left/points, /right/points; name one"):
        open_lidar_sequence(bag.path)
    assert len(open_lidar_sequence(bag.path, topic="right/points")) == 1
    with pytest.raises(InputError, match=r"no topic /none, it has .*/scan \(LaserScan\)"):
        open_lidar_sequence(bag.path, topic="/none")
    with pytest.raises(InputError, match=r"no point clouds in topic /scan; its topics are .*dpmjax map2d"):
        open_lidar_sequence(bag.path, topic="/scan")
    with BagWriter(tmp_path / "b", "mcap") as planar:
        planar.write_scan(np.full(40, 3.0), EPOCH_NS)
    with pytest.raises(InputError, match=r"no point clouds.*dpmjax map2d"):
        open_lidar_sequence(planar.path)
    path = write_clouds(tmp_path / "c", "mcap", clouds)
    with pytest.raises(InputError, match=r"no planar scans.*dpmjax slam"):
        read_sequence(path)
    np.save(tmp_path / "0.npy", clouds[0])
    with pytest.raises(InputError, match="no bag of ROS"):
        open_lidar_sequence(tmp_path / "0.npy", topic="/points")


def room(pose: np.ndarray, num_beams: int = 90) -> np.ndarray:
    """Ranges of a laser to the walls |x| = 6, |y| = 4."""
    angles = -np.pi + 2 * np.pi / num_beams * np.arange(num_beams) + pose[2]
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (np.array([6.0, 4.0]) * np.sign(along) - pose[:2]) / along
    return np.where(np.isfinite(reach), reach, np.inf).min(axis=1)


POSES = np.column_stack([0.2 * np.arange(NUM), 0.1 * np.arange(NUM), 0.05 * np.arange(NUM)])
T_BASE_LASER = np.array([0.3, 0.1, 0.4])


def assert_on_walls(scans) -> None:
    for pose, points, mask in zip(scans.odometry_poses, scans.points, scans.mask, strict=True):
        x, y = np.abs(se2.transform_points(pose, points[mask].astype(float))).T
        assert np.minimum(np.abs(x - 6), np.abs(y - 4)).max() < 1e-3


def moments(poses: np.ndarray = POSES):
    return [(EPOCH_NS + index * STEP_NS, pose) for index, pose in enumerate(poses)]


@pytest.mark.parametrize("kind", KINDS)
def test_planar_scans_come_with_the_odometry_of_the_laser(tmp_path: Path, kind: str) -> None:
    with BagWriter(tmp_path / "a", kind) as bag:
        bag.write_transform(("base_link", "laser"), T_BASE_LASER, EPOCH_NS, topic="/tf_static")
        for stamp, pose in moments():
            bag.write_transform(("odom", "base_link"), pose, stamp)
            bag.write_transform(("map", "odom"), np.array([9.0, 9, 1]), stamp)
            bag.write_scan(room(se2.compose(pose, T_BASE_LASER)), stamp)
    scans = read_sequence(bag.path)
    np.testing.assert_allclose(scans.odometry_poses, se2.compose(POSES, T_BASE_LASER), atol=1e-6)
    np.testing.assert_allclose(scans.times, 1.6e9 + 0.1 * np.arange(NUM), atol=1e-6)
    assert scans.is_organised
    assert_on_walls(scans)


@pytest.mark.parametrize(("topic", "num"), [("/tf_static", 2), ("/tf", NUM)])
@pytest.mark.parametrize("has_odometry_topic", [False, True])
def test_a_mounting_that_is_published_again_stays_one(tmp_path, topic: str, num: int, has_odometry_topic: bool) -> None:
    with BagWriter(tmp_path / "a", "bag") as bag:
        for stamp, _ in moments()[:num]:
            bag.write_transform(("base_link", "laser"), T_BASE_LASER, stamp, topic=topic)
        for stamp, pose in moments():
            if has_odometry_topic:
                bag.write_odometry(pose, stamp)
            else:
                bag.write_transform(("odom", "base_link"), pose, stamp)
            bag.write_scan(room(se2.compose(pose, T_BASE_LASER)), stamp)
    scans = read_sequence(bag.path)
    np.testing.assert_allclose(scans.odometry_poses, se2.compose(POSES, T_BASE_LASER), atol=1e-6)


def test_a_laser_that_moves_on_a_moving_robot_has_no_odometry(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a", "bag") as bag:
        for stamp, pose in moments():
            bag.write_transform(("odom", "base_link"), pose, stamp)
            bag.write_transform(("base_link", "laser"), np.array([0, 0, pose[0]]), stamp)
            bag.write_scan(room(pose), stamp)
    scans = read_sequence(bag.path)
    assert scans.odometry_poses is None
    assert "no odometry" in scans.notes[0].text


def test_a_laser_upside_down_is_turned(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a", "bag") as bag:
        bag.write_transform(("base_link", "laser"), T_BASE_LASER, EPOCH_NS, topic="/tf_static", is_upside_down=True)
        for stamp, pose in moments():
            bag.write_transform(("odom", "base_link"), pose, stamp)
            # Seen from below, the beams run in the opposite direction.
            ranges = room(se2.compose(pose, T_BASE_LASER))
            bag.write_scan(np.roll(ranges[::-1], 1), stamp)
    scans = read_sequence(bag.path)
    assert_on_walls(scans)


def test_odometry_is_interpolated_at_the_scans(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a", "mcap") as bag:
        for stamp, pose in moments():
            bag.write_odometry(pose, stamp)
            bag.write_scan(room(pose), stamp + STEP_NS // 2)
    scans = read_sequence(bag.path)
    np.testing.assert_allclose(scans.odometry_poses[:-1], (POSES[1:] + POSES[:-1]) / 2, atol=1e-6)
    # The motion goes on after the last pose.
    before, after = scans.odometry_poses[-2:]
    np.testing.assert_allclose(se2.relative(POSES[-1], after), se2.relative(before, POSES[-1]), atol=1e-6)


def test_beams_without_echo_and_scans_of_fewer_beams_are_masked(tmp_path: Path) -> None:
    full = room(POSES[0])
    full[[0, 1, 2, 3]] = [np.inf, np.nan, 0.0, 30.0]
    with BagWriter(tmp_path / "a", "bag") as bag:
        bag.write_scan(full, EPOCH_NS)
        bag.write_scan(room(POSES[1], 80), EPOCH_NS + STEP_NS)
    scans = read_sequence(bag.path)
    assert scans.odometry_poses is None
    np.testing.assert_array_equal(np.flatnonzero(~scans.mask[0]), [0, 1, 2, 3])
    np.testing.assert_array_equal(np.flatnonzero(~scans.mask[1]), np.arange(80, 90))


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    for name in [name for name in sys.modules if name.startswith("rosbags")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match=r"needs rosbags, which is not installed; pip install 'dpmjax\[ros\]'"):
        open_lidar_sequence(tmp_path / "a.bag")
