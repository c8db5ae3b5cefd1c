"""The command that fits the weights of the evidence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dpmjax.cli.command import run_command
from dpmjax.cli.run_folder import METRICS
from experiments import dpm_evidence
from experiments.dpm_evidence import EXPERIMENT, Config, fit, main


def made_up_rows() -> list[dict]:
    """Hypotheses that are right with the odds of known weights."""
    rng, weights = np.random.default_rng(0), np.array([8.0, -3.0, 0.0, 0.0, 2.0, -5.0])
    rows = []
    for scene in range(4):
        pairs = []
        for _ in range(100):
            shares = rng.uniform(0, 1, (30, 6))
            is_right = rng.uniform(size=30) < 1 / (1 + np.exp(2 - shares @ weights))
            pairs.append({"band": "near", "shares": shares.tolist(), "is_right": is_right.tolist()})
        rows.append({"scene": scene, "kind": "a", "sensor": "b", "points": "c", "pairs": pairs})
    return rows


def test_the_weights_that_made_the_data_are_found() -> None:
    found, table = fit(made_up_rows())
    expected = {"bias": -2, "walls_met": 8, "walls_visible": -3, "level_visible": 2, "level_contradicted": -5}
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, abs=0.6), name
    assert len(table) == 4
    assert all(row["by_a_fit_on_the_others"] > row["by_the_present_weights"] for row in table)


@pytest.mark.slow
def test_a_small_run_writes_weights_and_table_and_resumes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(dpm_evidence, "SCENES", dpm_evidence.SCENES[:2])
    monkeypatch.setattr(dpm_evidence, "NUM_PAIRS", 2)
    arguments = ["-o", str(tmp_path)]
    for more in ([], ["--resume"]):
        assert run_command(main, Config, name=EXPERIMENT, description=None, args=[*arguments, *more]) == 0
    metrics = json.loads((tmp_path / METRICS).read_text())
    assert metrics["evidence"]["walls_contradicted"] < 0
    assert len((tmp_path / "table.md").read_text().splitlines()) == 4 + len(metrics["table"])
