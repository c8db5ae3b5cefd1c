"""The commands of the smaller experiments: options, tiny runs, resume."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from dpmjax.cli.command import run_command
from dpmjax.simulation import simulate_sequence
from experiments import deepmapping_ablations, deepmapping_relocalize, deepmapping_rgbd, toy_1d

MODULES = (deepmapping_ablations, deepmapping_relocalize, deepmapping_rgbd, toy_1d)


def run(module, *options) -> int:
    arguments = list(map(str, options))
    return run_command(module.main, module.Config, name=module.EXPERIMENT, description=module.__doc__, args=arguments)


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.EXPERIMENT)
def test_help_shows_examples(module, capsys) -> None:
    assert run(module, "--help") == 0
    assert f"python -m experiments.{module.EXPERIMENT}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("module", "options", "message"),
    [
        (toy_1d, ["--seeds", 0], "--seeds"),
        (toy_1d, ["--device", "tpu"], "--device"),
        (deepmapping_ablations, ["--only", "colour"], "--only"),
        (deepmapping_rgbd, ["--methods", "guess"], "--methods"),
        (deepmapping_rgbd, ["--limit", 0], "--limit"),
    ],
)
def test_wrong_usage_names_the_option(module, options, message, capsys) -> None:
    assert run(module, *options) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("module", "options", "message"),
    [
        (deepmapping_rgbd, ["/no/such/folder"], "no such folder"),
        (deepmapping_relocalize, ["/no/such/run"], "config.json"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(module, options, message, capsys) -> None:
    assert run(module, *options) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert len(errors.strip().splitlines()) == 1


@pytest.mark.slow
def test_toy_writes_its_pictures_and_shares(tmp_path, capsys) -> None:
    options = ["--seeds", 4, "--steps", 3, "-o", tmp_path / "out"]
    assert run(toy_1d, *options) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["x_global"] == pytest.approx(-1.417, abs=1e-3)
    assert len(metrics["share_at_global_minimum"]) == 5
    assert {row["initialization"] for row in metrics["variants"]} >= {"xavier-relu", "pytorch"}
    assert (tmp_path / "out" / "toy.png").exists()


def test_the_chosen_seed_is_one_that_tells_the_story() -> None:
    x = -1.41707
    network = np.array([[0.0, 4.0], [9.0, x], [1.0, x], [2.0, x]])
    direct = np.array([[0.0, 4.0], [9.0, 8.9], [1.0, x], [2.0, 2.3]])
    assert toy_1d.choose_seed(network, direct) == 3


@pytest.mark.slow
def test_rgbd_resumes_trajectory_by_trajectory(tmp_path) -> None:
    out = tmp_path / "out"
    assert run(deepmapping_rgbd, "--limit", 1, "--methods", "zero", "-o", out) == 0
    first = json.loads((out / "metrics.json").read_text())["rows"]
    assert run(deepmapping_rgbd, "--resume", "-o", out, "--limit", 2) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    rows = metrics["rows"]
    assert rows[:1] == first
    assert [row["views"] for row in rows] == [8, 16]
    assert metrics["num_trajectories"] == 2
    assert metrics["methods"]["zero"]["median_ate_mm"] > 0.0


def test_multiway_without_open3d_is_refused_before_the_run(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert run(deepmapping_rgbd, "--methods", "multiway", "-o", tmp_path / "out") == 2
    assert "--methods multiway: open3d is not installed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_not_moving_is_never_right_on_hard_walks(tmp_path) -> None:
    out = tmp_path / "out"
    assert run(deepmapping_rgbd, "--walks", "hard", "--limit", 2, "--methods", "zero", "-o", out) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert [row["views"] for row in metrics["rows"]] == [16, 16]
    for row in metrics["rows"]:
        assert row["zero"]["ate_mm"] == pytest.approx(row["spread_mm"])
        assert row["spread_mm"] >= 450
    assert (metrics["methods"]["zero"]["success"], metrics["methods"]["zero"]["right"]) == (0, 0)


def test_ablations_change_one_thing_each() -> None:
    basis = deepmapping_ablations.settings_of("lnet", "CNN", 600)
    for ablation, variants in deepmapping_ablations.VARIANTS.items():
        settings = [deepmapping_ablations.settings_of(ablation, variant, 600) for variant in variants]
        assert len(set(settings)) == len(variants)
        for one in settings:
            changed = (
                (one.localization != basis.localization)
                + (one.occupancy != basis.occupancy)
                + (one.cold_phases != basis.cold_phases)
            )
            assert changed <= (2 if ablation == "mnet" else 1)


def test_interval_of_the_median_draws_whole_trajectories() -> None:
    trajectories = np.repeat(np.arange(10), 3)
    values = np.random.default_rng(0).normal(size=30)
    low, high = deepmapping_ablations.interval_of_median(values, trajectories.tolist())
    assert low < np.median(values) < high
    # Equal runs of a trajectory say nothing more than one of them.
    repeated = deepmapping_ablations.interval_of_median(np.repeat(values[:10], 3), trajectories.tolist())
    assert repeated == deepmapping_ablations.interval_of_median(values[:10], list(range(10)))
    assert deepmapping_ablations.interval_of_median(values, [0] * 30) == [np.median(values)] * 2


def test_scans_of_the_bare_network_have_the_heading_of_the_nearest_scan() -> None:
    walk = simulate_sequence(0, 6, num_beams=16)
    near = walk.reference_poses[[4, 1]] + np.array([0.1, -0.1, 2.0])
    turned = deepmapping_relocalize.turn_to_nearest(near, walk)
    np.testing.assert_array_equal(turned[:, :2], near[:, :2])
    np.testing.assert_array_equal(turned[:, 2], walk.reference_poses[[4, 1], 2])


def test_relocalization_tells_known_from_right_and_mapped() -> None:
    walk = simulate_sequence(0, 4, num_beams=16)
    truth = walk.reference_poses + np.array([0.0, 15.0, 0.0])
    queries = deepmapping_relocalize.Queries(
        errors=np.array([1.0, 3.0, 90.0, 500.0]),
        turns=np.array([0.1, 0.3, 9.0, 50.0]),
        is_known=np.array([True, False, True, False]),
        is_mapped=np.array([True, True, False, False]),
        nats=np.array([0.1, 0.8, 0.6, 1.2]),
    )
    found = deepmapping_relocalize.summarise(queries, truth, walk)
    assert found["precision_of_known"] == 0.5
    assert (found["share_of_mapped_known"], found["share_of_unmapped_known"]) == (0.5, 0.5)
    groups = found["groups"]
    assert groups["mapped"] == {
        "num_poses": 2, "median_px": 2.0, "median_deg": 0.2, "share_below_20_px": 1.0, "share_known": 0.5
    }  # fmt: skip
    assert groups["mapped and known"]["median_px"] == 1.0
    assert groups["not mapped"]["share_below_20_px"] == 0.0
    assert sum(row["num_poses"] for name, row in groups.items() if name.startswith("mapped, ")) == 2
