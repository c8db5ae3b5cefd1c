"""`dpmjax evaluate` on a network that compiles in seconds."""

from __future__ import annotations

import itertools
import os
import signal

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax import deeppointmap, simulation
from dpmjax.cli import drives
from dpmjax.cli.evaluate import table
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_BAD_INPUT, EXIT_OK, load_json
from dpmjax.deeppointmap import SamplingConfig, scan_evaluation
from tests.data_sets import write_kitti_sequence
from tests.deeppointmap import toy


def run(arguments: list[str]) -> int:
    return main(["evaluate", *arguments])


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "model.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.MODEL), path, card="toy")
    return path


@pytest.mark.slow
def test_a_town_is_evaluated_and_nothing_is_registered_twice(weights, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    out = tmp_path / "out"
    assert run(["--weights", str(weights), "--pairs", "2", "-o", str(out)]) == EXIT_OK
    printed = capsys.readouterr().out
    assert "| toy 5000000 | 2-10 m | 2 |" in printed
    assert "| toy 5000000 | 10-20 m | 2 |" in printed
    assert "Brier score of the confidence" in printed
    assert "(0 is best; these weights are not calibrated)" in printed
    metrics = load_json(out / "metrics.json")
    assert [row["band"] for row in metrics["rows"]] == ["near", "middle", "far", "overlap"]
    assert metrics["is_calibrated"] is False
    near = metrics["rows"][0]
    assert len(near["translation_errors_refined_m"]) == len(near["confidence"]) == 2
    assert near["pair_s"] > 0
    assert 0 <= metrics["rows"][3]["auc"] <= 1
    for name in ("table.md", "reliability.png", "config.json", "log.txt"):
        assert (out / name).exists()
    monkeypatch.setattr(deeppointmap, "evaluate_scan_pairs", None)
    assert run(["--resume", "-o", str(out)]) == EXIT_OK
    assert load_json(out / "metrics.json")["rows"] == metrics["rows"]


@pytest.mark.slow
@pytest.mark.parametrize("num_registered", [1, 4])
def test_ctrl_c_within_a_band_keeps_the_rows_before_it(weights, tmp_path, monkeypatch, num_registered: int) -> None:
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    out, register, count = tmp_path / "out", scan_evaluation.register_in_stages, itertools.count(1)

    def interrupting(*arguments):
        if next(count) == num_registered:
            os.kill(os.getpid(), signal.SIGINT)
        return register(*arguments)

    # The first pair of a band is registered twice.
    monkeypatch.setattr(scan_evaluation, "register_in_stages", interrupting)
    assert run(["--weights", str(weights), "--pairs", "2", "-o", str(out)]) == 130
    stopped = load_json(out / "metrics.json")
    assert stopped["status"] == "interrupted"
    assert [row["band"] for row in stopped["rows"]] == ["near"][: num_registered // 4]
    assert next(count) <= num_registered + 3
    assert run(["--resume", "-o", str(out)]) == EXIT_OK
    whole = load_json(out / "metrics.json")
    assert whole["status"] == "done"
    assert [row["band"] for row in whole["rows"]] == ["near", "middle", "far", "overlap"]
    assert whole["rows"][: len(stopped["rows"])] == stopped["rows"]


def test_a_folder_of_scans_with_poses_is_evaluated(weights, tmp_path, capsys) -> None:
    write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(num_scans=6))
    arguments = [str(tmp_path / "kitti"), "--weights", str(weights), "--pairs", "1", "-o", str(tmp_path / "out")]
    assert run(arguments) == EXIT_OK
    assert "| 2-10 m | 1 |" in capsys.readouterr().out
    # No two scans are so far apart: those rows are empty.
    by_band = {row["band"]: row for row in load_json(tmp_path / "out" / "metrics.json")["rows"]}
    assert (by_band["far"]["num_pairs"], by_band["overlap"]["auc"]) == (0, None)


def test_a_drive_is_checked_with_the_distances_that_are_asked_for(tmp_path) -> None:
    write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(num_scans=6))
    assert len(drives.find_sources([str(tmp_path / "kitti")], [])) == 1
    near = SamplingConfig(max_distance_m=3.0)
    with pytest.raises(ValueError, match=r"no two of them 0\.25 to 3\.0 m apart"):
        drives.find_sources([str(tmp_path / "kitti")], [], near)


def test_a_table_of_no_right_registration_has_no_median() -> None:
    row = {"sequence": "a", "band": "near", "num_pairs": 1, "pair_s": 0.5, "is_right": [False]}
    for stage in ("descriptors", "verified", "refined"):
        row |= {f"recall_{stage}": 0.0, f"median_error_{stage}_m": np.nan}
    assert table([row]).splitlines()[-1] == "| a | 2-10 m | 1 | 0.00 | 0.00 | 0.00 (0.00 to 0.79) | - | - | 0.50 | - |"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere"),
        (["WITHOUT_POSES"], "no poses"),
        (["--weights", "no_such_model"], "no_such_model"),
        (["--pairs", "0"], "--pairs"),
    ],
)
def test_bad_input_is_named_with_exit_code_2(as_user, tmp_path, capsys, arguments, message: str) -> None:
    (tmp_path / "drive" / "velodyne").mkdir(parents=True)
    for number in range(3):
        np.ones((50, 4), "<f4").tofile(tmp_path / "drive" / "velodyne" / f"{number:06d}.bin")
    given = [str(tmp_path / "drive") if argument == "WITHOUT_POSES" else argument for argument in arguments]
    assert run([*given, "-o", str(tmp_path / "out")]) == EXIT_BAD_INPUT
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
