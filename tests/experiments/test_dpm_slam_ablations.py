"""The ablations of SLAM on a network that compiles in seconds."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.result_files import load_json
from dpmjax.slam import init_slam, slam_preset, step_slam
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
    settings = (ablations.WHOLE, ablations.PAPER, "64 elements")
    dpmjax.save_model(model, tmp_path / "model.safetensors")
    folder = write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(1, num_scans=NUM_SCANS))
    out = tmp_path / "out"
    options = ("--weights", tmp_path / "model.safetensors", "--settings", *settings)
    assert run(folder.parents[1], *options, "-o", out) == EXIT_OK
    rows = load_json(out / "metrics.json")["rows"]
    assert [row["setting"] for row in rows] == list(settings)
    assert all(row["num_scans"] == NUM_SCANS for row in rows)
    # The pairs of random weights have large errors, so that no registration is accepted.
    assert rows[1]["scan_statuses"] == {"first": 1, "predicted": NUM_SCANS - 1}
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


def test_the_settings_of_the_paper_differ_in_the_limit_of_the_error_alone(model) -> None:
    paper, wide = (ablations.ablated(model, setting).config for setting in (ablations.PAPER, ablations.PAPER_WIDE))
    assert paper == slam_preset("paper")
    assert replace(wide, descriptors=paper.descriptors) == paper
    assert wide.descriptors.max_rmse_m == 2.5


def test_other_settings_change_one_thing(model) -> None:
    whole, network, nearest = (
        ablations.ablated(model, setting).config for setting in (ablations.WHOLE, ablations.NETWORK, ablations.NEAREST)
    )
    assert (network.odometry.proposer, network.front_end) == ("network", whole.front_end)
    assert (nearest.front_end.num_submap, nearest.odometry) == (1, whole.odometry)


def test_the_offset_head_is_off_only_where_a_setting_says_so(model) -> None:
    drive = toy.drive(1, num_scans=2)
    motions = []
    for setting in (ablations.NETWORK, ablations.NETWORK + ablations.NO_OFFSETS):
        methods = ablations.ablated(model, setting)
        source, target = (methods.matcher.encode(methods.geometry.thin(scan)) for scan in drive)
        motions.append(methods.matcher.propose(source, target, 1).T_target_source)
    assert np.abs(motions[1] - motions[0]).max() > 1e-6


def test_bad_input_is_one_line(tmp_path, capsys) -> None:
    assert run(tmp_path / "nowhere", "-o", tmp_path / "out") == EXIT_BAD_INPUT
    assert "nowhere" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
