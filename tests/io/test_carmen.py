"""Laws of the CARMEN reader."""

import gzip
import logging

import numpy as np
import pytest

from dpmjax.io import InputError
from dpmjax.io.carmen import read_carmen_log, scan_angles


def flaser(ranges, corrected=(0, 0, 0), odometry=(9, 9, 1), time=0.0):
    numbers = [len(ranges), *ranges, *corrected, *odometry, time]
    return "FLASER " + " ".join(map(str, numbers)) + f" host {time}"


def write(tmp_path, *lines, name="a.log"):
    path = tmp_path / name
    text = "\n".join(["# comment", "PARAM laser 1", "ODOM 0 0 0 0 0 0 0 h 0", "RLASER 1 2 0 0 0 0 0 0 0 h 0", *lines])
    path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
    return path


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.log.gz"])
def test_columns_go_where_they_belong(tmp_path, name):
    lines = flaser([1, 2, 3], (1, 2, 3), (4, 5, 1.5), 10.5), flaser([1, 1, 1], (2, 2, 3), (4, 6, 1.6), 11)
    log = read_carmen_log(write(tmp_path, *lines, name=name))
    np.testing.assert_allclose(log.points[0], [[0, -1], [2, 0], [0, 3]], atol=1e-6)
    np.testing.assert_array_equal(log.reference_poses, [[1, 2, 3], [2, 2, 3]])
    np.testing.assert_array_equal(log.odometry_poses, [[4, 5, 1.5], [4, 6, 1.6]])
    np.testing.assert_array_equal(log.times, [10.5, 11])
    assert log.unit == "m"
    assert log.name == "a"


@pytest.mark.parametrize(("num_beams", "last_deg"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0), (1, -90.0)])
def test_field_of_view_is_half_a_turn_from_right_to_left(num_beams, last_deg):
    angles = np.rad2deg(scan_angles(num_beams))
    assert angles[0] == -90
    np.testing.assert_allclose(angles[-1], last_deg)
    assert (np.diff(angles) > 0).all()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_the_mark_of_an_encoding_hides_no_scan(tmp_path, encoding):
    (tmp_path / "a.log").write_text("\n".join([flaser([1, 2])] * 3), encoding=encoding)
    assert len(read_carmen_log(tmp_path / "a.log")) == 3


def test_ragged_scans_are_masked(tmp_path):
    log = read_carmen_log(write(tmp_path, flaser([1, 2, 3]), flaser([4]), flaser([5, 6])))
    np.testing.assert_array_equal(log.mask.sum(axis=1), [3, 1, 2])
    assert (log.points[~log.mask] == 0).all()


def test_equal_columns_mean_no_odometry_and_equal_stamps_no_times(tmp_path):
    log = read_carmen_log(write(tmp_path, flaser([1], (1, 2, 3), (1, 2, 3)), flaser([1], (2, 2, 3), (2, 2, 3))))
    assert log.odometry_poses is None
    assert log.times is None


def odom(pose, time):
    return f"ODOM {' '.join(map(str, pose))} 0 0 0 {time} host {time}"


def test_a_log_as_recorded_has_odometry_and_no_reference(tmp_path):
    poses = [(0.1 * i, 2, 0.3) for i in range(5)]
    lines = [flaser([1, 2], pose, pose, 1.0 + i) for i, pose in enumerate(poses)]
    wheels = [odom(pose, 0.9 + i) for i, pose in enumerate(poses)]
    log = read_carmen_log(write(tmp_path, *wheels, *lines))
    assert log.reference_poses is None
    np.testing.assert_allclose(log.odometry_poses, poses)
    # Where the wheels say something else, or a SLAM program has written the log, the poses are corrected ones.
    elsewhere = [odom((pose[0] + 5, *pose[1:]), 0.9 + i) for i, pose in enumerate(poses)]
    for others in (elsewhere, [*wheels, "NEFF 30"]):
        log = read_carmen_log(write(tmp_path, *others, *lines))
        assert log.odometry_poses is None
        np.testing.assert_allclose(log.reference_poses, poses)


@pytest.mark.parametrize("kind", ["twice", "set back for good", "set back for a while", "missing stamps"])
def test_wrong_stamps_alone_change_no_odometry(tmp_path, kind, caplog):
    turns = np.linspace(0, 3, 30)
    odometry = np.column_stack([5 * np.sin(turns), 5 - 5 * np.cos(turns), turns])
    times = 100.0 + np.arange(30)
    if kind == "twice":
        odometry, times = np.repeat(odometry, 2, axis=0), np.repeat(times, 2)
    elif kind.startswith("set back"):
        times[18:] -= 60.0 if kind.endswith("good") else 5.0
    else:
        times[5::7] = 0.0
    lines = [
        flaser([1 + i / 20], (i, 0, 0), pose, time) for i, (pose, time) in enumerate(zip(odometry, times, strict=True))
    ]
    log = read_carmen_log(write(tmp_path, *lines))
    np.testing.assert_allclose(log.odometry_poses, odometry)
    np.testing.assert_allclose(log.points[:, 0, 1], -1.0 - np.arange(len(odometry)) / 20, rtol=1e-6)
    np.testing.assert_array_equal(log.reference_poses[:, 0], range(len(odometry)))
    assert (np.diff(log.times) >= 0).all()
    assert np.ptp(log.times) > 20
    assert ("the clock was set back" in caplog.text) == (kind == "set back for good")


def robotlaser(ranges, laser, robot, time, start=-np.pi / 2, step=np.pi / 2):
    head = ["ROBOTLASER1", 0, start, np.pi, step, 80.0, 0.01, 0, len(ranges), *ranges, 2, 7, 8]
    return " ".join(map(str, [*head, *laser, *robot, 0, 0, 0.5, 0.5, 1e6, time, "host", time]))


def test_newer_lines_tell_their_angles_and_the_pose_of_the_laser(tmp_path):
    """The laser is 0.2 m ahead of the robot's centre."""
    lines = [
        robotlaser([1, 2, 3], (i + 0.2, 0, 0), (i, 0, 0), 1.0 + i, step=np.pi / 4 if i else np.pi / 2) for i in range(3)
    ]
    log = read_carmen_log(write(tmp_path, *lines))
    np.testing.assert_allclose(log.points[0], [[0, -1], [2, 0], [0, 3]], atol=1e-6)
    np.testing.assert_allclose(log.points[1][1], np.array([1, -1]) * np.sqrt(2), atol=1e-6)
    assert log.reference_poses is None
    np.testing.assert_allclose(log.odometry_poses, [[0.2, 0, 0], [1.2, 0, 0], [2.2, 0, 0]])
    np.testing.assert_array_equal(log.times, [1, 2, 3])


def test_the_lines_of_a_second_laser_are_named(tmp_path, caplog):
    newer = robotlaser([3, 3, 3], (0, 0, 0), (0, 0, 0), 2.0)
    log = write(tmp_path, flaser([1, 2, 3], time=1.0), newer, newer)
    with caplog.at_level(logging.WARNING):
        assert read_carmen_log(log).points.shape[0] == 1
    assert "ROBOTLASER1 lines are left out" in caplog.text


def test_corrected_newer_lines_have_reference_and_odometry(tmp_path):
    lines = [robotlaser([1, 2, 3], (i, 0.1 * i * i, 0), (i, 0, 0), 1.0 + i) for i in range(3)]
    log = read_carmen_log(write(tmp_path, *lines))
    np.testing.assert_allclose(log.reference_poses[:, 1], [0, 0.1, 0.4])
    np.testing.assert_allclose(np.diff(log.odometry_poses[:, 1]), 0, atol=1e-12)


def test_no_echo_is_masked(tmp_path):
    path = write(tmp_path, flaser([1.0, 81.91, 0.0, 20.0]), flaser([2.0, 81.87, -1.0, 60.0]))
    np.testing.assert_array_equal(read_carmen_log(path).mask, [[1, 0, 0, 1], [1, 0, 0, 1]])
    # The longest of short ranges is one.
    assert read_carmen_log(write(tmp_path, flaser([1.0, 3.0]), flaser([2.0, 3.0]))).mask.all()


def test_entries_of_another_moment_are_interpolated(tmp_path, caplog):
    lines = [flaser([1], (i, 0, 0), (i, 0, 3.1 + 0.1 * i if i < 1 else -3.2 + 0.1 * i), i) for i in range(6)]
    lines[3] = flaser([1], (3, 0, 0), (700, -3, 1), 99.0)
    with caplog.at_level(logging.WARNING):
        log = read_carmen_log(write(tmp_path, *lines))
    assert "1 of 6 lines" in caplog.text
    np.testing.assert_allclose(log.times, range(6))
    np.testing.assert_allclose(log.odometry_poses[:, 0], range(6), atol=1e-12)
    np.testing.assert_allclose(log.odometry_poses[3, 2], -2.9, atol=1e-12)
    np.testing.assert_array_equal(log.reference_poses[:, 0], range(6))


def test_scans_of_another_moment_are_put_there_and_their_reference_is_carried_by_the_odometry(tmp_path):
    lines = [flaser([1 + i], (i, 0, 0), (2 * i, 0, 0.5), 10.0 * i) for i in range(20)]
    # The scan, time and odometry of t = 145, at the corrected pose of the line that it replaces.
    lines[3] = flaser([15.5], (3, 0, 0), (29, 0, 0.5), 145.0)
    log = read_carmen_log(write(tmp_path, *lines))
    np.testing.assert_array_equal(log.times, [0, 10, 20, *range(40, 150, 10), 145, *range(150, 200, 10)])
    np.testing.assert_allclose(log.points[14, 0, 1], -15.5)
    np.testing.assert_allclose(log.odometry_poses[14], [29, 0, 0.5])
    step = [np.cos(0.5), -np.sin(0.5)]
    np.testing.assert_allclose(log.reference_poses[14], [14 + step[0], step[1], 0], atol=1e-12)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("FLASER", "not a FLASER line"),
        ("FLASER 3 1 2 3 0 0 0", "not a FLASER line"),
        ("FLASER 2 1 abc 0 0 0 0 0 0 1 h 1", "not a FLASER line"),
        ("FLASER 2 1 nan 0 0 0 0 0 0 1 h 1", "NaN"),
        ("FLASER 2 1 1 0 0 inf 0 0 0 1 h 1", "infinite"),
        ("FLASER 0 0 0 0 0 0 0 1 h 1", "n = 0"),
    ],
)
def test_bad_line_is_named_with_its_number(tmp_path, line, found):
    with pytest.raises(InputError, match=found) as caught:
        read_carmen_log(write(tmp_path, flaser([1, 2]), line))
    assert "a.log:6" in str(caught.value)


def test_logs_without_front_laser_are_refused(tmp_path):
    with pytest.raises(InputError, match="no FLASER and no ROBOTLASER1 line"):
        read_carmen_log(write(tmp_path))
    for line in ("ROBOTLASER1 0 1 2", "ROBOTLASER1 0 -1.5 3 1.5 80 0.01 0 4 1 2"):
        with pytest.raises(InputError, match="a.log:5: not a ROBOTLASER1 line"):
            read_carmen_log(write(tmp_path, line))
    with pytest.raises(InputError, match="no such file"):
        read_carmen_log(tmp_path / "none.log")
    (tmp_path / "cut.log.gz").write_bytes(gzip.compress(b"FLASER 1 1" * 99)[:-12])
    with pytest.raises(InputError, match="cannot be unpacked"):
        read_carmen_log(tmp_path / "cut.log.gz")


@pytest.mark.parametrize(
    ("name", "shape", "has_odometry"),
    [
        ("intel", (910, 180), True),
        ("aces", (440, 180), True),
        ("csail", (406, 361), True),
        ("orebro", (237, 181), False),
        ("seattle", (241, 361), False),
        ("edmonton", (340, 180), False),
    ],
)
def test_published_logs_read_as_they_are_known(real_data, name, shape, has_odometry):
    log = read_carmen_log(real_data / "carmen" / f"{name}.log.gz")
    assert log.mask.shape == shape
    assert (log.odometry_poses is not None) == has_odometry
    assert 0.0 < 1 - log.mask.mean() < 0.06
    if has_odometry:
        step = np.linalg.norm(np.diff(log.odometry_poses[:, :2], axis=0), axis=1)
        true = np.linalg.norm(np.diff(log.reference_poses[:, :2], axis=0), axis=1)
        assert np.abs(step - true).max() < 1.0  # Entries of another moment were metres off.
        assert (np.diff(log.times) >= 0).all()


@pytest.mark.parametrize(("name", "num_scans"), [("aces", 7374), ("intel", 13631), ("fr079", 4934)])
def test_recorded_logs_have_odometry_and_no_reference(real_data, name, num_scans):
    log = read_carmen_log(real_data / "carmen_raw" / f"{name}.clf.gz")
    assert len(log) == num_scans
    assert log.reference_poses is None
    assert np.hypot(*np.diff(log.odometry_poses[:, :2], axis=0).T).max() < 0.5
