"""The DeepPointMap benchmark: each stage has a process of its own, and each number stands beside its rival."""

import re

import numpy as np
import pytest

from benchmarks import Row, deeppointmap, in_new_process
from benchmarks.deeppointmap import THEIRS, stage_rows, time_encoding, time_matching, time_training, with_theirs
from tests.deeppointmap import toy


@pytest.fixture
def scans(monkeypatch):
    monkeypatch.setattr(deeppointmap.dpmjax, "model_preset", lambda name: toy.MODEL)
    monkeypatch.setattr(deeppointmap.dpm, "training_preset", lambda name: toy.TRAINING)
    angles, heights = np.linspace(0, 2 * np.pi, 400), np.tile(np.linspace(0, 3, 8), 50)
    # A star, because a ring looks like beams without an echo.
    star = np.stack([np.cos(angles), np.sin(angles)], 1) * (1 + 0.3 * np.sin(5 * angles))[:, None]
    return {name: np.column_stack([r * star, heights]).astype(np.float32) for name, r in (("town", 20), ("KITTI", 30))}


@pytest.mark.slow
def test_stage_runs_in_its_own_process() -> None:
    *times, memory = in_new_process(stage_rows, "match tiny", {}, True, JAX_PLATFORMS="cpu")
    assert {row.metric for row in times} == {"compile", "median", "min"}
    assert memory.case == "process of match tiny"
    assert 0.05 < memory.value < 4.0


def test_numbers_of_the_authors_follow_the_number_they_are_held_against() -> None:
    case = "paper, 256 x 256: overlap"
    rows = with_theirs([Row(case, "compile", 1.0, "s"), Row(case, "median", 20.0, "ms"), Row("other", "min", 1, "ms")])
    assert [row.metric for row in rows] == ["compile", "median", "median, authors' program", "min"]
    assert rows[2].value == 82.0


@pytest.mark.slow
def test_numbers_of_the_authors_have_a_case_and_speed_is_scans_over_the_time_of_a_step(scans) -> None:
    rows = time_encoding(scans, True, preset="tiny") + time_matching(scans, True, preset="tiny", num_target=256)
    training = {row.metric: row for row in time_training(scans, True, preset="tiny")}
    assert training["speed"].value == pytest.approx(4 / (1e-3 * training["median"].value))
    cases = {row.case.replace("tiny", "paper") for row in [*rows, *training.values()]}
    for case in THEIRS:
        assert re.sub(r"\d+ x \d+", "32 x 256", case) in cases
