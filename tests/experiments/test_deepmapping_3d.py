"""The command of DeepMapping of lidar clouds: options, bad input, a small run, resume."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dpmjax.cli.command import run_command
from dpmjax.io import read_poses, write_ply, write_tum
from experiments import deepmapping_3d
from experiments._cloud_input import add_noise


def run(*options) -> int:
    return run_command(
        deepmapping_3d.main,
        deepmapping_3d.Config,
        name=deepmapping_3d.EXPERIMENT,
        description=deepmapping_3d.__doc__,
        args=list(map(str, options)),
    )


@pytest.fixture
def drive(tmp_path):
    """Four scans of a box from one place, without poses."""
    (tmp_path / "drive").mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        beams = rng.normal(size=(400, 3))
        write_ply(tmp_path / "drive" / f"{number:03}.ply", 2.0 * beams / np.abs(beams).max(1, keepdims=True))
    return tmp_path / "drive"


def test_help_shows_examples(capsys) -> None:
    assert run("--help") == 0
    assert "python -m experiments.deepmapping_3d" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--window", "7:3"], "--window"),
        (["--window", "all"], "--window"),
        (["--init-noise", -1], "--init-noise"),
        (["--sequence", "00"], "--sequence"),
    ],
)
def test_wrong_usage_names_the_option(options, message, capsys) -> None:
    assert run(*options) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert "Traceback" not in errors


def test_bad_starts_are_one_line_and_leave_no_folder(drive, tmp_path, capsys) -> None:
    assert run("/no/such/folder") == 2
    assert "no such file or folder" in capsys.readouterr().err
    short = write_tum(tmp_path / "short.txt", np.tile(np.eye(4), (2, 1, 1)))
    for options, message in (([], "no poses"), (["--init", "guess"], "no such file"), (["--init", short], "2 poses")):
        assert run(drive, "-o", tmp_path / "out", *options) == 2
        errors = capsys.readouterr().err
        assert message in errors
        assert len(errors.strip().splitlines()) == 1
    assert run(drive, "-o", tmp_path / "out", "--window", "3:") == 2
    assert "chooses 1 of 4 scans" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_noise_has_the_size_that_was_asked_for() -> None:
    T = np.tile(np.eye(4), (4000, 1, 1))
    moved = add_noise(T, 0.2, seed=0)
    assert np.sqrt((moved[:, :3, 3] ** 2).sum(1).mean()) == pytest.approx(0.2, rel=0.05)
    angles = np.arccos(np.clip((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.degrees(np.sqrt((angles**2).mean())) == pytest.approx(1.0, rel=0.05)


@pytest.mark.slow
def test_a_run_writes_its_results_and_resumes(drive, tmp_path, capsys) -> None:
    start = write_tum(tmp_path / "start.txt", np.tile(np.eye(4), (4, 1, 1)))
    out = tmp_path / "out"
    assert run(drive, "--init", start, "--init-noise", 0.05, "--steps", 4, "-o", out) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["kept"] in ("fit", "start")
    assert metrics["steps"] == 4
    for name in ("config.json", "trajectory_kitti.txt", "map.ply", "map.png", "loss.png"):
        assert (out / name).is_file(), name
    kept = np.load(out / "trajectory.npy")
    np.testing.assert_allclose(read_poses(out / "trajectory_tum.txt"), kept, atol=1e-6)
    assert run("--resume", "-o", out) == 0
    np.testing.assert_array_equal(np.load(out / "trajectory.npy"), kept)
