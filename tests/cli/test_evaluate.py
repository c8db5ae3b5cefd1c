"""`dpmjax evaluate` on a network that compiles in seconds."""

import numpy as np
import pytest

from dpmjax import deeppointmap, simulation
from dpmjax.cli import drives
from dpmjax.cli.program import main
from dpmjax.cli.run import EXIT_OK, load_json
from dpmjax.deeppointmap import SamplingConfig
from tests.data_sets import write_kitti_sequence
from tests.deeppointmap import toy
from tests.experiments.running import read_rows


def run(arguments: list[str]) -> int:
    return main(["evaluate", *arguments])


@pytest.mark.slow
def test_a_town_is_evaluated_and_nothing_is_registered_twice(weights, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    out = tmp_path / "out"
    assert run(["--weights", str(weights), "--pairs", "2", "-o", str(out)]) == EXIT_OK
    printed, metrics, rows = capsys.readouterr().out, load_json(out / "metrics.json"), read_rows(out)
    assert "| toy 5000000 | near | 2 |" in printed
    assert "| toy 5000000 | middle | 2 |" in printed
    assert metrics["verdict"] in printed
    assert metrics["verdict"].endswith("(0 is best; these weights are not calibrated)")
    assert [row["band"] for row in rows] == [band for band in ("near", "middle", "far") for _ in range(2)]
    assert metrics["is_calibrated"] is False
    right = np.array([row["refined_right"] == "True" for row in rows])
    confidence = np.array([float(row["confidence"]) for row in rows])
    assert metrics["brier"] == pytest.approx(np.mean((confidence - right) ** 2))
    assert 0 <= float(read_rows(out, "overlap.csv")[0]["auc"]) <= 1
    for name in ("table.md", "reliability.png", "config.json", "log.txt"):
        assert (out / name).exists()
    monkeypatch.setattr(deeppointmap, "evaluate_overlap", None)
    assert run(["--resume", "-o", str(out)]) == EXIT_OK
    assert read_rows(out) == rows
    assert load_json(out / "metrics.json")["table"] == metrics["table"]


def test_a_folder_of_scans_with_poses_is_evaluated(weights, tmp_path, capsys) -> None:
    write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(num_scans=6))
    arguments = [str(tmp_path / "kitti"), "--weights", str(weights), "--pairs", "1", "-o", str(tmp_path / "out")]
    assert run(arguments) == EXIT_OK
    assert "| near | 1 |" in capsys.readouterr().out
    # No two scans are far apart.
    assert [row["band"] for row in read_rows(tmp_path / "out")] == ["near", "middle"]
    assert read_rows(tmp_path / "out", "overlap.csv")[0]["auc"] in ("", "nan")


def test_a_drive_is_checked_with_the_distances_that_are_asked_for(tmp_path) -> None:
    write_kitti_sequence(tmp_path / "kitti", "00", toy.drive(num_scans=6))
    assert len(drives.find_sources([str(tmp_path / "kitti")], [])) == 1
    near = SamplingConfig(max_distance_m=3.0)
    with pytest.raises(ValueError, match=r"no two of them 0\.25 to 3\.0 m apart"):
        drives.find_sources([str(tmp_path / "kitti")], [], near)
