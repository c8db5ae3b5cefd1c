"""The table of SLAM: settings on a network that compiles in seconds, agents that know the truth, a peer that does."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli import why_not_importable
from dpmjax.cli.run import EXIT_OK, load_json
from dpmjax.geometry import rigid
from dpmjax.io import LidarSequence
from dpmjax.slam import Localization, SlamConfig, SlamMethods
from experiments import _slam_peers
from experiments import dpm_slam_table as table
from experiments._slam_peers import FoundLoop
from tests.data_sets import write_kitti_sequence
from tests.deeppointmap import toy
from tests.experiments.running import read_rows, run
from tests.slam.truth import TruthGeometry, TruthMatcher, laps, pose

PEER = "jax"
STEP_M, NUM_SCANS = 1.9, 6


class SteadyPeer:
    def __init__(self, *, is_indoors: bool) -> None:
        self.num = 0

    def step(self, points: np.ndarray) -> None:
        assert points.dtype == np.float64
        assert len(points)
        self.num += 1

    def finish(self):
        T = np.tile(np.eye(4), (self.num, 1, 1))
        T[:, 0, 3] = STEP_M * np.arange(self.num)
        return T, []

    def map_bytes(self, scans) -> int:
        return sum(map(len, scans))


@pytest.fixture
def with_peer(monkeypatch) -> None:
    monkeypatch.setitem(_slam_peers.PEERS, PEER, ("json", SteadyPeer))


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL)


def drive_along(T_world_lidar: np.ndarray) -> LidarSequence:
    """A drive of which only the poses matter: a scan is one point, whose x is the number of its pose."""
    sources = tuple(f"scan {number}" for number in range(len(T_world_lidar)))
    return LidarSequence("by hand", sources, lambda index: np.float32([[index, 1, 0]]), T_world_lidar)


@pytest.mark.slow
@pytest.mark.usefixtures("with_peer")
def test_every_method_gets_a_row_and_a_resumed_run_computes_nothing_again(model, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = toy.drive(1, num_scans=NUM_SCANS, step_m=STEP_M)
    write_kitti_sequence(tmp_path / "kitti", "00", drive)
    dpmjax.save_model(model, tmp_path / "model.safetensors")
    out, methods = tmp_path / "out", (PEER, table.WHOLE, table.NETWORK, table.PAPER, "agents")
    options = ("--weights", "model.safetensors", "--localize", 3, "-o", out)
    assert run(table, "kitti", "--methods", *methods, *options) == EXIT_OK
    rows = {row["method"]: row for row in read_rows(out)}
    assert tuple(rows) == methods
    assert float(rows[PEER]["ate_m"]) == pytest.approx(0.0, abs=1e-6)
    num_points = sum(len(drive.read_scan(number)) for number in range(NUM_SCANS))
    assert float(rows[PEER]["map_mb"]) == pytest.approx(num_points / 1e6)
    for method in methods[:-1]:
        assert int(rows[method]["num_scans"]) == NUM_SCANS
        assert rows[method]["num_loops"] == rows[method]["num_wrong_loops"] == "0"
        assert float(rows[method]["scan_s_last_tenth"]) > 0
    (path,) = out.glob(f"drives/*/{table.WHOLE}/map_int8.npz")
    assert float(rows[table.WHOLE]["map_int8_mb"]) == path.stat().st_size / 1e6
    assert len(dpmjax.load_map(path)) == int(rows[table.WHOLE]["num_keyframes"])
    places = read_rows(out, "places.csv")
    assert [(row["precision"], row["num_scans"]) for row in places] == [("float32", "3"), ("int8", "3")]
    assert len(load_json(out / "metrics.json")["table"]) == len(methods)
    monkeypatch.setattr("dpmjax.cli.map_drive", None)
    monkeypatch.setattr(SteadyPeer, "step", None)
    assert run(table, "--resume", "-o", out) == EXIT_OK
    assert read_rows(out) == list(rows.values())


def test_agents_that_meet_share_one_frame(tmp_path, monkeypatch) -> None:
    truth = laps(1, side_m=40.0, step_m=2.0)
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth, sigma_m=0.02), SlamConfig())
    monkeypatch.setattr(table, "OVERLAP", 0.5)
    row = table.map_by_agents(tmp_path, drive_along(truth), methods)
    assert row["num_maps"] == 1
    assert row["ate_m"] < 1.0
    assert row["num_loops"] >= 4
    assert row["num_wrong_loops"] == 0
    assert len(dpmjax.load_map(tmp_path / "map_1.npz")) == row["num_keyframes"]
    monkeypatch.setattr(table, "OVERLAP", 0.0)
    apart = table.map_by_agents(tmp_path / "apart", drive_along(truth), methods)
    assert apart["num_maps"] > 1
    assert apart["ate_m"] is None


def test_parts_overlap_and_hold_all_scans() -> None:
    drive = toy.drive(num_scans=25)
    for num_agents, overlap in ((1, 0.05), (3, 0.0), (3, 0.05), (4, 0.5)):
        parts = table.cut_drive(drive, num_agents, overlap)
        numbers = [[int(source) for source in part.sources] for part in parts]
        assert sorted({number for part in numbers for number in part}) == list(range(25))
        assert all(part == list(range(part[0], part[-1] + 1)) for part in numbers)
        num_shared = sum(map(len, numbers)) - 25
        assert abs(num_shared - 2 * (num_agents - 1) * overlap * 25 / num_agents) <= 2 * num_agents
    with pytest.raises(ValueError, match="25 scans are too few"):
        table.cut_drive(drive, 26, 0.05)


@pytest.mark.usefixtures("with_peer")
def test_a_scan_without_points_stays_where_the_last_one_was(tmp_path) -> None:
    whole = toy.drive(num_scans=5)
    read = lambda index: np.zeros((0, 3), np.float32) if index in (0, 2) else whole.read_scan(index)  # noqa: E731
    row = table.map_by_peer(tmp_path, replace(whole, read_scan=read), lambda: False, PEER)
    assert row["num_scans"] == 5
    np.testing.assert_allclose(np.load(tmp_path / "trajectory.npy")[:, 0, 3], [0, 0, 0, STEP_M, 2 * STEP_M])


@pytest.mark.usefixtures("with_peer")
def test_a_drive_that_a_signal_stops_has_no_row(tmp_path) -> None:
    truth = laps(1, side_m=20.0)
    place = tmp_path, drive_along(truth), lambda: True
    assert table.map_by_peer(*place, PEER) is None
    methods = SlamMethods(TruthMatcher(truth), TruthGeometry(truth), SlamConfig())
    assert table.map_by_setting(*place, methods) is None


def test_errors_of_found_scans_are_those_of_the_keyframes_frames() -> None:
    truth = laps(1, side_m=20.0)
    slam_map = SimpleNamespace(T_world_keyframe=pose(4.0, -2.0, 0.3) @ truth[:2])
    found = [
        Localization("found", slam_map.T_world_keyframe[0] @ rigid.inverse(truth[0]) @ truth[1] @ shift, 0.9, 0, "")
        for shift in (pose(0.0, 0.0, 0.0), pose(3.0, 0.0, 0.0), pose(0.5, 0.0, 0.0))
    ]
    errors_m = [table.localization_error(one, slam_map, truth[:2], truth[1]) for one in found]
    assert errors_m == [pytest.approx(0.0, abs=1e-6), None, pytest.approx(0.5)]


def test_wrong_loops_are_counted_and_find_nothing(tmp_path) -> None:
    truth = laps(2, side_m=50.0)

    def loop(newer: int, older: int, wrong_m: float = 0.0) -> FoundLoop:
        T = rigid.inverse(truth[older]) @ truth[newer] @ pose(wrong_m, 0.0, 0.0)
        return FoundLoop((newer, newer), (older, older), T)

    def measure(*loops: FoundLoop) -> dict:
        drive = replace(drive_along(truth), read_scan=lambda _: np.float32([[20, 0, 0]]))
        return table.measure_trajectory(tmp_path, drive, truth, list(loops))

    assert (measure()["num_wrong_loops"], measure()["loop_recall"]) == (0, 0.0)
    wrong = measure(loop(300, 100, wrong_m=2.5))
    assert (wrong["num_wrong_loops"], wrong["loop_recall"]) == (1, 0.0)
    both = measure(loop(300, 100, wrong_m=2.5), loop(250, 50, wrong_m=1.0))
    assert both["num_wrong_loops"] == 1
    assert 0.0 < both["loop_recall"] < 0.2
    # A loop between local maps counts for all scans of the newer one.
    assert measure(loop(200, 0)._replace(newer=(200, 399), older=(0, 199)))["loop_recall"] == 1.0


@pytest.mark.parametrize("name", list(_slam_peers.PEERS))
def test_a_peer_follows_a_straight_drive(name: str) -> None:
    reason = why_not_importable(_slam_peers.PEERS[name][0])
    if reason is not None:
        pytest.skip(reason)
    drive = toy.drive(num_scans=12, step_m=1.0)
    scans = [drive.read_scan(number).astype(np.float64) for number in range(len(drive))]
    peer = _slam_peers.PEERS[name][1](is_indoors=False)
    for points in scans:
        peer.step(points)
    T, loops = peer.finish()
    assert loops == []
    assert name == "small_gicp" or peer.map_bytes(scans) > 1000
    assert dpmjax.absolute_trajectory_error(T[:, :3, 3], drive.T_world_lidar[:, :3, 3]) < 0.3


def test_the_offset_head_is_off_only_where_a_setting_says_so(model) -> None:
    drive, motions = toy.drive(1, num_scans=2), []
    for setting in (table.NETWORK, table.NETWORK + table.NO_OFFSETS):
        methods = table.make_setting(model, setting)
        source, target = (methods.matcher.encode(methods.geometry.thin(scan)) for scan in drive)
        motions.append(methods.matcher.propose(source, target, 1).T_target_source)
    assert np.abs(motions[1] - motions[0]).max() > 1e-6
