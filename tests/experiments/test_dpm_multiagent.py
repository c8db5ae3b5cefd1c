"""The command dpm_multiagent: parts of a drive and folders, its files, stops and bad input.

Matcher and geometry know the truth; a scan is one point, whose x is the number of its pose.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import dpmjax
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.result_files import load_json
from dpmjax.io import read_poses, write_tum
from dpmjax.metrics import absolute_trajectory_error
from dpmjax.saved_maps import load_state
from dpmjax.slam import SlamConfig, SlamMethods
from experiments import dpm_multiagent
from tests.deeppointmap import toy
from tests.slam.truth import TruthGeometry, TruthMatcher, laps

TRUTH = laps(1, side_m=40.0, step_m=2.0)
FILES = ("agent_1_tum.txt", "agent_2_tum.txt", "agent_3_tum.txt", "graph.g2o", "loops.csv")


def run(*options) -> int:
    return run_command(
        dpm_multiagent.main,
        dpm_multiagent.Config,
        name=dpm_multiagent.EXPERIMENT,
        description=dpm_multiagent.__doc__,
        args=list(map(str, options)),
    )


def truth_methods(model) -> SlamMethods:
    return SlamMethods(TruthMatcher(TRUTH), TruthGeometry(TRUTH, sigma_m=0.02), SlamConfig())


@pytest.fixture(autouse=True)
def with_truth(monkeypatch) -> None:
    """Truth in place of the networks."""
    monkeypatch.setattr(dpm_multiagent, "load_model", lambda weights: None)
    monkeypatch.setattr(dpm_multiagent.slam, "make_methods", truth_methods)


def write_drive(folder: Path, numbers) -> Path:
    folder.mkdir(parents=True)
    for place, number in enumerate(numbers):
        np.save(folder / f"{place:03}.npy", np.float32([[number, 1, 0]]))
    write_tum(folder / "poses_lidar.txt", TRUTH[list(numbers)])
    return folder


@pytest.mark.slow
def test_a_drive_is_cut_and_joined_again(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(dpm_multiagent, "OVERLAP", 0.5)
    drive, out = write_drive(tmp_path / "drive", range(len(TRUTH))), tmp_path / "out"
    assert run(drive, "-o", out) == EXIT_OK
    metrics = load_json(out / "metrics.json")
    assert [component["agents"] for component in metrics["components"]] == [[1, 2, 3]]
    assert metrics["ate_m"] < 1.0
    assert metrics["num_loops_between"] >= 4
    graph = dpmjax.read_g2o(out / "graph.g2o")
    assert len(graph.poses) == sum(agent["num_keyframes"] for agent in metrics["agents"])
    rows = list(csv.DictReader((out / "loops.csv").read_text().splitlines()))
    between = [row for row in rows if row["kind"] == "between"]
    assert all(row["agent"] != row["other_agent"] for row in between)
    assert sum(row["status"] == "accepted" for row in between) == metrics["num_loops_between"]
    # Trajectories are in one frame: together they fit the truth.
    found = np.concatenate([read_poses(out / f"agent_{number}_tum.txt") for number in (1, 2, 3)])
    length = len(TRUTH) / 3
    parts = [range(max(round(k * length - length / 2), 0), round((k + 1.5) * length)) for k in range(3)]
    expected = np.concatenate([TRUTH[part.start : part.stop] for part in parts])
    assert absolute_trajectory_error(found[:, :3, 3], expected[:, :3, 3]) < 1.0
    assert (out / "agents.png").stat().st_size > 0


@pytest.mark.slow
def test_drives_are_cut_one_by_one_and_a_resumed_run_computes_nothing_again(tmp_path, monkeypatch) -> None:
    whole, half = write_drive(tmp_path / "whole", range(len(TRUTH))), write_drive(tmp_path / "half", range(40))
    out = tmp_path / "out"
    monkeypatch.setattr(dpm_multiagent, "OVERLAP", 0.5)
    monkeypatch.setattr(dpm_multiagent, "NUM_AGENTS", 2)
    assert run("--cut", whole, half, "-o", out) == EXIT_OK
    rows = load_json(out / "metrics.json")["rows"]
    assert [row["sequence"] for row in rows] == ["whole", "half"]
    for row in rows:
        assert row["num_wrong_loops_between"] == 0
        assert row["meetings"] == [{"agents": [1, 2], "num_loops": row["num_loops_between"]}]
        assert all(agent["keyframe_bytes"] > 0 for agent in row["agents"])
        assert (out / "drives" / row["sequence"] / "agents.png").stat().st_size > 0
    text = (out / "table.md").read_text()
    assert f"{rows[0]['agents'][0]['keyframe_bytes'] / 1e6:.2f}, " in text
    assert f"1 and 2: {rows[0]['num_loops_between']} (0)" in text
    monkeypatch.setattr(dpm_multiagent, "map_agents", None)
    assert run("--resume", "-o", out) == EXIT_OK
    assert load_json(out / "metrics.json")["rows"] == rows


def test_two_drives_of_one_name_are_not_cut_in_one_run(tmp_path, capsys) -> None:
    folders = [write_drive(tmp_path / parent / "drive", range(9)) for parent in ("a", "b")]
    assert run("--cut", *folders, "-o", tmp_path / "out") == EXIT_BAD_INPUT
    assert "same name (drive, drive)" in capsys.readouterr().err


def test_folders_that_never_meet_stay_apart(tmp_path) -> None:
    first = write_drive(tmp_path / "monday", range(20))
    second = write_drive(tmp_path / "tuesday", range(40, 60))
    assert run(first, second, "-o", tmp_path / "out") == EXIT_OK
    metrics = load_json(tmp_path / "out" / "metrics.json")
    assert [component["agents"] for component in metrics["components"]] == [[1], [2]]
    assert metrics["ate_m"] is None
    assert all(agent["ate_m"] < 0.5 for agent in metrics["agents"])


@pytest.mark.slow
def test_a_finished_run_is_not_done_again(tmp_path, monkeypatch) -> None:
    drive, out = write_drive(tmp_path / "drive", range(len(TRUTH))), tmp_path / "out"
    assert run(drive, "-o", out) == EXIT_OK
    before = {name: (out / name).read_bytes() for name in FILES}
    # The states of the agents are those of the last keyframes: resuming places only the scans since.
    states = [load_state(path) for path in sorted(out.glob("agents/*/run_state.npz"))]
    num_scans = sum(len(np.load(out / f"agent_{number}.npy")) for number in (1, 2, 3))
    placed, thin = [], TruthGeometry.thin
    monkeypatch.setattr(TruthGeometry, "thin", lambda self, points: placed.append(points) or thin(self, points))
    assert run("--resume", "-o", out) == EXIT_OK
    assert {name: (out / name).read_bytes() for name in FILES} == before
    assert len(states) == 3
    assert len(placed) == num_scans - sum(len(state.reports) for state in states)
    assert len(placed) < 10


def test_parts_overlap_and_hold_all_scans() -> None:
    drive = toy.drive(num_scans=25)
    for num_agents, overlap in ((1, 0.05), (3, 0.0), (3, 0.05), (4, 0.5)):
        parts = dpm_multiagent.cut_sequence(drive, num_agents, overlap)
        numbers = [[int(source) for source in part.sources] for part in parts]
        assert sorted({number for part in numbers for number in part}) == list(range(25))
        assert all(part == list(range(part[0], part[-1] + 1)) for part in numbers)
        num_shared = sum(map(len, numbers)) - 25
        assert abs(num_shared - 2 * (num_agents - 1) * overlap * 25 / num_agents) <= 2 * num_agents
    with pytest.raises(ValueError, match="25 scans are too few"):
        dpm_multiagent.cut_sequence(drive, 26, 0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["/no/such/folder"], "no such file or folder"),
        (["--kitti-angle-correction"], "--kitti-angle-correction"),
    ],
)
def test_wrong_usage_is_one_line(options, message, capsys) -> None:
    assert run(*options) == EXIT_BAD_INPUT
    errors = capsys.readouterr().err
    assert message in errors
    assert "Traceback" not in errors
