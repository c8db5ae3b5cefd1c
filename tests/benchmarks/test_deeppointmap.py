"""The DeepPointMap benchmark: each stage in a process of its own, each number beside what it is held against."""

from __future__ import annotations

import re
from functools import partial

import numpy as np
import pytest

from benchmarks import Row, deeppointmap
from benchmarks.deeppointmap import (
    FIGURES,
    QUICK,
    STAGES,
    read_scans,
    run_stage,
    time_encoding,
    time_jax_builders,
    time_matching,
    time_training,
    with_figures,
)
from tests.deeppointmap import toy


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two scans of a ring of posts, for a toy model."""
    monkeypatch.setattr(deeppointmap.dpmjax, "model_preset", lambda name: toy.MODEL)
    monkeypatch.setattr(deeppointmap.dpm, "training_preset", lambda name: toy.TRAINING)
    angles = np.linspace(0, 2 * np.pi, 400)
    for name, radius in (("town", 20.0), ("KITTI", 30.0)):
        heights = np.tile(np.linspace(0, 3, 8), 50)
        points = np.stack([radius * np.cos(angles), radius * np.sin(angles), heights], axis=1)
        np.save(tmp_path / f"{name}.npy", points.astype(np.float32))
    return tmp_path


def test_every_stage_that_is_run_exists() -> None:
    assert set(QUICK) <= set(STAGES)


def test_scans_come_back_by_name(folder) -> None:
    assert [(name, points.shape) for name, points in read_scans(folder).items()] == [
        ("town", (400, 3)),
        ("KITTI", (400, 3)),
    ]


@pytest.mark.slow
def test_stage_runs_in_its_own_process(tmp_path) -> None:
    speed, memory = run_stage("products", tmp_path, quick=True, platform="cpu")
    assert (speed.metric, speed.unit) == ("speed", "GFLOP/s")
    assert speed.value > 0
    assert memory.case == "process of products"
    assert 0.05 < memory.value < 4.0


def test_figures_follow_the_number_they_are_held_against() -> None:
    case = "paper, one pair: overlap"
    rows = with_figures([Row(case, "compile", 1.0, "s"), Row(case, "median", 20.0, "ms"), Row("other", "min", 1, "ms")])
    assert [row.metric for row in rows] == ["compile", "median", "median, authors' program", "median, goal", "min"]
    assert [row.value for row in rows[2:4]] == [82.0, 40.0]


@pytest.mark.slow
def test_figures_have_a_case(folder) -> None:
    timed = [
        partial(time_encoding, preset="tiny"),
        partial(time_matching, preset="tiny", num_target=256),
        partial(time_training, preset="tiny"),
    ]
    cases = {row.case.replace("tiny", "paper") for stage in timed for row in stage(folder, quick=True)}
    for case in FIGURES:
        if "overlap" not in case and "process" not in case:
            toy_case = re.sub(r"\d+ x \d+", "32 x 256", case.replace("small", "paper"))
            assert toy_case.replace("16 scans", "4 scans") in cases


@pytest.mark.slow
def test_compile_time_is_told_of_what_is_compiled(folder) -> None:
    rows = time_jax_builders(folder, quick=True, preset="tiny")
    assert [row.case.split(": ")[1] for row in rows if row.metric == "compile"] == [
        "preprocess in JAX",
        "pyramid in JAX",
        "network",
    ]


@pytest.mark.slow
def test_speed_of_training_is_scans_over_the_time_of_a_step(folder) -> None:
    rows = {row.metric: row for row in time_training(folder, quick=True, preset="tiny")}
    assert rows["speed"].value == pytest.approx(4 / (1e-3 * rows["median"].value))
    assert {row.case for row in rows.values()} == {"tiny, K = 2, 4 scans: training step"}
