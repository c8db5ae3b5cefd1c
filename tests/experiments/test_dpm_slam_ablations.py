"""The ablations of SLAM on a network that compiles in seconds."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.result_files import load_json
from dpmjax.slam import Submap, init_slam, local_map_of, step_slam
from experiments import dpm_slam_ablations as ablations
from tests.data_sets import write_kitti_sequence
from tests.deeppointmap import toy

NUM_SCANS = 4


def run(*arguments) -> int:
    return run_command(
        ablations.main,
        ablations.Config,
        name=ablations.EXPERIMENT,
        description=ablations.__doc__,
        args=list(map(str, arguments)),
    )


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.SLAM_MODEL)


@pytest.mark.slow
def test_every_setting_gets_a_row_and_a_resumed_run_computes_nothing_again(model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(ablations, "SETTINGS", (ablations.WHOLE, ablations.DECODER, "16 elements"))
    dpmjax.save_model(model, tmp_path / "model.safetensors")
    folder = write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(1, num_scans=NUM_SCANS))
    out = tmp_path / "out"
    assert run(folder.parents[1], "--weights", tmp_path / "model.safetensors", "-o", out) == EXIT_OK
    rows = load_json(out / "metrics.json")["rows"]
    assert [row["setting"] for row in rows] == list(ablations.SETTINGS)
    assert all(row["num_scans"] == NUM_SCANS for row in rows)
    # The decoder of random weights proposes the pose of every scan after the first, and nothing refuses it.
    assert rows[1]["scan_statuses"] == {"first": 1, "network": NUM_SCANS - 1}
    assert (out / "table.md").read_text().count("\n") == 2 + len(rows)
    monkeypatch.setattr(ablations, "evaluate", pytest.fail)
    assert run("--resume", "-o", out) == EXIT_OK
    assert load_json(out / "metrics.json")["rows"] == rows


@pytest.mark.parametrize("num_elements", [16, 24])
def test_a_map_of_fewer_elements_holds_the_first_ones(model, num_elements: int) -> None:
    drive = toy.drive(1, num_scans=1)
    maps = [
        step_slam(ablations.ablated(model, setting), init_slam(), drive[0])[0].slam_map
        for setting in (ablations.WHOLE, f"{num_elements} elements")
    ]
    whole, fewer = (slam_map.keyframes[0].compact for slam_map in maps)
    np.testing.assert_array_equal(fewer.elements.positions, whole.elements.positions[:num_elements])
    np.testing.assert_array_equal(fewer.features, whole.features[:num_elements])
    assert len(fewer.cloud.described.mask) == min(num_elements, len(whole.features))


def test_the_first_elements_of_a_scan_keep_their_normals(model) -> None:
    points = toy.drive(1, num_scans=1)[0]
    whole, few = (
        ablations.ablated(model, setting).geometry.thin(points).measured.surface
        for setting in (ablations.WHOLE, "16 elements")
    )
    for name in ("points", "normals", "flatness"):
        np.testing.assert_array_equal(getattr(few, name), getattr(whole, name)[:16])
    np.testing.assert_array_equal(few.samples, [row for row in whole.samples if row < 16])


def test_without_elements_poses_and_loops_stay_as_they_are_proposed(model) -> None:
    drive, methods = toy.drive(1, num_scans=2), ablations.ablated(model, ablations.DECODER)
    slam_map, scan = step_slam(methods, init_slam(), drive[0])[0].slam_map, methods.geometry.thin(drive[1])
    local_map = local_map_of(slam_map, (), methods.config.odometry)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, 3] = [0.1, -0.2, 0.05], [3.0, 0.0, 0.0]
    for found in (methods.geometry.search(local_map, scan, T), methods.geometry.align(local_map, scan, T[0])):
        np.testing.assert_array_equal(found.T_map_scan, T[0])
    source, target = methods.matcher.encode(scan), slam_map.keyframes[0].compact
    (match,) = methods.matcher.register([tuple(Submap((one,), np.eye(4)[None]) for one in (source, target))])
    np.testing.assert_array_equal(match.T_target_source, methods.matcher.propose(source, target, 1).T_target_source[0])
    assert match.verification is None


def test_other_settings_change_one_thing(model) -> None:
    whole, network, nearest = (
        ablations.ablated(model, setting).config for setting in (ablations.WHOLE, ablations.NETWORK, ablations.NEAREST)
    )
    assert (network.odometry.proposer, network.front_end) == ("network", whole.front_end)
    assert (nearest.front_end.num_submap, nearest.odometry) == (1, whole.odometry)


def test_the_offset_head_is_off_only_where_a_setting_says_so(model) -> None:
    drive = toy.drive(1, num_scans=2)
    motions = []
    for setting in (ablations.DECODER, ablations.DECODER + ablations.NO_OFFSETS):
        methods = ablations.ablated(model, setting)
        source, target = (methods.matcher.encode(methods.geometry.thin(scan)) for scan in drive)
        motions.append(methods.matcher.propose(source, target, 1).T_target_source)
    assert np.abs(motions[1] - motions[0]).max() > 1e-6


def test_bad_input_is_one_line(tmp_path, capsys) -> None:
    assert run(tmp_path / "nowhere", "-o", tmp_path / "out") == EXIT_BAD_INPUT
    assert "nowhere" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
