"""The comparison of predictions of overlap, on a network that compiles in seconds."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import dpmjax
from dpmjax import simulation
from dpmjax.cli.command import EXIT_BAD_INPUT, EXIT_OK, run_command
from dpmjax.cli.result_files import load_json
from dpmjax.deeppointmap import OVERLAP_FEATURES
from dpmjax.metrics import area_under_curve
from experiments import dpm_calibrate, dpm_overlap
from experiments.dpm_overlap import Examples, head_logits, train_head
from tests.deeppointmap import toy


@pytest.fixture(scope="module")
def model() -> dpmjax.Model:
    return dpmjax.init_model(jax.random.key(0), toy.MODEL)


def run(*arguments) -> int:
    names = {"name": dpm_overlap.EXPERIMENT, "description": dpm_overlap.__doc__}
    return run_command(dpm_overlap.main, dpm_overlap.Config, args=list(map(str, arguments)), **names)


def examples(seed: int, num: int) -> Examples:
    """Pairs whose features differ in their mean where they overlap; masked ones hold NaN."""
    rng = np.random.default_rng(seed)
    is_overlap, mask = rng.random(num) < 0.5, np.tile(np.arange(8) < 6, (num, 2, 1))
    features = rng.normal(size=(num, 2, 8, 12)) + np.where(is_overlap, 1, -1)[:, None, None, None]
    features = np.where(mask[..., None], features, np.nan).astype(np.float16)
    evidence = rng.normal(size=(num, len(OVERLAP_FEATURES)))
    return Examples(evidence, features, mask, is_overlap, np.zeros(num, bool))


def test_the_head_learns_what_the_mean_of_the_features_says(model) -> None:
    other = examples(2, 40)
    head = train_head(model, examples(0, 96), examples(1, 32), seed=0)
    assert area_under_curve(head_logits(model, head, other), other.is_overlap) > 0.99


def test_hard_pairs_are_far_apart(model) -> None:
    pairs = dpm_calibrate.town_pairs(model, [toy.drive(0), toy.drive(1)], 16, seed=0)
    assert pairs.is_hard.sum() == 4
    assert not pairs.is_overlap[pairs.is_hard].any()


@pytest.mark.slow
@pytest.mark.parametrize("num_scans", [8, 24])
def test_a_drive_without_far_pairs_gets_them_from_the_next_one(model, num_scans: int, monkeypatch) -> None:
    monkeypatch.setattr(dpm_overlap, "NUM_PAIRS", 3)
    pairs = dpm_overlap.measure_drive(model, toy.drive(0, num_scans), toy.drive(1), 0)
    np.testing.assert_array_equal(pairs.is_overlap, [True] * 3 + [False] * 3)
    assert pairs.features.shape[:2] == (6, 2)


def test_one_drive_without_far_pairs_is_refused(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("dpmjax.cli.open_evaluation_drives", lambda *_: [toy.drive(0, num_scans=8)])
    weights = tmp_path / "model.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.MODEL), weights)
    assert run(weights, "-o", tmp_path / "out") == EXIT_BAD_INPUT
    assert "give a second drive" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_all_methods_are_compared_on_all_places(tmp_path, monkeypatch) -> None:
    weights = tmp_path / "model.safetensors"
    dpmjax.save_model(dpmjax.init_model(jax.random.key(0), toy.MODEL), weights)
    monkeypatch.setattr(simulation, "simulate_drive", lambda seed, **_: toy.drive(seed))
    monkeypatch.setattr(dpm_calibrate, "NUM_OVERLAP_PAIRS", 16)
    for name in ("NUM_TOWNS", "NUM_OTHER_TOWNS"):
        monkeypatch.setattr(dpm_overlap, name, 2)
    assert run(weights, "-o", tmp_path / "out") == EXIT_OK
    rows = load_json(tmp_path / "out" / "metrics.json")["rows"]
    assert {row["place"]: row["num_pairs"] for row in rows} == {"towns": 32, "towns, hard pairs too": 40}
    assert len(rows) == 10
    assert all(0 <= row["auc"] <= 1 for row in rows)
