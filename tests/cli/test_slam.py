"""The command `dpmjax slam`: options, bad input, its files as others read them, stops, kills and resumed runs.

Matcher and geometry know the truth; a scan is one point, whose x is the number of its pose.
"""

import errno
import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from dpmjax import viz
from dpmjax.cli import slam, slam_run
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_OK, load_json, run_command
from dpmjax.io import LidarSequence, write_tum
from dpmjax.slam import SlamConfig, SlamMethods
from tests.experiments.running import read_rows
from tests.optional import import_or_skip
from tests.processes import run_python, start_python
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, pose

TRUTH = laps(2, side_m=40.0, step_m=2.0)
SAME_FILES = (
    "trajectory.npy", "trajectory_tum.txt", "trajectory_kitti.txt", "odometry.npy", "keyframes.txt", "graph.g2o",
    "covariances.npy", "loops.csv", "scans.csv", "map.ply", "map.npz",
)  # fmt: skip


def truth_methods(config) -> SlamMethods:
    return SlamMethods(TruthMatcher(TRUTH), TruthGeometry(TRUTH, sigma_m=0.02), SlamConfig())


def run(*options) -> int:
    return run_command(slam.main, name="slam", description=slam.__doc__, args=list(map(str, options)))


def write_drive(folder: Path, *, with_poses: bool = True) -> Path:
    folder.mkdir(parents=True)
    for number in range(len(TRUTH)):
        np.save(folder / f"{number:03}.npy", np.float32([[number, 1, 0]]))
    if with_poses:
        write_tum(folder / "poses_lidar.txt", TRUTH)
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    return write_drive(tmp_path_factory.mktemp("input") / "drive")


def use_truth(patch: pytest.MonkeyPatch) -> None:
    """Truth in place of the networks, and a state that is written often."""
    patch.setattr(slam, "slam_methods", truth_methods)
    patch.setattr(slam_run, "SAVE_EVERY_S", 0.2)


@pytest.fixture
def with_truth(monkeypatch) -> None:
    use_truth(monkeypatch)


@pytest.fixture(scope="module")
def whole(drive, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("output") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        use_truth(patch)
        assert run(drive, "-o", folder) == EXIT_OK
    return folder


def assert_same_results(folder: Path, other: Path) -> None:
    for name in SAME_FILES:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


def test_what_is_known_to_be_bad_is_told_before_the_run(with_truth, tmp_path, refused) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    for number in range(4):
        np.full((8, 4), number + 1, np.float32).tofile(drive / f"{number}.bin")
    (drive / "2.bin").write_bytes((drive / "2.bin").read_bytes()[:-3])
    assert "2.bin" in refused("slam", drive)


def test_the_picture_has_the_reference_in_the_frame_of_the_map(with_truth, tmp_path, monkeypatch) -> None:
    drive = write_drive(tmp_path / "drive", with_poses=False)
    write_tum(drive / "poses_lidar.txt", pose(30.0, -8.0, 1.0) @ TRUTH)
    drawn, draw = [], viz.trajectory_figure
    monkeypatch.setattr(viz, "trajectory_figure", lambda *parts: drawn.append(parts) or draw(*parts))
    assert run(drive, "-n", 20, "-o", tmp_path / "out") == EXIT_OK
    ((_, tracks, reference, _),) = drawn
    assert np.ptp(reference, axis=0).max() > 20
    np.testing.assert_allclose(reference, tracks[-1].positions, atol=0.3)


def test_results_say_what_was_done(whole, drive) -> None:
    metrics = load_json(whole / "metrics.json")
    assert metrics["num_scans"] == len(TRUTH)
    assert metrics["num_loops"] > 0
    assert metrics["ate_m"] < 0.5 * metrics["ate_odometry_m"]
    assert metrics["t_rel_percent"] < 1.0
    assert metrics["seed"] == 0
    assert metrics["status"] == "done"
    scans, loops = read_rows(whole, "scans.csv"), read_rows(whole, "loops.csv")
    assert [int(row["scan"]) for row in scans] == list(range(len(TRUTH)))
    assert {row["status"] for row in scans} == {"first", "tracked"}
    assert all(row["reason"] for row in scans)
    assert Path(scans[7]["source"]).name == "007.npy"
    assert sum(row["status"] == "accepted" for row in loops) == metrics["num_loops"]
    assert {row["found_by"] for row in loops} <= {"distance", "retrieval"}
    assert metrics["num_parts"] == 1
    for name in ("config.json", "log.txt", "trajectory.png", "map.png", "map.ply", "map.npz", "run_state.npz"):
        assert (whole / name).stat().st_size > 0


def test_trajectory_of_the_robot_is_that_of_the_lidar_in_another_frame(with_truth, tmp_path) -> None:
    # The lidar stands 2 m ahead and 1 m up, turned by 90 degrees.
    options = ("--base-from-lidar", 2, 0, 1, 0, 0, np.sqrt(0.5), np.sqrt(0.5))
    drive = write_drive(tmp_path / "drive", with_poses=False)
    assert run(drive, "-n", 12, "-o", tmp_path / "out", *options) == EXIT_OK
    lidar, base = (np.load(tmp_path / "out" / f"{name}.npy") for name in ("trajectory", "trajectory_base"))
    T_base_lidar = np.array([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    np.testing.assert_allclose(base[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(base @ T_base_lidar, T_base_lidar @ lidar, atol=1e-9)


def test_late_odometry_is_named_and_does_no_harm(with_truth, tmp_path, capsys) -> None:
    drive = write_drive(tmp_path / "drive", with_poses=False)
    write_tum(tmp_path / "late.txt", TRUTH[np.clip(np.arange(60) - 2, 0, 59)])
    assert run(drive, "-n", 60, "-o", tmp_path / "out", "--odometry", tmp_path / "late.txt") == EXIT_OK
    numbers = load_json(tmp_path / "out" / "metrics.json")
    assert numbers["odometry_step_m"] >= 0.0
    assert "odometry: " in capsys.readouterr().out
    assert run(drive, "-n", 50, "-o", tmp_path / "other", "--odometry", tmp_path / "late.txt") == EXIT_BAD_INPUT
    assert "60 poses for 50 scans" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_plyfile_reads_the_map(whole) -> None:
    plyfile = import_or_skip("plyfile")
    vertices = plyfile.PlyData.read(str(whole / "map.ply"))["vertex"]
    assert vertices.count > 10
    assert {"x", "y", "z", "red", "green", "blue"} == {entry.name for entry in vertices.properties}
    positions = np.column_stack([vertices[axis] for axis in "xyz"])
    # Each scan is one point, and keyframes alone are in the map.
    T = np.load(whole / "trajectory.npy")
    world = T[:, :3, 0] * np.arange(len(T))[:, None] + T[:, :3, 1] + T[:, :3, 3]
    apart = np.linalg.norm(positions[:, None] - world[None], axis=2).min(axis=1)
    assert apart.max() < 1e-3


@pytest.mark.slow
def test_a_bad_scan_on_the_way_keeps_what_was_found(whole, drive, with_truth, tmp_path, capsys) -> None:
    out, path = tmp_path / "out", drive / "060.npy"
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    assert run(drive, "-o", out) == EXIT_FAILED
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    last = errors.strip().splitlines()[-1]
    assert "060.npy" in last
    assert str(out) in last
    assert len(np.load(out / "trajectory.npy")) == 60
    assert load_json(out / "metrics.json")["status"] == "interrupted"
    path.write_bytes(good)
    assert run("--resume", "-o", out) == EXIT_OK
    assert_same_results(out, whole)


def test_a_full_disk_is_one_line(drive, with_truth, tmp_path, monkeypatch, capsys) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("dpmjax.viz.save_figure", fail)
    assert run(drive, "-n", 5, "-o", tmp_path / "out") == EXIT_FAILED
    errors = capsys.readouterr().err
    assert "Traceback" not in errors
    assert "No space left on device" in errors.strip().splitlines()[-1]
    assert "Traceback" in (tmp_path / "out" / "log.txt").read_text()


def test_an_interrupted_run_writes_all_and_goes_on(whole, drive, with_truth, tmp_path, monkeypatch) -> None:
    out, read = tmp_path / "out", LidarSequence.read_points

    def interrupting(sequence, index):
        if index == 77 and not out.with_suffix(".stopped").exists():
            out.with_suffix(".stopped").touch()
            os.kill(os.getpid(), signal.SIGINT)
        return read(sequence, index)

    monkeypatch.setattr(LidarSequence, "read_points", interrupting)
    assert run(drive, "-o", out) == 130
    num_done = len(np.load(out / "trajectory.npy"))
    assert 70 < num_done < 85
    assert (out / "map.png").stat().st_size > 0
    assert run("--resume", "-o", out) == EXIT_OK
    assert_same_results(out, whole)
    # A finished run that is resumed writes the same again.
    assert run("--resume", "-o", out) == EXIT_OK
    assert_same_results(out, whole)


@pytest.mark.slow
def test_a_run_of_the_first_scans_can_be_continued(whole, drive, with_truth, tmp_path) -> None:
    assert run(drive, "-o", tmp_path / "out", "-n", 40) == EXIT_OK
    assert len(np.load(tmp_path / "out" / "trajectory.npy")) == 40
    assert run("--resume", "-o", tmp_path / "out", "-n", len(TRUTH)) == EXIT_OK
    assert_same_results(tmp_path / "out", whole)


def test_a_run_of_fewer_scans_than_are_done_is_refused(whole, with_truth, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    files = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    capsys.readouterr()
    assert run("--resume", "-o", out, "-n", 3) == EXIT_BAD_INPUT
    assert "scans done, 3 wanted; give -n" in capsys.readouterr().err
    assert files == {path: path.read_bytes() for path in out.iterdir() if path.is_file()}


PROCESS = """
import sys, time
from pathlib import Path
import pytest
from dpmjax.io import LidarSequence
from tests.cli.test_slam import run, use_truth

use_truth(pytest.MonkeyPatch())
read = LidarSequence.read_points

def slowly(sequence, index):
    time.sleep(0.02)
    return read(sequence, index)

LidarSequence.read_points = slowly
sys.exit(run(*sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_killed_run_equals_an_unbroken_one(whole, drive, tmp_path) -> None:
    rng, out = np.random.default_rng(0), tmp_path / "out"
    for _ in range(5):
        with start_python("-c", PROCESS, *(["--resume"] if out.exists() else [drive]), "-o", out) as process:
            deadline = time.monotonic() + 120
            while not (out / "run_state.npz").exists() and time.monotonic() < deadline:
                time.sleep(0.05)
            time.sleep(rng.uniform(0, 4))
            process.kill()
    assert run_python("-c", PROCESS, "--resume", "-o", out).returncode == EXIT_OK
    assert_same_results(out, whole)
