"""Wrong usage of every experiment: one line, exit code 2, nothing written."""

import importlib

import pytest

from dpmjax.cli.run import EXIT_BAD_INPUT
from tests.experiments.running import run


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        ("toy_1d", "--seeds 0", "--seeds"),
        ("deepmapping_ablations", "--only colour", "--only"),
        ("deepmapping_rgbd", "--methods guess", "--methods"),
        ("deepmapping_rgbd", "--limit 0", "--limit"),
        ("deepmapping_rgbd", "/no/such/folder", "no such folder"),
        ("deepmapping_suite", "--methods nonsense", "--methods"),
        ("deepmapping_suite", "--limit 0", "--limit"),
        ("deepmapping_suite", "--steps 1", "--steps"),
        ("deepmapping_suite", "--stride 0", "--stride"),
        ("deepmapping_logs", "a.log --inits compass", "--inits: expected some of auto"),
        ("dpm_evaluate", "nowhere --weights model.safetensors", "nowhere"),
        ("dpm_evaluate", "town --weights no_such_model", "no_such_model"),
        ("dpm_evaluate", "town --weights model.safetensors --clouds 1", "--clouds"),
        ("dpm_slam_table", "nowhere", "nowhere"),
        ("dpm_slam_table", "drive --weights no_such_model", "no_such_model"),
        ("dpm_slam_table", "", "give at least one folder"),
        ("dpm_slam_table", "drive --localize 3 --methods paper", "--localize"),
        ("dpm_slam_table", "drive --methods nonsense", "--methods"),
    ],
)
def test_wrong_usage_is_told_in_one_line(module, arguments, message, weights, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.log").touch()
    experiment = importlib.import_module(f"experiments.{module}")
    assert run(experiment, *arguments.split(), "-o", tmp_path / "out") == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()
