"""The suite and the logs: each method on a tiny walk, the content of the rows, and the resume of a killed run."""

from collections import Counter

import numpy as np
import pytest

from dpmjax.cli.run import load_json
from dpmjax.geometry import se2
from dpmjax.simulation import simulate_sequence
from dpmjax.slam import DEEPMAPPING
from experiments import deepmapping_logs, deepmapping_suite
from experiments._deepmapping_methods import METHODS, PACKAGES, Task, make_task
from experiments.deepmapping_logs import row_of
from experiments.deepmapping_suite import run_method
from tests.experiments.running import read_rows, run
from tests.optional import import_or_skip

# ATE in px that each method stays below on the tiny walk; the start of all poses at zero has 14 px there. The direct
# optimisation has two steps only: it must run and give poses.
LARGEST_ATE_PX = {
    **{"icp-point-plain": 10.0, "icp-plane-plain": 3.0, "icp-point": 3.0, "icp-plane": 0.1, "icp-refined": 0.01},
    **{
        "multiway": 3.0,
        "swarm-poses": 500.0,
        "lnet-zero": 30.0,
        "lnet-icp": 0.1,
        "search": 1.0,
        "search-refined": 0.01,
    },
    **{"all": 0.01, "direct-adam": 30.0, "direct-windows": 30.0, "direct-lbfgs": 30.0, "global-deepmapping": 1.0},
    "refined-deepmapping": 0.1,
}


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(simulate_sequence(0, 8, num_beams=96, seed=4), steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_method_registers_a_tiny_walk(name, task) -> None:
    if name in PACKAGES:
        import_or_skip(PACKAGES[name])
    row = run_method(name, task)
    assert row["ate_px"] < LARGEST_ATE_PX[name]
    assert f"{row['kept']} {row['ate_px']:.4g} px" in row["candidates"].split("; ")
    assert row["success"] == (row["ate_px"] < 20.0)
    assert (DEEPMAPPING in row["candidates"]) == (name == "all" or "deepmapping" in name or "lnet" in name)


@pytest.mark.slow
def test_methods_without_an_order_find_the_shuffled_walk(task) -> None:
    row = run_method("refined-deepmapping", make_task(task.sequence, is_ordered=False, steps=2))
    assert "ICP" not in row["candidates"]
    assert row["ate_px"] < 0.1


def test_suite_is_that_of_the_paper() -> None:
    entries = deepmapping_suite.list_walks()
    assert len({tuple(entry.values()) for entry in entries}) == len(entries) == 75
    assert Counter(entry["num_poses"] for entry in entries) == {128: 50, 256: 25}
    assert {entry["world"] for entry in entries[:6]} == {0, 1, 2}


@pytest.mark.slow
def test_suite_has_a_row_a_method_and_the_bound_and_simulates_a_walk_once(tmp_path, monkeypatch) -> None:
    simulated, out = [], tmp_path / "out"

    def simulate(world: int, num_scans: int, **options):
        simulated.append(world)
        return simulate_sequence(world, num_scans, num_beams=96, **options)

    entries = [{"world": world, "num_poses": 24, "walk": 3} for world in (0, 1)]
    monkeypatch.setattr(deepmapping_suite, "list_walks", lambda: entries)
    monkeypatch.setattr(deepmapping_suite.simulation, "simulate_sequence", simulate)
    options = ["-o", out, "--methods", "icp-plane", "global-deepmapping", "--steps", 2, "--range-noise-px", 1]
    assert run(deepmapping_suite, *options, "--stride", 2, "--limit", 1) == 0
    first = read_rows(out)
    assert [row["method"] for row in first] == ["icp-plane", "global-deepmapping"]
    assert 0.0 < float(first[0]["bound_px"]) < 1.0
    # The bound is that of the scans that are used.
    assert first[1]["candidates"].count("px") == 2
    assert run(deepmapping_suite, "-o", out, "--resume", "--limit", 2) == 0
    assert read_rows(out)[:2] == first
    assert simulated == [0, 1]
    table = load_json(out / "metrics.json")["table"]
    assert [row["num_rows"] for row in table] == [2, 2]


def flaser_lines(walk, poses, odometry) -> list[str]:
    """Returns the front half of each scan as a line of a log, 2 cm a pixel, one second apart."""
    bearings = np.arctan2(walk.points[0, :, 1], walk.points[0, :, 0])
    ahead = np.argsort(bearings)[90:270]
    lines = []
    for points, pose, wheels in zip(walk.points[:, ahead], poses, odometry, strict=True):
        ranges = " ".join(f"{0.02 * reading:.3f}" for reading in np.linalg.norm(points, axis=1))
        x, y = (" ".join(f"{value:.5f}" for value in p * [0.02, 0.02, 1.0]) for p in (pose, wheels))
        lines.append(f"FLASER 180 {ranges} {x} {y} {len(lines)} robot {len(lines)}")
    return lines


@pytest.mark.slow
def test_a_whole_recording_is_measured_by_its_relations_and_its_corrected_log(tmp_path) -> None:
    """The poses of a recording are its odometry; half of them are those of a robot that stands still."""
    walk = simulate_sequence(0, 24, num_beams=360, seed=4, with_odometry=True)
    walk = walk.take(np.repeat(np.arange(24), 2))
    metres = np.array([0.02, 0.02, 1.0])
    wheels = walk.odometry_poses * metres
    odom = [f"ODOM {x} {y} {heading} 0 0 0 {time} robot {time}" for time, (x, y, heading) in enumerate(wheels)]
    scans = flaser_lines(walk, walk.odometry_poses, walk.odometry_poses)
    (tmp_path / "robot.clf").write_text("\n".join([*odom, *scans]) + "\n")
    true = se2.relative(walk.reference_poses[0], walk.reference_poses[41]) * metres
    (tmp_path / "robot.relations").write_text(f"0 41 {true[0]} {true[1]} 0 0 0 {true[2]}\n")
    (tmp_path / "corrected").mkdir()
    lines = flaser_lines(walk, walk.reference_poses, walk.odometry_poses)
    (tmp_path / "corrected" / "robot.log").write_text("\n".join(lines) + "\n")
    options = [str(tmp_path), "--corrected", str(tmp_path / "corrected"), "-o", str(tmp_path / "out")]
    options += ["--inits", "odometry", "--steps", "2"]
    assert run(deepmapping_logs, *options) == 0
    (row,) = read_rows(tmp_path / "out")
    assert row["num_scans"] == "48"
    assert int(row["num_registered"]) < 24
    assert row["ate_m"] == row["right"] == ""
    assert float(row["relations_m"]) < min(0.05, float(row["relations_initial_m"]))
    assert float(row["ate_corrected_m"]) < min(0.1, float(row["ate_corrected_initial_m"]))
    trajectory = tmp_path / "out" / "drives" / "robot.clf_odometry" / "trajectory_tum.txt"
    assert len(trajectory.read_text().splitlines()) >= 48


def test_trust_is_measured_by_maps_that_are_right_at_every_scan() -> None:
    cases = ((0.1, True), (0.2, False), (0.9, True), (2.0, False), (None, True))
    rows = [row_of({"worst_scan_m": worst, "assessment": {"is_trusted": trusted}}) for worst, trusted in cases]
    assert [row["right_if_trusted"] for row in rows] == [True, None, False, None, None]
    assert [row["trusted_if_right"] for row in rows] == [True, False, None, None, None]


@pytest.mark.slow
def test_logs_keep_finished_runs_and_leave_out_lost_odometry(tmp_path, capsys) -> None:
    """The corrected poses of the second log are its odometry, so it has none of its own."""
    walk = simulate_sequence(0, 12, num_beams=360, seed=4, with_odometry=True)
    for name, odometry in (("good", walk.odometry_poses), ("lost", walk.reference_poses)):
        (tmp_path / f"{name}.log").write_text("\n".join(flaser_lines(walk, walk.reference_poses, odometry)) + "\n")
    options = [tmp_path, "-o", tmp_path / "out", "--inits", "odometry", "--steps", 2]
    assert run(deepmapping_logs, *options) == 0
    first = read_rows(tmp_path / "out")
    assert [(row["log"], row["num_scans"]) for row in first] == [("good.log", "12"), ("lost.log", "")]
    assert "Refused: lost.log from odometry." in capsys.readouterr().out
    assert run(deepmapping_logs, *options, "--resume") == 0
    assert read_rows(tmp_path / "out") == first
    assert run(deepmapping_logs, tmp_path, *options[:1]) == 2
    assert "4 logs have 2 different names" in capsys.readouterr().err
