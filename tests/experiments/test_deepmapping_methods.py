"""The suite and the limits: each method on a tiny walk, what the tables tell, and that a killed run goes on."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from dpmjax.cli.command import run_command
from dpmjax.geometry import se2
from dpmjax.io import read_sequence
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.simulation import simulate_sequence
from experiments import (
    _deepmapping_methods,
    deepmapping_limits,
    deepmapping_logs,
    deepmapping_suite,
)
from experiments._deepmapping_methods import (
    DEEPMAPPING,
    METHODS,
    Task,
    best_kept,
    make_task,
    run_method,
)
from experiments.deepmapping_logs import write_corridor_log
from tests.optional import import_or_skip

# ATE in px that each method stays below on the tiny walk; the start of all poses at zero has 14 px there. The direct
# optimisation has two steps only: it must run and give poses.
LARGEST_ATE_PX = {
    "icp-point-plain": 10.0,
    "icp-plane-plain": 3.0,
    "icp-point": 3.0,
    "icp-plane": 0.1,
    "icp-refined": 0.01,
    "multiway": 3.0,
    "swarm-poses": 500.0,
    "particle-swarm": 10.0,
    "lnet-zero": 30.0,
    "lnet-icp": 0.1,
    "search": 1.0,
    "search-refined": 0.01,
    "all": 0.01,
    "direct-adam": 30.0,
    "direct-windows": 30.0,
    "direct-lbfgs": 30.0,
    "global-deepmapping": 1.0,
    "refined-deepmapping": 0.1,
}


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(simulate_sequence(0, 8, num_beams=96, seed=4), steps=2)


def test_every_method_has_a_test() -> None:
    assert set(LARGEST_ATE_PX) == set(METHODS)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_method_registers_a_tiny_walk(name, task) -> None:
    package = METHODS[name].package
    if package is not None:
        import_or_skip(package)
    row = run_method(name, task)
    assert row["ate_px"] < LARGEST_ATE_PX[name]
    assert row["ate_px"] == row["candidates"][row["kept"]]["ate_px"]
    assert row["success"] == (row["ate_px"] < 20.0)
    assert (DEEPMAPPING in row["candidates"]) == (name == "all" or "deepmapping" in name or "lnet" in name)
    for numbers in row["candidates"].values():
        assert {"ate_px", "worst_scan_px", "point_distance_px", "code_length", "misfit", "surprise"} == set(numbers)


@pytest.mark.slow
def test_methods_without_an_order_find_the_shuffled_walk(task) -> None:
    shuffled = make_task(task.sequence, is_ordered=False, steps=2)
    row = run_method("refined-deepmapping", shuffled)
    assert list(row["candidates"]) == ["global registration, refined", "DeepMapping", "DeepMapping, refined"]
    assert row["ate_px"] < 0.1


def test_suite_is_that_of_the_paper() -> None:
    entries = deepmapping_suite.list_trajectories()
    assert len(entries) == 75
    assert len({tuple(entry.values()) for entry in entries}) == 75
    assert Counter(entry["num_scans"] for entry in entries) == {128: 50, 256: 25}
    assert {entry["world"] for entry in entries[:6]} == {0, 1, 2}


def test_shuffled_task_keeps_scans_with_their_truth(task) -> None:
    shuffled = make_task(task.sequence, is_ordered=False, steps=2, seed=0)
    order = [
        int(np.flatnonzero((task.sequence.reference_poses == pose).all(1))[0])
        for pose in shuffled.sequence.reference_poses
    ]
    assert sorted(order) == list(range(8)) != order
    np.testing.assert_array_equal(shuffled.sequence.points, task.sequence.points[order])


def a_row(method: str, ate: float, kept: str = "search", **candidates: float) -> dict:
    numbers = {"ate_px": ate, "point_distance_px": 2 * ate}
    each = {name: {"ate_px": x, "point_distance_px": 2 * x} for name, x in (candidates or {kept: ate}).items()}
    common = {"seconds": 1.0, "cpu_s": 2.0, "is_trusted": ate < 1.0, "success": ate < 20.0}
    return {"method": method, **numbers, **common, "kept": kept, "candidates": each}


def test_table_tells_each_candidate_under_its_own_name() -> None:
    rows = [
        a_row("global-deepmapping", 0.5, "fit", search=3.0, fit=0.5),
        a_row("global-deepmapping", 30.0, "search", search=30.0, fit=40.0),
        a_row("icp-plane", 0.25),
    ]
    lines = deepmapping_suite.table(rows).splitlines()
    assert lines[2] == "| global registration, then DeepMapping | 2 | 15.2 | 30.5 | 50.0% | 1.0 | 1 | 100.0% |"
    assert lines[3] == "| - of it: search | 2 | 16.5 | 33 | 50.0% | kept 1 times |  |  |"
    assert lines[4] == "| - of it: fit | 2 | 20.2 | 40.5 | 50.0% | kept 1 times |  |  |"
    assert lines[5].startswith("| incremental ICP, point to line | 1 | 0.25 |")
    assert len(lines) == 6


def test_limits_are_resumed_without_doing_a_row_twice(tmp_path, monkeypatch, capsys) -> None:
    simulated = []

    def simulate(world: int, num_scans: int, **options):
        simulated.append((world, options["seed"]))
        return simulate_sequence(world, 8, num_beams=64)

    def start(*options: str) -> int:
        arguments = ["-o", str(tmp_path / "out"), "--strides", "2", "--noises-px", "0", "--orders", "ordered", *options]
        main, config = deepmapping_limits.main, deepmapping_limits.Config
        return run_command(main, config, name="limits", description=None, args=arguments)

    def run(*options: str) -> dict:
        assert start(*options) == 0
        return json.loads((tmp_path / "out" / "metrics.json").read_text())

    monkeypatch.setattr(deepmapping_limits.simulation, "simulate_sequence", simulate)
    monkeypatch.setattr(_deepmapping_methods, "make_task", lambda sequence, **_: Task(sequence, planar=None))
    monkeypatch.setattr(_deepmapping_methods, "run_method", lambda name, task: a_row(name, len(task.sequence)))
    absent = METHODS["multiway"]._replace(package="no_such_package")
    monkeypatch.setitem(METHODS, "multiway", absent)
    first = run("--limit", "1", "--methods", "icp-plane", "icp-point")
    assert start("--limit", "2", "--methods", "icp-plane", "multiway", "--resume") == 2
    assert "--methods multiway: no_such_package is not installed" in capsys.readouterr().err
    second = run("--limit", "2", "--methods", "icp-plane", "icp-point", "--resume")
    assert second["rows"][:2] == first["rows"]
    assert [row["walk"] for row in second["rows"]] == [0, 0, 1, 1]
    assert {row["ate_px"] for row in second["rows"]} == {4}
    # Each walk is simulated once for both methods, and not again for rows that exist.
    assert simulated == [(0, 200), (1, 201)]
    assert second["note"] is None
    assert "rooms, ordered, icp-plane: 100% of 2" in capsys.readouterr().out


def test_limits_tell_every_candidate_and_how_often_the_best_was_kept() -> None:
    cell = {"world": "grove", "order": "ordered", "stride": 8, "noise_px": 1.0}
    rows = [
        cell | a_row("all", 0.5, "fit", search=3.0, fit=0.5),
        cell | a_row("all", 2.05, "search", search=2.05, fit=2.0),
        cell | a_row("all", 4.0, "search", search=4.0, fit=1.0),
        cell | a_row("icp-plane", 0.25),
    ]
    lines = deepmapping_limits.table(rows).splitlines()
    assert lines[0] == "| world | order | every | noise, px | all: search | all: fit | icp-plane | best kept |"
    assert lines[2:] == ["| grove | ordered | 8 | 1.0 | 3 | 1 | 0.25 | 2 of 3 |"]
    assert best_kept(rows) == {"num_choices": 3, "num_best_kept": 2}


@pytest.mark.parametrize(("world", "expected"), [("rooms", 1), ("grove", "grove-4"), ("crowd", "crowd-4")])
def test_limits_have_a_world_for_each_walk(world: str, expected: int | str, monkeypatch) -> None:
    found = []

    def simulate(name: int | str, *_, **options):
        found.append((name, options["seed"], options["range_noise_px"]))
        return simulate_sequence(0, 8, num_beams=64)

    monkeypatch.setattr(deepmapping_limits.simulation, "simulate_sequence", simulate)
    monkeypatch.setattr(_deepmapping_methods, "make_task", lambda sequence, **_: Task(sequence, planar=None))
    cell = {"world": world, "stride": 4, "walk": 4, "noise_px": 3.0, "order": "ordered"}
    task, _ = deepmapping_limits._prepare(deepmapping_limits.Config(), cell)
    assert found == [(expected, 204, 3.0)]
    assert len(task.sequence) == 2


@pytest.mark.parametrize(
    "options",
    [
        {"worlds": ("moon",)},
        {"methods": ("nonsense",)},
        {"methods": ()},
        {"limit": 0},
        {"steps": 1},
        {"orders": ("sideways",)},
    ],
)
def test_bad_options_are_named(options) -> None:
    with pytest.raises(ValueError, match="--"):
        deepmapping_limits.Config(**options)


@pytest.mark.slow
def test_suite_writes_its_table_its_picture_and_the_bound(tmp_path, monkeypatch, capsys) -> None:
    entries = [{"world": 0, "num_scans": 12, "walk": 3}]
    monkeypatch.setattr(deepmapping_suite, "list_trajectories", lambda: entries)
    options = ["-o", str(tmp_path / "out"), "--methods", "icp-plane", "global-deepmapping", "--steps", "2"]
    options += ["--range-noise-px", "1"]
    main, config = deepmapping_suite.main, deepmapping_suite.Config
    assert run_command(main, config, name="suite", description=None, args=options) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [row["method"] for row in metrics["rows"]] == ["icp-plane", "global-deepmapping"]
    candidates = metrics["methods"]["global-deepmapping"]["candidates"]
    assert sum(numbers["num_kept"] for numbers in candidates.values()) == 1
    assert 0.0 < metrics["methods"]["icp-plane"]["median_bound_px"] < 1.0
    printed = capsys.readouterr().out
    assert "No unbiased estimate has a median ATE below" in printed
    assert printed.splitlines()[0] == (tmp_path / "out" / "table.md").read_text().splitlines()[0]


def flaser_lines(walk, poses, odometry) -> list[str]:
    """The half of each scan that lies ahead, 2 cm a pixel, one second after the other."""
    bearings = np.arctan2(walk.points[0, :, 1], walk.points[0, :, 0])
    ahead = np.argsort(bearings)[90:270]
    lines = []
    for points, pose, wheels in zip(walk.points[:, ahead], poses, odometry, strict=True):
        ranges = " ".join(f"{0.02 * reading:.3f}" for reading in np.linalg.norm(points, axis=1))
        x, y = (" ".join(f"{value:.5f}" for value in p * [0.02, 0.02, 1.0]) for p in (pose, wheels))
        lines.append(f"FLASER 180 {ranges} {x} {y} {len(lines)} robot {len(lines)}")
    return lines


@pytest.mark.slow
def test_a_whole_recording_is_measured_by_its_relations_and_its_corrected_log(tmp_path, capsys) -> None:
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
    main, config = deepmapping_logs.main, deepmapping_logs.Config
    assert run_command(main, config, name="logs", description=None, args=options) == 0
    capsys.readouterr()
    (row,) = json.loads((tmp_path / "out" / "metrics.json").read_text())["rows"]
    assert row["num_scans"] == 48
    assert row["num_registered"] < 24
    assert "ate_m" not in row
    assert row["num_relations"] == 1
    assert row["relations_m"] < min(0.05, row["relations_initial_m"])
    assert row["num_corrected"] == 48
    assert row["ate_corrected_m"] < min(0.1, row["ate_corrected_initial_m"])
    trajectory = tmp_path / "out" / "drives" / "robot.clf_odometry" / "trajectory_tum.txt"
    assert len(trajectory.read_text().splitlines()) >= 48


def test_shares_of_trust_count_maps_that_are_right_at_every_scan() -> None:
    rows = [
        {"worst_scan_m": worst, "assessment": {"is_trusted": trusted}}
        for worst, trusted in ((0.1, True), (0.2, False), (0.9, True), (2.0, False))
    ]
    lines = deepmapping_logs.trust_lines([*rows, {"assessment": {"is_trusted": True}}])
    assert lines == ["1 of 2 maps that are trusted are right", "1 of 2 maps that are right are trusted"]


def test_a_corridor_log_is_one_of_its_seed(tmp_path) -> None:
    one, same, other = (read_sequence(write_corridor_log(tmp_path / f"{k}.npz", k // 2)) for k in range(3))
    np.testing.assert_array_equal(one.points, same.points)
    assert (one.reference_poses != other.reference_poses).any()
    assert one.unit == "m"
    steps = se2.relative(one.reference_poses[:-1], one.reference_poses[1:])
    assert 0.5 < np.median(steps[:, 0]) < 2.0
    assert absolute_trajectory_error(one.odometry_poses[:, :2], one.reference_poses[:, :2]) > 0.1


@pytest.mark.slow
def test_logs_keep_finished_runs_and_leave_out_lost_odometry(tmp_path, capsys) -> None:
    """The corrected poses of the second log are its odometry, so it has none of its own."""
    walk = simulate_sequence(0, 12, num_beams=360, seed=4, with_odometry=True)
    for name, odometry in (("good", walk.odometry_poses), ("lost", walk.reference_poses)):
        (tmp_path / f"{name}.log").write_text("\n".join(flaser_lines(walk, walk.reference_poses, odometry)) + "\n")
    options = [str(tmp_path), "-o", str(tmp_path / "out"), "--inits", "odometry", "--steps", "2"]
    main, config = deepmapping_logs.main, deepmapping_logs.Config
    for more in ([], ["--resume"]):
        assert run_command(main, config, name="logs", description=None, args=[*options, *more]) == 0
        printed = capsys.readouterr().out.splitlines()
        assert [line.split(" | ")[:3] for line in printed if "good" in line] == [["| good.log", "12 (5)", "odometry"]]
    (row,) = json.loads((tmp_path / "out" / "metrics.json").read_text())["rows"]
    assert row["candidates"][row["kept"]]["ate_m"] == row["ate_m"]
    options = [str(tmp_path), *options[:1]]
    assert run_command(main, config, name="logs", description=None, args=options) == 2
    assert "4 logs have 2 different names" in capsys.readouterr().err


def test_logs_refuse_an_unknown_start(tmp_path, capsys) -> None:
    log = write_corridor_log(tmp_path / "a.npz", 0)
    options = [str(log), "-o", str(tmp_path / "out"), "--inits", "compass"]
    assert run_command(deepmapping_logs.main, deepmapping_logs.Config, name="logs", description=None, args=options) == 2
    assert "--inits: expected some of auto" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
