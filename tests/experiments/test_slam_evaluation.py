"""`dpm_evaluate --slam` on a network that compiles in seconds, with a peer that knows the motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli import RowStopped, TableRun, why_not_importable
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.drives import DriveOptions
from dpmjax.cli.result_files import load_json
from dpmjax.cli.run_folder import RunFolder
from dpmjax.cli.slam_numbers import SlamRun
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from dpmjax.saved_maps import load_state
from experiments import _slam_comparison, _slam_evaluation, _slam_peers, dpm_evaluate
from experiments._slam_evaluation import NETWORK, ODOMETRY, OURS, Drive, FoundLoop
from tests.deeppointmap import toy
from tests.slam.truth import laps, pose

PEER = "steady"
METHODS = [
    PEER,
    OURS,
    NETWORK,
    ODOMETRY,
    *(f"localization, {p}" for p in _slam_evaluation.PRECISIONS),
]
STEP_M, NUM_SCANS = 1.9, 6


class SteadyPeer:
    """Goes ahead by the same step at each scan."""

    map_name = "nothing"

    def __init__(self, *, is_indoors: bool) -> None:
        self.num = self.num_grown = 0

    def step(self, points: np.ndarray) -> None:
        assert points.dtype == np.float64
        assert len(points)
        self.num += 1

    def grow_map(self, points: np.ndarray) -> None:
        self.num_grown = self.num

    def map_bytes(self) -> int:
        return self.num_grown

    def finish(self):
        T = np.tile(np.eye(4), (self.num, 1, 1))
        T[:, 0, 3] = STEP_M * np.arange(self.num)
        return T, []


@pytest.fixture
def with_toys(monkeypatch, tmp_path) -> Path:
    """Small drives in place of towns, one peer that runs and one that is not installed; returns the weights."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_slam_comparison, "town_drive", lambda *_: toy.drive(1, num_scans=NUM_SCANS, step_m=STEP_M))
    peers = {PEER: ("json", SteadyPeer), "absent": ("no_such_module", SteadyPeer)}
    for module in (_slam_comparison, _slam_evaluation, _slam_peers):
        monkeypatch.setattr(module, "PEERS", peers)
    monkeypatch.setattr(_slam_comparison, "COLORS", {**_slam_comparison.COLORS, PEER: "#000000"})
    path = tmp_path / "model.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL), path)
    return path


def run(*arguments) -> int:
    return run_command(
        dpm_evaluate.main,
        dpm_evaluate.Config,
        name=dpm_evaluate.EXPERIMENT,
        description=dpm_evaluate.__doc__,
        args=list(map(str, arguments)),
    )


def drive_of(sequence: LidarSequence, folder: Path, is_stopped=lambda: False) -> Drive:
    return Drive(sequence, TableRun(RunFolder(folder, is_resumed=True), is_stopped), False)


def empty_scans(T_world_lidar: np.ndarray) -> LidarSequence:
    """A drive of which only the poses matter."""
    sources = tuple(f"scan {number}" for number in range(len(T_world_lidar)))
    return LidarSequence("made by hand", sources, lambda index: np.zeros((0, 3), np.float32), T_world_lidar)


@pytest.mark.slow
def test_every_method_gets_a_row_and_a_resumed_run_computes_nothing_again(
    with_toys, tmp_path, monkeypatch, capsys
) -> None:
    out = tmp_path / "out"
    arguments = ("--slam", "town", "--weights", with_toys, "--num-towns", 1, "--localize", 3, "-o", out)
    assert run(*arguments) == EXIT_OK
    printed = capsys.readouterr().out
    assert "absent was not run: no_such_module is not installed (pip install 'no_such_module')." in printed
    metrics = load_json(out / "metrics.json")
    rows = {row["method"]: row for row in metrics["rows"]}
    assert list(rows) == METHODS
    assert all(row["git_hash"] for row in metrics["rows"])
    assert rows[PEER]["ate_m"] == pytest.approx(0.0, abs=1e-6)
    assert rows[OURS]["num_scans"] == NUM_SCANS
    assert rows["localization, int8"]["num_scans"] == 3
    # Each tenth of six scans has one at most.
    assert all(len(rows[method]["scan_s_tenths"]) == NUM_SCANS for method in (PEER, OURS, NETWORK))
    assert rows[NETWORK]["num_loops"] == rows[NETWORK]["num_wrong_loops"] == 0
    assert rows[PEER]["map_bytes_nothing"] == rows[PEER]["map_scans"] == list(range(1, NUM_SCANS + 1))
    # Two runs with a state each, which differ in the source of the first guess.
    proposers = [
        load_state(path).state.slam_map.origin.config.odometry.proposer for path in out.glob("**/run_state.npz")
    ]
    assert sorted(proposers) == ["network", "prediction"]
    assert sum(rows[NETWORK]["scan_statuses"].values()) == rows[NETWORK]["num_scans"] == NUM_SCANS
    for name in ("table.md", "trajectories.png"):
        assert (out / name).stat().st_size > 0
    assert f"| toy 1 | {NUM_SCANS}, 10 m | {PEER} | 0.000 |" in (out / "table.md").read_text()
    monkeypatch.setattr("dpmjax.cli.map_drive", None)
    monkeypatch.setattr(SteadyPeer, "step", None)
    assert run("--resume", "-o", out) == EXIT_OK
    assert load_json(out / "metrics.json")["rows"] == metrics["rows"]


@pytest.mark.slow
def test_sizes_of_maps_are_those_of_the_files(with_toys, tmp_path) -> None:
    out = tmp_path / "out"
    assert run("--slam", "town", "--weights", with_toys, "--num-towns", 1, "--localize", 3, "-o", out) == EXIT_OK
    rows = {row["method"]: row for row in load_json(out / "metrics.json")["rows"]}
    ours, drive = rows[OURS], toy.drive(1, num_scans=NUM_SCANS, step_m=STEP_M)
    for precision in _slam_evaluation.PRECISIONS:
        path = out / "drives" / drive.name / f"map_{precision}.npz"
        assert ours[f"map_bytes_{precision}"][-1] == path.stat().st_size
        assert len(dpmjax.load_map(path)) <= ours["num_keyframes"]
        half = path.with_name(f"first_half_{precision}.npz")
        assert rows[f"localization, {precision}"]["map_bytes"] == half.stat().st_size
    num_points = sum(len(drive.read_scan(number)) for number in range(NUM_SCANS))
    assert ours["map_bytes_points"][-1] == 12 * num_points
    assert ours["map_scans"][-1] == NUM_SCANS
    assert (np.diff(ours["map_bytes_float32"]) > 0).all()


def test_scans_without_a_reference_are_left_out(tmp_path, monkeypatch) -> None:
    whole = toy.drive(num_scans=5)
    poses = whole.T_world_lidar.copy()
    poses[3] = np.nan
    monkeypatch.setattr("dpmjax.cli.open_drive", lambda *_: replace(whole, T_world_lidar=poses))
    (drive,) = _slam_comparison.open_drives((str(tmp_path),), DriveOptions())
    np.testing.assert_array_equal(drive.T_world_lidar, poses[[0, 1, 2, 4]])


def test_the_time_before_loops_is_that_of_the_run_without_them() -> None:
    stages_s = {"loops": 3.0, "write": 1.0, "decoder": 2.0, "thinning ahead": 9.0}
    run = SlamRun(None, (), stages_s, compile_s=0.0, run_s=10.0, scan_s=(2.0,) * 4, failure=None)
    assert _slam_evaluation._per_scan(run, _slam_evaluation._FILE_STAGES) == pytest.approx(9.0 / 4)
    assert _slam_evaluation._per_scan(run, _slam_evaluation._BEYOND_ODOMETRY) == pytest.approx(6.0 / 4)


def test_a_stopped_row_is_not_written(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(_slam_evaluation, "PEERS", {PEER: ("json", SteadyPeer)})
    calls = iter([False, False, True])
    drive = drive_of(toy.drive(num_scans=6), tmp_path, lambda: next(calls))
    with pytest.raises(RowStopped):
        _slam_evaluation.evaluate_peer(drive, PEER)
    assert not list(tmp_path.iterdir())


def test_a_scan_without_points_stays_where_the_last_one_was(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(_slam_evaluation, "PEERS", {PEER: ("json", SteadyPeer)})
    whole = toy.drive(num_scans=5)
    read = lambda index: np.zeros((0, 3), np.float32) if index in (0, 2) else whole.read_scan(index)  # noqa: E731
    sequence = LidarSequence(whole.name, whole.sources, read, whole.T_world_lidar)
    row = _slam_evaluation.evaluate_peer(drive_of(sequence, tmp_path), PEER)
    assert row["num_scans"] == 5
    np.testing.assert_allclose(np.load(tmp_path / f"{PEER}.npy")[:, 0, 3], [0, 0, 0, STEP_M, 2 * STEP_M])


def test_wrong_loops_are_counted_and_find_nothing(tmp_path) -> None:
    truth = laps(2, side_m=50.0)
    drive = drive_of(empty_scans(truth), tmp_path)

    def loop(newer: int, older: int, wrong_m: float = 0.0) -> FoundLoop:
        T = rigid.inverse(truth[older]) @ truth[newer] @ pose(wrong_m, 0.0, 0.0)
        return FoundLoop((newer, newer), (older, older), T)

    none = _slam_evaluation.loop_numbers(drive, [])
    assert (none["num_wrong_loops"], none["loop_recall"]) == (0, 0.0)
    wrong = _slam_evaluation.loop_numbers(drive, [loop(300, 100, wrong_m=2.5)])
    assert (wrong["num_wrong_loops"], wrong["loop_recall"]) == (1, 0.0)
    both = _slam_evaluation.loop_numbers(drive, [loop(300, 100, wrong_m=2.5), loop(250, 50, wrong_m=1.0)])
    assert both["num_wrong_loops"] == 1
    assert both["loop_recall"] * both["num_revisits"] == pytest.approx(21)
    # A loop between local maps counts for all scans of the newer one.
    whole = loop(200, 0)._replace(newer=(200, 399), older=(0, 199))
    assert _slam_evaluation.loop_numbers(drive, [whole])["loop_recall"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere"),
        (["town", "--weights", "no_such_model"], "no_such_model"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, arguments, message: str) -> None:
    assert run("--slam", *arguments, "-o", tmp_path / "out") == EXIT_BAD_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "out").exists()


def test_numbers_out_of_range_are_refused(tmp_path, capsys) -> None:
    for arguments in (["--town-length-m", 400, 500, 600], ["-n", 0], ["--localize", -1]):
        assert run("--slam", "town", *arguments, "-o", tmp_path / "out") == EXIT_BAD_INPUT
        assert arguments[0].strip("-") in capsys.readouterr().err.replace("n-scans", "n")
    assert not (tmp_path / "out").exists()


def test_scans_are_chosen_for_slam_only(tmp_path, capsys) -> None:
    assert run("town", "-n", 5, "-o", tmp_path / "out") == EXIT_BAD_INPUT
    assert "only with --slam" in capsys.readouterr().err


@pytest.mark.parametrize("name", list(_slam_peers.PEERS))
def test_a_peer_follows_a_straight_drive(name: str) -> None:
    reason = why_not_importable(_slam_peers.PEERS[name][0])
    if reason is not None:
        pytest.skip(reason)
    drive = toy.drive(num_scans=12, step_m=1.0)
    peer = _slam_peers.PEERS[name][1](is_indoors=False)
    for number in range(len(drive)):
        points = drive.read_scan(number).astype(np.float64)
        peer.step(points)
        peer.grow_map(points)
    T, loops = peer.finish()
    assert loops == []
    assert peer.map_bytes() > 1000
    assert dpmjax.absolute_trajectory_error(T[:, :3, 3], drive.T_world_lidar[:, :3, 3]) < 0.3
