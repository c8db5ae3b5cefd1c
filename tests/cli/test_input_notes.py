"""A run reports decisions on its input, and a run without a result fails: log, metrics.json, last line, code."""

from pathlib import Path

import numpy as np
import pytest

from dpmjax.cli.run import EXIT_FAILED, EXIT_OK, load_json
from dpmjax.cli.slam_run import judge
from dpmjax.geometry import rigid
from dpmjax.io import write_tum
from dpmjax.slam import assess_map
from tests.cli.test_slam import run
from tests.data_sets import write_pcd
from tests.slam.test_odometry import motion, planes, seen_from

pytestmark = pytest.mark.usefixtures("without_networks")


def ring(index: int) -> np.ndarray:
    """A scan of one ring, which has no surface."""
    angle = np.linspace(-np.pi, np.pi, 900) + 0.01 * index
    return np.stack([8 * np.cos(angle), 6 * np.sin(angle), 0 * angle], axis=1)


def write_room(folder: Path, num_scans: int) -> np.ndarray:
    folder.mkdir()
    world, truth = planes(np.random.default_rng(0)), np.array([motion(0.4 * step, 0, 0) for step in range(num_scans)])
    for number, T in enumerate(truth):
        write_pcd(folder / f"{number:06}.pcd", seen_from(world, T))
    return truth


def test_a_drive_of_empty_scans_fails(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for index in range(6):
        write_pcd(tmp_path / f"{index}.pcd", ring(index))
    out = tmp_path / "out"
    assert run(tmp_path, "-o", out) == EXIT_FAILED
    last = capsys.readouterr().err.replace("\r", "\n").splitlines()[-1]
    assert "6 of 6 scans without enough points" in last
    assert last.startswith("dpmjax: error: ")
    assert load_json(out / "metrics.json")["status"] == "failed"


@pytest.mark.parametrize(
    ("statuses", "status", "reason"),
    [
        ({"first": 1, "tracked": 9}, "done", ""),
        ({"first": 1, "tracked": 8, "coasting": 1}, "done", "uncertain"),
        ({"first": 1, "tracked": 66, "coasting": 53}, "uncertain", "53 scans"),
        ({"first": 1, "tracked": 7, "predicted": 2}, "uncertain", "2 scans placed by the predicted motion"),
        ({"first": 1, "tracked": 1, "predicted": 9}, "uncertain", "9 scans"),
        ({"first": 1, "network": 108, "predicted": 12}, "done", "12 scans"),
        ({"first": 1, "predicted": 5, "restarted": 1}, "failed", "none of 7 scans could be aligned"),
        ({"empty": 16}, "failed", "16 of 16 scans without enough points"),
        ({"first": 1}, "done", "1 scan, "),
        ({}, "done", "0 scans"),
    ],
)
def test_the_status_follows_from_the_scans(statuses: dict[str, int], status: str, reason: str) -> None:
    numbers = dict.fromkeys(("path_m", "num_keyframes", "num_new_keyframes", "num_loops"), 0)
    numbers |= {"scan_statuses": statuses, "reference_doubt": None}
    names = [name for name, count in statuses.items() for _ in range(count)]
    found = judge(assess_map(names, 1), numbers)
    assert found["status"] == status
    assert reason in found["verdict"]
    assert judge(assess_map(names, 2), numbers)["status"] == ("uncertain" if status == "done" else status)


def test_notes_are_in_the_log_and_the_numbers_and_errors_are_those_of_matched_scans(tmp_path: Path) -> None:
    drive, out = tmp_path / "drive", tmp_path / "out"
    truth = write_room(drive, 6)
    times, fine = 100 + 0.1 * np.arange(6), 100 + 0.01 * np.arange(36)
    (drive / "times.txt").write_text("".join(f"{time:.6f}\n" for time in times))
    poses = np.array([motion(4.0 * time, 0, 0) for time in fine - 100])
    write_tum(drive / "groundtruth.txt", poses, times=fine)
    assert run(drive, "-o", out) == EXIT_OK
    (note,) = load_json(out / "metrics.json")["input_notes"]
    assert "matched by time, tolerance 0.005 s; 2 of 6 scans have no reference pose" in note
    assert note in (out / "log.txt").read_text()
    metrics = load_json(out / "metrics.json")
    assert metrics["status"] == "done"
    assert metrics["ate_m"] < 0.05
    assert len(truth) == metrics["num_scans"]


@pytest.mark.parametrize(
    ("spoil", "doubt"),
    [
        (lambda T: T, None),
        (lambda T: T * np.array([1, 1, 1, 1000]), "2e+03 m long, the trajectory 2 m: is the reference in metres?"),
        (rigid.inverse, "does the reference map the world to the lidar, not the lidar to the world?"),
    ],
    ids=["right", "in millimetres", "inverted"],
)
def test_a_wrong_reference_is_doubted(tmp_path: Path, capsys, spoil, doubt: str | None) -> None:
    T = spoil(write_room(tmp_path / "drive", 6))
    T[:, 3, 3] = 1.0
    write_tum(tmp_path / "drive" / "poses_lidar.txt", T)
    assert run(tmp_path / "drive", "-o", tmp_path / "out") == EXIT_OK
    found = load_json(tmp_path / "out" / "metrics.json")["reference_doubt"]
    assert found is None if doubt is None else doubt in capsys.readouterr().out


def test_a_doubt_about_the_unit_is_in_the_log_and_the_numbers(tmp_path: Path) -> None:
    """Decimetres: nearly all points lie beyond 120."""
    drive, out = tmp_path / "drive", tmp_path / "out"
    drive.mkdir()
    for index in range(3):
        write_pcd(drive / f"{index}.pcd", 30 * ring(index))
    assert run(drive, "-o", out) == EXIT_FAILED
    (note,) = load_json(out / "metrics.json")["input_notes"]
    assert "are these millimetres or centimetres?" in note
    assert note in (out / "log.txt").read_text()
